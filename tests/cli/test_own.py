"""Tasks, plans, skills and text encoders of one's own, by the same options in every command."""

from __future__ import annotations

import json

import pytest
from commands import fails, run

import lw_torchrl as lw
from lw_torchrl.cli.options import read_encoder

TASKS = """
[reach]
description = "Bring the hand to the ball."
objects.ball = "obs[36:39]"
"""
PLAN = """
def reach(robot):
    if check("the gripper is not near the ball"):
        robot.go("to the ball")
    if check("the gripper is near the ball"):
        robot.wait("at the ball")
"""
SKILLS = """
["go to the ball"]
target = "ball"
["wait at the ball"]
target = "ball"
gain = 0.0
"""
ENCODER = """
import torch
def encode(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abelot"] for text in texts])
def other(texts):
    return encode(texts).flip(-1)
number = 3
"""
TINY = ("--steps", 5, "--width", 8, "--depth", 1)


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A folder with files of one's own."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "tasks.toml").write_text(TASKS)
    (folder / "reach.plan").write_text(PLAN)
    (folder / "skills.toml").write_text(SKILLS)
    (folder / "my_texts.py").write_text(ENCODER)
    lw.collect_demonstrations(
        ["push", "reach"], episodes_per_task=1, root=folder / "demos", max_steps=30, progress=False
    )
    return folder


@pytest.fixture(autouse=True)
def there(own, monkeypatch):
    monkeypatch.chdir(own)


def test_lists_speak_of_them(capsys):
    assert "Bring the hand to the ball." in run(capsys, "tasks", "reach", "--task-file", "tasks.toml")
    files = ("--task-file", "tasks.toml")
    assert "go to the ball" in run(capsys, "skills", "reach", "--skill-file", "skills.toml", *files)
    assert "the ball" in run(capsys, "queries", "reach", *files)
    assert "robot.go" in run(capsys, "plans", "reach", "--plans", "reach.plan", *files)
    assert "yes: the robot's gripper is not near the ball" in run(
        capsys, "query", "reach", "the gripper is not near the ball", *files
    )
    assert "reach.plan: 2 steps, valid" in run(capsys, "check", "reach.plan", "--skill-file", "skills.toml", *files)
    assert "reach.plan, line 3" in fails(capsys, "plans", "--plans", "reach.plan")


def test_of_several_sources_the_later_one_counts(capsys, tmp_path):
    (tmp_path / "push.plan").write_text(str(lw.load_plans("MT10")["push"]).replace("robot.place", "robot.bring"))
    ours, theirs = "robot.place", "robot.bring"
    for sources, has, lacks in ((["MT10", tmp_path], theirs, ours), ([tmp_path, "MT10"], ours, theirs)):
        shown = run(capsys, "plans", "push", "--plans", *sources)
        assert has in shown
        assert lacks not in shown


def test_a_shipped_plan_that_a_later_source_replaces_need_not_fit(capsys):
    files = ("--task-file", "tasks.toml")  # its reach has no "reach target", of which the shipped plan speaks
    shown = run(capsys, "plans", "reach", "push", "--plans", "MT10", "reach.plan", *files)
    assert "robot.go" in shown
    assert "the puck" in shown
    message = fails(capsys, "plans", "reach", "--plans", "reach.plan", "MT10", *files)
    assert "--plans reach.plan MT10: the plan of 'reach' that counts is the shipped one" in message
    assert "'the ball'" in message


def test_a_plan_with_a_fault_is_named_by_its_path(capsys, tmp_path):
    path = tmp_path / "mine" / "push.plan"
    path.parent.mkdir()
    path.write_text(PLAN)
    assert f"--plans {path}: push.plan, line 2: " in fails(capsys, "plans", "--plans", "MT10", path)


def test_scripts_carry_them_out(capsys, tmp_path):
    files = ("--plans", "reach.plan", "--skill-file", "skills.toml", "--task-file", "tasks.toml")
    out = run(capsys, "scripted", "reach", *files, "--episodes", 3, "--out", tmp_path / "out")
    assert "reach: success 1.00" in out
    found = json.loads((tmp_path / "out" / "results.json").read_text())
    assert len(found["origin"]["plans"]) == 32


def test_demonstrations_are_collected_with_them(capsys, tmp_path):
    files = ("--task-file", "tasks.toml")
    out = run(capsys, "collect", "reach", *files, "--episodes", 1, "--out", tmp_path / "demos")
    assert "reach  1.00     1" in out


