"""Other robots on the command line: evaluate --suite, and check of a suite by name and by module."""

import json

import pytest

pytest.importorskip("gymnasium_robotics")

import lw_torchrl as lw
from lw_torchrl.cli.main import main

OWN = """
from dataclasses import replace
from lw_torchrl.suites import load_suite

fetch = load_suite("fetch")
reach = {"fetch/reach": replace(fetch.tasks["fetch/reach"], layout=replace(fetch.layout, reach=0.1))}
slow = replace(fetch, layout=reach["fetch/reach"].layout, tasks=reach, plans=None)
number = 3
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    (tmp_path / "my_robots.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))


def test_a_policy_of_meta_world_is_evaluated_with_another_robot(capsys, tmp_path):
    actor = lw.PlanConditionedActor(lw.load_plans("MT10"), features="opening", roles=True, width=8, depth=1)
    lw.save_actor(actor, tmp_path / "mt10.zip")
    options = ["--suite", "fetch", "--tasks", "reach", "--episodes", "1", "--max-steps", "5", "--json"]
    main(["evaluate", str(tmp_path / "mt10.zip"), *options])
    found = json.loads(capsys.readouterr().out)
    assert found["config"]["tasks"] == ["fetch/reach"]
    assert found["config"]["max_steps"] == 5


def test_a_suite_s_plans_demonstrate(capsys):
    main(["evaluate", "expert", "--tasks", "fetch/reach", "--episodes", "2", "--noise", "0", "--json"])
    assert json.loads(capsys.readouterr().out)["mean_success"] == 1.0


def test_check_measures_a_suite(capsys, own):
    with pytest.raises(SystemExit) as ended:
        main(["check", "my_robots:slow"])
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert "OFF  fetch/reach  +x moves right" in printed.out
    assert "wanted: 10.0 cm along x" in printed.out
    assert "3 numbers of suite 'fetch' are off" in printed.err


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("my_robots:nothing", "names no object"),
        ("my_robots:number", "must name a Suite, it names int"),
        ("no_module:suite", "names no object"),
    ],
)
def test_what_names_no_suite_is_told(capsys, own, name, says):
    with pytest.raises(SystemExit) as ended:
        main(["check", name])
    assert ended.value.code
    assert says in capsys.readouterr().err


def test_an_unknown_suite_gets_the_nearest(capsys, tmp_path):
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10"), width=8), tmp_path / "mt10.zip")
    with pytest.raises(SystemExit):
        main(["evaluate", str(tmp_path / "mt10.zip"), "--suite", "fetsh"])
    assert "suite must be one of 'metaworld', 'fetch', got 'fetsh'; did you mean 'fetch'?" in capsys.readouterr().err
