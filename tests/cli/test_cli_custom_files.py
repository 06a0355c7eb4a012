"""Custom tasks, plans, skills and text encoders, with the same options in every command."""

import json

import pytest
from cases import read_cases
from commands import fails, run

import lw_torchrl as lw

ENCODER = """
import torch
def encode(texts):
    return torch.tensor([[float(text.count(letter)) for letter in "abelot"] for text in texts])
def other(texts):
    return encode(texts).flip(-1)
"""
TINY = ("--steps", 5, "--width", 8, "--depth", 1)


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """Return a folder with custom files."""
    folder = tmp_path_factory.mktemp("own")
    for name, text in {**read_cases("cli/texts.toml")["custom"], "my_texts.py": ENCODER}.items():
        (folder / name).write_text(text)
    short = {"episodes_per_task": 1, "max_steps": 30, "progress": False}
    lw.collect_demonstrations(["push", "reach"], root=folder / "demos", **short)
    return folder


@pytest.fixture(autouse=True)
def work_in_the_folder(own, monkeypatch):
    monkeypatch.chdir(own)


def test_scripted_skills_carry_out_a_custom_plan(capsys, tmp_path):
    files = ("--plans", "reach.plan", "--skill-file", "skills.toml", "--task-file", "tasks.toml")
    options = ("--episodes", 3, "--max-steps", 120, "--noise", 0, "--out", tmp_path / "out")
    printed = run(capsys, "evaluate", "scripted", *files, *options)
    assert "reach: success 1.00" in printed
    assert "go to the ball" in printed
    assert len(json.loads((tmp_path / "out" / "results.json").read_text())["origin"]["plans"]) == 32
    query = ("query", "reach", "the gripper is not near the ball", "--task-file", "tasks.toml")
    assert "yes: the robot's gripper is not near the ball" in run(capsys, *query)


def test_a_policy_is_trained_with_custom_files(capsys, tmp_path):
    policy = tmp_path / "policy.safetensors"
    files = ("--plans", "reach.plan", "--task-file", "tasks.toml", "--text-encoder", "my_texts:encode")
    run(capsys, "train", "demos", "--out", policy, "--tasks", "reach", *files, *TINY, "--batch-size", 8)
    assert "text_encoder must be the encoder" in fails(capsys, "evaluate", policy, "--text-encoder", "my_texts:other")
    few = ("--text-encoder", "my_texts:encode", "--episodes", 1, "--max-steps", 20)
    run(capsys, "evaluate", policy, *few, "--out", tmp_path / "out")
    saved = json.loads((tmp_path / "out" / "results.json").read_text())
    assert saved["origin"]["checkpoint"]["path"] == str(policy)
    assert (tmp_path / "out" / "rollout.rrd").is_file()
    error = fails(capsys, "train", "demos", "--out", tmp_path / "p", "--text-encoder", "my_texts:nothing", *TINY)
    assert "--text-encoder" in error


def test_a_task_without_a_simulator_is_an_error(capsys, tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack-cup]\ndescription = "Stack."\nobjects.cup = "obs[4:7]"\n')
    (tmp_path / "plans.json").write_text(json.dumps({"stack-cup": [["the gripper is open", "go to the cup"]]}))
    plans = lw.load_plans(tmp_path / "plans.json", tasks=lw.load_tasks(tmp_path / "tasks.toml"))
    both = lw.Plans({**plans, "reach": lw.load_plans("MT10")["reach"]})
    for name, of_name in (("single", plans), ("both", both)):
        lw.save_actor(lw.PlanConditionedActor(of_name), tmp_path / f"{name}.safetensors")
    assert "stack-cup" in fails(capsys, "evaluate", tmp_path / "single.safetensors", "--tasks", "stack-cup")
    assert "no simulator" in fails(capsys, "evaluate", tmp_path / "single.safetensors")
    printed = run(capsys, "evaluate", tmp_path / "both.safetensors", "--episodes", 1, "--max-steps", 5)
    assert printed.startswith("evaluating 1 task of the policy's 2; use --tasks to choose others\n")