def test_a_policy_is_trained_and_evaluated_with_them(capsys, tmp_path):
    policy = tmp_path / "policy.safetensors"
    files = ("--plans", "reach.plan", "--task-file", "tasks.toml", "--text-encoder", "my_texts:encode")
    training = (*TINY, "--batch-size", 8, "--logger", "csv")
    run(capsys, "train", "demos", "--out", policy, "--tasks", "reach", *files, *training)
    assert list((tmp_path / "logs").rglob("*.csv"))
    assert "pass that one as --text-encoder" in fails(capsys, "evaluate", policy, "--text-encoder", "my_texts:other")
    run(
        capsys, "evaluate", policy, "--text-encoder", "my_texts:encode", "--episodes", 1, "--out", tmp_path / "out",
        "--stop-at-success",
    )  # fmt: skip
    found = json.loads((tmp_path / "out" / "results.json").read_text())
    assert found["origin"]["checkpoint"]["path"] == str(policy)
    assert found["origin"]["versions"]["torchrl"]
    assert (tmp_path / "out" / "rollout.rrd").is_file()


@pytest.mark.slow
def test_a_policy_on_words_of_ones_own_serves_in_other_processes(forks, own, tmp_path):
    """Trained, evaluated, recorded and trained on, each time where no text has been encoded yet."""
    plan = PLAN.replace("the ball", "the reach target")
    (tmp_path / "mine.plan").write_text(plan)  # the plan itself says which task it is for
    policy = tmp_path / "policy.safetensors"
    for command in (
        ("train", own / "demos", "--tasks", "reach", "--plans", tmp_path / "mine.plan", "--out", policy, *TINY),
        ("evaluate", policy, "--episodes", 1, "--stop-at-success", "--out", tmp_path / "evaluated"),
        ("record", "reach", "--policy", policy, "--out", tmp_path / "rollout.rrd"),
        (
            "train",
            own / "demos",
            "--tasks",
            "reach",
            "--begin",
            policy,
            "--out",
            tmp_path / "on.safetensors",
            "--steps",
            5,
        ),
        ("evaluate", tmp_path / "on.safetensors", "--episodes", 1, "--stop-at-success", "--out", tmp_path / "again"),
    ):
        forks.start(*command)
        ended = forks.end()
        assert ended.status == 0, (command, ended.err)


def test_a_task_that_the_simulator_lacks_is_named(capsys, tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack-cup]\ndescription = "Stack."\nobjects.cup = "obs[4:7]"\n')
    pairs = [["the gripper is open", "go to the cup"]]
    (tmp_path / "plans.json").write_text(json.dumps({"stack-cup": pairs}))
    files = ("--task-file", tmp_path / "tasks.toml")
    tasks = lw.load_tasks(tmp_path / "tasks.toml")
    plans = lw.load_plans(tmp_path / "plans.json", tasks=tasks)
    both = lw.Plans({**plans, "reach": lw.load_plans("MT10")["reach"]})
    encoder = "--text-encoder", "my_texts:encode"
    for name, some in (("alone", plans), ("both", both)):
        actor = lw.PlanConditionedActor(some, width=8, text_encoder=read_encoder("my_texts:encode"))
        lw.save_actor(actor, tmp_path / f"{name}.safetensors")
    lacks = "the simulator has no stack-cup; tasks of your own run in a suite of yours"
    message = fails(capsys, "evaluate", tmp_path / "alone.safetensors", "--tasks", "stack-cup", *encoder)
    assert "got 'stack-cup'" in message
    assert "A task of your own is a Task with an engine=, see docs/training.md" in message
    assert f"TASK: {lacks}" in fails(capsys, "query", "stack-cup", *files)
    scripted = ("scripted", "stack-cup", "--plans", tmp_path / "plans.json", "--out", tmp_path)
    assert lacks in fails(capsys, *scripted, *files)
    message = fails(capsys, "evaluate", tmp_path / "alone.safetensors", *encoder)
    assert "the simulator has none of the policy's tasks, stack-cup; name others with --tasks" in message
    printed = run(capsys, "evaluate", tmp_path / "both.safetensors", "--episodes", 1, *encoder)
    assert printed.startswith("without stack-cup, which the simulator lacks\n")
    assert "A task of your own is a Task" in fails(capsys, "collect", "stack-cup", "--out", tmp_path / "demos")
    assert "did you mean 'reach'" in fails(capsys, "collect", "raech", "--out", tmp_path / "demos")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("my_texts", "--text-encoder must be like my_texts:encode"),
        ("my_texts:nothing", "names no function"),
        ("nowhere:encode", "names no function: No module named 'nowhere'"),
        ("my_texts:number", "must name a function, it names int"),
    ],
)
def test_an_encoder_that_is_none_is_refused(capsys, tmp_path, name, message):
    assert message in fails(
        capsys, "train", "demos", "--out", tmp_path / "p.safetensors", "--text-encoder", name, *TINY
    )
