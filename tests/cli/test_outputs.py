"""A place that cannot be written to is refused before the work begins, in every command that writes."""

from __future__ import annotations

import os

import pytest
from commands import fails

from lw_torchrl.cli.main import COMMANDS, GROUPS
from lw_torchrl.cli.parsing import arguments

FOLDERS = {
    "demo": ["--quick", "--out"],
    "collect": ["reach", "--out"],
    "train-evaluator": ["reach", "--out"],
    "data export": ["demos", "--to", "lerobot", "--out"],
    "data import": ["demos", "--out"],
    "evaluate": ["expert", "--out"],
    "scripted": ["reach", "--out"],
    "plan generate": ["reach", "--model", "m", "--out"],
    "plan repair": ["reach", "--model", "m", "--out"],
}
FILES = {
    "train": ["demos", "--out"],
    "card": ["x.safetensors", "--out"],
    "record": ["reach", "--out"],
    "view": ["x.rrd", "--screenshot"],
}


@pytest.fixture(autouse=True)
def _no_work(monkeypatch):
    """Nothing that works is imported."""
    import builtins

    original = builtins.__import__
    working = ("lw_torchrl.data", "lw_torchrl.record.rollouts", "openai")

    def refuse(name, *args, **kwargs):
        assert name not in working, name
        return original(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", refuse)


def test_these_are_all_commands_that_write():
    inner = {f"{group} {name}": function for group, commands in GROUPS.items() for name, function in commands.items()}
    writing = {
        name
        for name, function in {**COMMANDS, **inner}.items()
        if {"out", "screenshot", "html"} & {*arguments(function)}
    }
    assert writing == {*FOLDERS, *FILES}


@pytest.mark.parametrize("command", FOLDERS)
def test_a_folder_that_is_none(capsys, tmp_path, command):
    file = tmp_path / "file"
    file.write_text("mine")
    assert fails(capsys, *command.split(), *FOLDERS[command], file).endswith(
        f"--out must be a folder, '{file}' is none\n"
    )
    below = file / "a" / "b"
    error = fails(capsys, *command.split(), *FOLDERS[command], below)
    assert error.endswith(f"--out must be a folder, '{below}' lies below the file '{file}'\n")
    assert file.read_text() == "mine"


@pytest.mark.parametrize("command", FILES)
def test_a_file_that_is_none(capsys, tmp_path, command):
    option = FILES[command][-1]
    file = tmp_path / "file"
    file.write_text("mine")
    assert f"{option} must be a file, '{tmp_path}' is a folder" in fails(
        capsys, *command.split(), *FILES[command], tmp_path
    )
    error = fails(capsys, *command.split(), *FILES[command], file / "a.png")
    assert f"{option}'s folder must be a folder, '{file}' is none" in error
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="wants a folder that not even root can write to")
@pytest.mark.parametrize("command", [*FOLDERS, *FILES])
def test_a_place_that_cannot_be_written_to(capsys, command):
    given = (FOLDERS | FILES)[command]
    error = fails(capsys, *command.split(), *given, "/proc/self/new/out.png")
    assert given[-1] in error
    assert "'/proc/self' cannot be written to" in error


def test_a_link_to_nowhere(capsys, tmp_path):
    link = tmp_path / "link"
    link.symlink_to(tmp_path / "nowhere")
    assert f"--out must be a folder, '{link}' is none" in fails(capsys, "collect", "reach", "--out", link)
