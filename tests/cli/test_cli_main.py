"""The command line as a whole: help pages, exit codes, ``--import``, pipes."""

import json
import re
import subprocess
import sys
from importlib.metadata import entry_points

import pytest
from cases import read_cases
from commands import fails, run

import lw_torchrl
import lw_torchrl.cli.main as cli
from lw_torchrl.cli import machine
from lw_torchrl.cli.main import COMMANDS, main


def test_the_package_installs_the_command():
    (script,) = entry_points(group="console_scripts", name="lw-torchrl")
    assert script.load() is main


def test_help_lists_the_commands_in_groups(capsys):
    printed = run(capsys, "--help")
    assert run(capsys) == printed
    assert [line[:-1] for line in printed.splitlines() if re.fullmatch(r"[A-Z]\w+:", line)] == [
        "Data", "Training", "Evaluation", "Language", "Other"
    ]  # fmt: skip
    assert all(f"  {name} " in printed and summary in printed for name, (_, _, summary) in COMMANDS.items())
    assert len({name.split()[0] for name in COMMANDS}) <= 13
    assert max(map(len, printed.splitlines())) <= 100
    assert "plan read" in (inner := run(capsys, "plan", "--help"))
    assert "collect" not in inner


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command_has_an_example_and_no_empty_defaults(capsys, command):
    with pytest.raises(SystemExit) as caught:
        main([*command.split(), "--help"])
    assert caught.value.code == 0
    printed = capsys.readouterr().out
    assert f"Example: lw-torchrl {command} " in printed
    assert f"usage: lw-torchrl {command} " in printed
    assert not re.search(r"default: *(│\s+│ *)?(None|False)?\)|\{None\}", printed)


def test_help_loads_nothing_heavy(python):
    program = """
import sys
from lw_torchrl.cli.main import main
for command in ([], ["train"], ["evaluate"]):
    try:
        main([*command, "--help"])
    except SystemExit:
        pass
print([name for name in ("torch", "torchrl", "mujoco", "rich") if name in sys.modules])
"""
    assert python(program).stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize(("command", "message"), read_cases("cli/errors.toml")["cases"])
def test_an_error_is_one_line_and_status_2(capsys, tmp_path, monkeypatch, command, message):
    monkeypatch.chdir(tmp_path)
    error = fails(capsys, *command.split())
    assert message in error
    assert error.count("\n") == 1


def test_an_unknown_option_is_an_error_with_the_nearest_name(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["collect", "reach", "--out", "x", "--epsodes", "3"])
    assert caught.value.code == 2
    assert "--episodes INT" in capsys.readouterr().err


@pytest.mark.parametrize(("error", "status"), [(KeyboardInterrupt, 130), (ValueError, 2), (KeyError, None)])
def test_exit_status_depends_on_the_error(capsys, monkeypatch, error, status):
    def failing(args):
        raise error

    monkeypatch.setattr(cli, "_run", failing)
    with pytest.raises(SystemExit if status else KeyError) as caught:
        main([])
    assert status is None or caught.value.code == status
    monkeypatch.setenv("LW_TORCHRL_TRACEBACK", "1")
    with pytest.raises(SystemExit if status == 130 else error):
        main([])


def test_a_closed_pipe_is_status_141_and_version_is_printed(capsys):
    for command in ("--help", "tasks", "tasks --json"):
        script = f"'{sys.executable}' -m lw_torchrl {command} | true; exit ${{PIPESTATUS[0]}}"
        done = subprocess.run(["bash", "-c", script], capture_output=True, timeout=120)
        assert (done.returncode, done.stderr) == (141, b"")
    assert run(capsys, "--version") == f"lw-torchrl {lw_torchrl.__version__}\n"


def test_import_runs_a_module_first(capsys, tmp_path, monkeypatch):
    (tmp_path / "my_words.py").write_text("print('imported')\n")
    monkeypatch.chdir(tmp_path)
    assert run(capsys, "tasks", "--import", "my_words", "reach").startswith("imported\n")
    sys.modules.pop("my_words")
    main(["--import=my_words", "tasks", "reach", "--json"])
    assert json.loads(capsys.readouterr().out.removeprefix("imported\n"))["task"]["task"] == "reach"


def test_info_reports_versions_extras_folders_and_slow_parts(capsys):
    printed = run(capsys, "info")
    titles = ("versions", "machine", "extras", "cache folders", "variables", "slow here")
    assert [line[:-1] for line in printed.splitlines() if line.endswith(":") and line[0] != " "] == [*titles]
    assert lw_torchrl.__version__ in printed
    document = json.loads(run(capsys, "info", "--json"))
    assert [*document] == ["versions", "machine", "extras", "cache_folders", "variables", "slow"]
    assert document["versions"]["torch"].startswith("2.")
    assert {"fast", "text", "ray"} <= {*document["extras"]}


def test_missing_packages_of_an_extra_are_named(monkeypatch):
    lines = ['numba>=0.61; extra == "fast"', 'not-a-package; extra == "odd"']
    monkeypatch.setattr(machine, "requires", lambda _: lines)
    assert machine.find_extras() == {"fast": [], "odd": ["not-a-package"]}


def test_slow_parts_are_explained(monkeypatch):
    monkeypatch.setattr(machine, "find_kernel", lambda: None)
    monkeypatch.setattr(machine, "available_cores", lambda: 1)
    monkeypatch.setattr(machine.os, "getloadavg", lambda: (50.0, 0.0, 0.0))
    reasons = " ".join(machine.find_slow_parts())
    assert all(text in reasons for text in ("NUMBA_CACHE_DIR", "only one core", "the load is 50.0"))
