"""Whatever the standard streams and the locale are: no traceback, and an exit status that says what happened."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

import lw_torchrl

COMMAND = f"'{sys.executable}' -m lw_torchrl"


def shell(script, **environment):
    done = subprocess.run(
        ["bash", "-c", script.replace("lw-torchrl", COMMAND)],
        env=os.environ | environment,
        capture_output=True,
        timeout=120,
    )
    assert b"Traceback" not in done.stderr
    assert b"Exception ignored" not in done.stderr
    return done.returncode, done.stdout.decode("utf-8"), done.stderr.decode("utf-8")


@pytest.mark.parametrize(
    ("command", "status"), [("--help", 141), ("tasks", 141), ("tasks --json", 141), ("dance 2>&1", 2)]
)
def test_a_pipe_that_nobody_reads(command, status):
    """``true`` has gone long before anything is printed; what is wrong keeps its status."""
    assert shell(f"lw-torchrl {command} | true; exit ${{PIPESTATUS[0]}}") == (status, "", "")


def test_a_pipe_of_which_only_the_first_line_is_read():
    status, printed, error = shell("set -o pipefail; lw-torchrl tasks reach | head -1")
    assert (status, printed.strip(), error) == (0, "1 task", "")


@pytest.mark.parametrize(("closed", "status"), [(">&-", 0), ("2>&-", 0), (">&- 2>&-", 0), ("<&-", 0)])
def test_closed_streams(closed, status):
    found, printed, error = shell(f"lw-torchrl --help {closed}")
    assert (found, error) == (status, "")
    assert ("usage: lw-torchrl" in printed) == (closed[:2] != ">&")


def test_an_error_without_a_standard_error():
    assert shell("lw-torchrl dance 2>&-")[0] == 2
    assert shell("lw-torchrl tasks raech 2>&-") == (2, "", "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="wants /dev/full")
def test_a_full_disk():
    for command in ("--help", "tasks", "tasks --json"):
        status, _, error = shell(f"lw-torchrl {command} > /dev/full")
        assert (status, error) == (2, "lw-torchrl: error: [Errno 28] No space left on device\n")
    assert shell("lw-torchrl dance > /dev/full 2> /dev/full")[0] == 2


ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii"}
OLD = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


@pytest.mark.parametrize("environment", [ASCII, OLD], ids=["PYTHONIOENCODING", "C locale"])
@pytest.mark.parametrize("command", ["--help", "tasks reach", "tasks reach --json"])
def test_an_ascii_locale(environment, command):
    status, printed, error = shell(f"lw-torchrl {command}", **environment)
    assert (status, error) == (0, "")
    assert printed.isascii()
    assert len(printed) > 50


def test_an_argument_that_is_no_text():
    status, printed, error = shell(r"lw-torchrl collect reach --out $'caf\xe9'")
    assert (status, printed) == (2, "")
    assert error == r"lw-torchrl: error: the argument 'caf\udce9' is no text in the encoding utf-8" + "\n"
    assert "no text in the encoding ascii" in shell("lw-torchrl tasks é", **OLD)[2]


def test_the_version():
    assert shell("lw-torchrl --version") == (0, f"lw-torchrl {lw_torchrl.__version__}\n", "")


def test_help_comes_at_once_and_loads_nothing_heavy(python):
    """Under 1 s of work, imports and all; the shell's clock would measure what else the machine does."""
    program = """
import sys, time
from lw_torchrl.cli.main import main
try:
    main([*sys.argv[1:], "--help"])
except SystemExit:
    pass
print(time.process_time())
print([name for name in ("torch", "numpy", "torchrl", "mujoco", "rich") if name in sys.modules])
"""
    for command in ([], ["train"]):
        found = python(program.replace("*sys.argv[1:]", ", ".join(map(repr, command)) or "*()"))
        assert found.returncode == 0, found.stderr
        taken, heavy = found.stdout.splitlines()[-2:]
        assert float(taken) < 1.0
        assert heavy == "[]"
