"""Running the command line within a test."""

import json
import re
from pathlib import Path

import pytest

from lw_torchrl.cli.main import main


def run(capsys, *args):
    """What a command prints."""
    main([str(arg) for arg in args])
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    return printed.out


def fails(capsys, *args):
    """The one line with which a command fails."""
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("lw-torchrl: error: ")
    assert printed.err.count("\n") == 1, printed.err
    return printed.err


def document(capsys, *args):
    """What a command prints with ``--json``, as docs/cli.md says."""
    found = json.loads(run(capsys, *args, "--json"), parse_constant=pytest.fail)
    assert isinstance(found, dict)
    return found


def documented(command):
    """Key to the names below it, of the documents of a command, as the table in docs/cli.md has them."""
    text = (Path(__file__).parent.parent / "docs" / "cli.md").read_text("utf-8")
    (cell,) = re.findall(rf"^\| `{re.escape(command)}`[^|]*\| (.*) \|$", text, re.MULTILINE)
    found = {}
    for part in cell.split("; "):
        key, _, names = part.removeprefix("also ").partition(": ")
        found[key.strip("`").split("`")[0]] = re.findall(r"`(\w+)`", names)
    return found


def check_documented(command, found, also=()):
    """A document has the keys that docs/cli.md says, and those of other rows of its table."""
    told = documented(command)
    assert [*found] == [*told, *also]
    for key, names in told.items():
        for row in found[key] if names and isinstance(found[key], list) else ():
            assert [*row] == names
