"""Other robots on the command line: --suite, and check of a suite by name and by module."""

import pytest

pytest.importorskip("gymnasium_robotics")

from commands import document, fails, run

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.modules import Concat, MLPDecoder, ObservationFeatures, RoleFeatures
from lw_torchrl.suites import load_suite

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


def test_a_metaworld_policy_is_evaluated_with_another_robot(capsys, tmp_path):
    plans = lw.canonical_plans(lw.load_plans("MT10"))
    features = Concat(ObservationFeatures("opening"), RoleFeatures(plans))
    actor = lw.PlanConditionedActor(plans, features=features, decoder=MLPDecoder(width=8, depth=1))
    lw.save_actor(actor, tmp_path / "mt10.safetensors")
    options = ("--suite", "fetch", "--tasks", "reach", "--episodes", 1, "--max-steps", 5)
    config = document(capsys, "evaluate", tmp_path / "mt10.safetensors", *options)["config"]
    assert (config["tasks"], config["max_steps"]) == (["fetch/reach"], 5)
    wrong = fails(capsys, "evaluate", tmp_path / "mt10.safetensors", "--suite", "fetsh")
    assert "did you mean 'fetch'?" in wrong


def test_commands_accept_tasks_of_another_suite(capsys):
    assert [row["task"] for row in document(capsys, "tasks fetch")["tasks"]] == list(load_suite("fetch").tasks)
    push = document(capsys, "tasks fetch/push")
    assert push["task"]["plan"].count("robot.") == 13
    assert {"query": "the puck is near the target location", "extension": False} in push["task"]["queries"]
    assert len(document(capsys, "tasks fetch/reach")["skills"]) < len(push["skills"])
    answer = document(capsys, "query fetch/reach", "is the gripper near the reach target", "--step", 10)
    assert answer["queries"][0]["holds"]
    assert "--step must be at most 50" in fails(capsys, "query", "fetch/reach", "--step", 51)
    for policy in ("expert", "scripted"):
        result = document(capsys, "evaluate", policy, "--tasks", "fetch/reach", "--episodes", 2, "--noise", 0)
        assert result["mean_success"] == 1.0
    assert "did you mean 'fetch/reach'" in fails(capsys, "tasks", "fetch/rech")


def test_data_policies_and_recordings_of_another_suite(capsys, tmp_path):
    demos, policy, recording = tmp_path / "demos", tmp_path / "policy.safetensors", tmp_path / "episode.rrd"
    collected = document(capsys, "collect", "fetch/reach", "fetch/push", "--out", demos, "--episodes", 1)
    assert collected["steps"] == 100
    run(capsys, "train", demos, "--steps", 2, "--out", policy)
    assert lw.load_actor(policy).tasks == tuple(load_suite("fetch").tasks)
    for task, *who in (("fetch/reach", policy), ("fetch/reach", "wrong"), ("reach", policy, "--suite", "fetch")):
        run(capsys, "record", task, "--max-steps", 3, "--out", recording, "--policy", *who)
    assert recording.stat().st_size > 10_000


def test_check_measures_a_suite(capsys, own):
    with pytest.raises(SystemExit) as ended:
        main(["check", "my_robots:slow"])
    printed = capsys.readouterr()
    assert ended.value.code == 2
    assert "OFF  fetch/reach  +x moves right" in printed.out
    assert "expected: 10.0 cm along x" in printed.out
    assert "3 measurements of suite 'fetch'" in printed.err


@pytest.mark.parametrize("name", ["my_robots:nothing", "my_robots:number", "no_module:suite"])
def test_a_name_that_is_not_a_suite_is_an_error(capsys, own, name):
    assert name.partition(":")[0] in fails(capsys, "check", name)
