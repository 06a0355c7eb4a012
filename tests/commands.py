"""Running the command line within a test."""

import json
import re
from pathlib import Path

import pytest

from lw_torchrl.cli.main import main


def run(capsys, *args):
    """What a command prints."""
    main([str(arg) for arg in args])
    return capsys.readouterr().out


def fails(capsys, *args):
    """The one line with which a command fails."""
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("lw-torchrl: error: ")
    return printed.err


def document(capsys, command, *args):
    """What a command prints with ``--json``, whose keys are those in the table of docs/reference.md."""
    found = json.loads(run(capsys, *command.split(), *args, "--json"), parse_constant=pytest.fail)
    name = " ".join(command.split()[:2]) if command.split()[0] in ("data", "plan") else command.split()[0]
    text = (Path(__file__).parent.parent / "docs" / "reference.md").read_text("utf-8")
    (cell,) = re.findall(rf"^\| `{name}`[^|]*\| (.*) \|$", text, re.MULTILINE)
    documented = {}
    for part in cell.split("; "):
        key, _, names = part.partition(": ")
        if word := re.search(r"`(\w+)`", key):
            documented[word[1]] = re.findall(r"`(\w+)`", names)
    for key, value in found.items():
        assert key in documented, (command, key)
        for row in value if documented[key] and isinstance(value, list) else ():
            assert {*row} <= {*documented[key]}, (command, key)
    return found
