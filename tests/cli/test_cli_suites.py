"""Other robots on the command line: evaluate --suite, and check of a suite by name and by module."""

import json

import pytest

pytest.importorskip("gymnasium_robotics")

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.modules import Concat, MLPDecoder, ObservationFeatures, RoleFeatures
from lw_torchrl.suites import SUITES, load_suite
from lw_torchrl.suites import suite as suite_module

OWN = """
from dataclasses import replace
from lw_torchrl.suites import SUITES, load_suite
from lw_torchrl.suites import suite as suite_module

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
    plans = lw.canonical_plans(lw.load_plans("MT10"))
    features = Concat(ObservationFeatures("opening"), RoleFeatures(plans))
    actor = lw.PlanConditionedActor(plans, features=features, decoder=MLPDecoder(width=8, depth=1))
    lw.save_actor(actor, tmp_path / "mt10.safetensors")
    options = ["--suite", "fetch", "--tasks", "reach", "--episodes", "1", "--max-steps", "5", "--json"]
    main(["evaluate", str(tmp_path / "mt10.safetensors"), *options])
    found = json.loads(capsys.readouterr().out)
    assert found["config"]["tasks"] == ["fetch/reach"]
    assert found["config"]["max_steps"] == 5


def test_a_suite_s_plans_demonstrate(capsys):
    main(["evaluate", "expert", "--tasks", "fetch/reach", "--episodes", "2", "--noise", "0", "--json"])
    assert json.loads(capsys.readouterr().out)["mean_success"] == 1.0


def said(capsys, *command):
    main([*command, "--json"])
    return json.loads(capsys.readouterr().out)


def test_commands_take_another_suite_s_tasks_by_name(capsys):
    assert [row["task"] for row in said(capsys, "tasks", "fetch")["tasks"]] == list(load_suite("fetch").tasks)
    push = said(capsys, "tasks", "fetch/push")
    assert push["task"]["plan"].count("robot.") == 13
    assert {"query": "the puck is near the target location", "extension": False} in push["task"]["queries"]
    assert len(said(capsys, "tasks", "fetch/reach")["skills"]) < len(push["skills"])
    asked = ["query", "fetch/reach", "is the gripper near the reach target", "--step", "10"]
    assert said(capsys, *asked)["queries"][0]["holds"]
    with pytest.raises(SystemExit):
        main(["query", "fetch/reach", "--step", "51"])
    assert "--step must be at most 50" in capsys.readouterr().err
    scripted = said(capsys, "evaluate", "scripted", "--tasks", "fetch/reach", "--episodes", "2", "--noise", "0")
    assert scripted["mean_success"] == 1.0
    with pytest.raises(SystemExit):
        main(["tasks", "fetch/rech"])
    assert "did you mean 'fetch/reach'" in capsys.readouterr().err


def test_data_policies_and_recordings_of_another_suite(capsys, tmp_path):
    demos, policy, recording = tmp_path / "demos", tmp_path / "policy.safetensors", tmp_path / "episode.rrd"
    made = said(capsys, "collect", "fetch/reach", "fetch/push", "--out", str(demos), "--episodes", "1")
    assert made["steps"] == 100
    main(["train", str(demos), "--steps", "2", "--out", str(policy)])
    assert lw.load_actor(policy).tasks == tuple(load_suite("fetch").tasks)
    main(["record", "fetch/reach", "--policy", str(policy), "--max-steps", "3", "--out", str(recording)])
    main(["record", "fetch/reach", "--policy", "wrong", "--max-steps", "3", "--out", str(recording)])
    main(["record", "reach", "--suite", "fetch", "--policy", str(policy), "--max-steps", "3", "--out", str(recording)])
    assert recording.stat().st_size > 10_000


def test_check_measures_a_suite(capsys, own):
    with pytest.raises(SystemExit) as ended:
        main(["check", "my_robots:slow"])
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert "OFF  fetch/reach  +x moves right" in printed.out
    assert "expected: 10.0 cm along x" in printed.out
    assert "3 numbers of suite 'fetch' differ from its layout" in printed.err


def test_a_module_of_yours_is_imported_first(capsys, tmp_path, monkeypatch):
    (tmp_path / "my_desk.py").write_text(
        "from dataclasses import replace\nimport lw_torchrl as lw\nfetch = lw.suites.load_suite('fetch')\n"
        "layout = replace(fetch.layout, name='desk')\n"
        "tasks = {f'desk/{n[6:]}': replace(t, name=f'desk/{n[6:]}', layout=layout) for n, t in fetch.tasks.items()}\n"
        "lw.suites.SUITES['desk'] = replace(fetch, name='desk', layout=layout, tasks=tasks, plans=None)\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(suite_module, "SUITES", dict(SUITES))
    monkeypatch.setattr(lw.suites, "SUITES", suite_module.SUITES)
    assert len(said(capsys, "--import", "my_desk", "tasks", "desk")["tasks"]) == 4
    assert said(capsys, "tasks", "desk/push", "--import=my_desk")["task"]["task"] == "desk/push"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("my_robots:nothing", "must be like my_module:name"),
        ("my_robots:number", "must be a Suite, got int"),
        ("no_module:suite", "No module named 'no_module'"),
    ],
)
def test_what_names_no_suite_is_told(capsys, own, name, says):
    with pytest.raises(SystemExit) as ended:
        main(["check", name])
    assert ended.value.code
    assert says in capsys.readouterr().err


def test_an_unknown_suite_gets_the_nearest(capsys, tmp_path):
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), tmp_path / "mt10.safetensors")
    with pytest.raises(SystemExit):
        main(["evaluate", str(tmp_path / "mt10.safetensors"), "--suite", "fetsh"])
    assert "suite must be one of 'metaworld', 'fetch', got 'fetsh'; did you mean 'fetch'?" in capsys.readouterr().err
