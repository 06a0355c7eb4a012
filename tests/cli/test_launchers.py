"""Runs run in processes of this machine or as tasks of Ray: the same results, and errors that tell."""

import sys

import pytest
from lw_torchrl.cli.runs import run_command, run_commands

FAILS = ["plans", "no-such-folder"]


def test_a_command_says_what_it_printed_or_why_it_failed():
    assert "reach" in run_command(["tasks"])
    with pytest.raises(RuntimeError, match=r"lw-torchrl plans no-such-folder failed:\n.*error: NAMES must be one of"):
        run_command(FAILS)


@pytest.mark.parametrize("launcher", ["local", pytest.param("ray", marks=pytest.mark.slow)])
@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::FutureWarning", "ignore::DeprecationWarning")
def test_every_command_runs_and_an_error_comes_last(launcher):
    if launcher == "ray":
        pytest.importorskip("ray")
    found = {}

    def run_all():
        for index, printed in run_commands([["tasks"], FAILS, ["skills"]], launcher, 2):
            found[index] = printed

    with pytest.raises(RuntimeError, match="no-such-folder failed"):
        run_all()
    assert found.keys() == {0, 2}
    assert "reach" in found[0]


def test_ray_is_an_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ImportError, match=r"needs the extra \[ray\]"):
        list(run_commands([["tasks"]], "ray", 1))
