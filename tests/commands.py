"""Run the command line in a test, or Python in another process."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from lw_torchrl.cli.main import main


def run(capsys, *args):
    """Run a command and return what it prints."""
    main([str(arg) for arg in args])
    return capsys.readouterr().out


def python_process(*words, cwd=None, timeout=400, **variables):
    """Run Python with arguments and environment variables; return the ended process with its output."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, cwd=cwd, env=os.environ | variables, capture_output=True, text=True, timeout=timeout)


def fails(capsys, *args):
    """Run a command that fails and return its error message."""
    with pytest.raises(SystemExit) as caught:
        main([str(arg) for arg in args])
    assert caught.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("lw-torchrl: error: ")
    return printed.err


def document(capsys, command, *args):
    """Run a command with ``--json`` and return the document, whose keys must be in the table of docs/reference.md."""
    printed = json.loads(run(capsys, *command.split(), *args, "--json"), parse_constant=pytest.fail)
    name = " ".join(command.split()[:2]) if command.split()[0] in ("data", "plan") else command.split()[0]
    text = (Path(__file__).parent.parent / "docs" / "reference.md").read_text("utf-8")
    (cell,) = re.findall(rf"^\| `{name}`[^|]*\| (.*) \|$", text, re.MULTILINE)
    documented = {}
    for part in cell.split("; "):
        key, _, names = part.partition(": ")
        if word := re.search(r"`(\w+)`", key):
            documented[word[1]] = re.findall(r"`(\w+)`", names)
    for key, value in printed.items():
        assert key in documented, (command, key)
        for row in value if documented[key] and isinstance(value, list) else ():
            assert {*row} <= {*documented[key]}, (command, key)
    return printed
