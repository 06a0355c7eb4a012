"""``lw-torchrl train`` with an evaluator inside, from the beginning or from a trained policy; cameras too."""

from __future__ import annotations

import pytest
import torch
from commands import document, fails, run
from pictures import why_no_pictures

import lw_torchrl as lw

SMALL = ["--steps", 4, "--batch-size", 8]
NET = ["--width", 8, "--depth", 1]


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "reach"
    lw.collect_demonstrations("reach", episodes_per_task=2, root=root, max_steps=40, progress=False)
    return root


@pytest.fixture(scope="module")
def trained(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("trained")
    plans = lw.load_plans("MT10")
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(plans), sampler=lw.TaskBalancedSampler())
    actor = lw.PlanConditionedActor(plans, decoder=lw.modules.MLPDecoder(width=8, depth=1))
    config = lw.BehavioralCloningConfig(steps=5, batch_size=8)
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path / "policy.safetensors", progress=False).train()
    lw.training.save_evaluator(lw.StateQueryEvaluator(plans, width=8), path / "evaluator.safetensors")
    return path


def test_a_new_one_is_trained_with_the_policy(capsys, demos, tmp_path):
    out = tmp_path / "policy.safetensors"
    args = "train", demos, "--out", out, "--evaluator", "StateQueryEvaluator", "--qaf-anchor", 1, *SMALL, *NET
    assert document(capsys, *args)["steps"] == 4
    actor = lw.load_actor(out)
    assert isinstance(actor[0], lw.StateQueryEvaluator)
    assert actor[0].answers == "soft"
    assert "qaf" not in actor.in_keys


def test_a_trained_policy_is_tuned_with_one(capsys, demos, trained, tmp_path):
    out = tmp_path / "tuned.safetensors"
    args = [
        "--begin",
        trained / "policy.safetensors",
        "--evaluator",
        trained / "evaluator.safetensors",
        "--learning-rate",
        0.0,
    ]
    run(capsys, "train", demos, "--out", out, *args, *SMALL)
    actor = lw.load_actor(out)
    assert actor[0].answers == "hard"
    before, after = lw.load_actor(trained / "policy.safetensors").state_dict(), actor[1].state_dict()
    assert before.keys() == after.keys()
    for name, value in before.items():
        assert torch.equal(after[name], value), name
    again = tmp_path / "again.safetensors"
    run(capsys, "train", demos, "--out", again, "--begin", out, "--qaf-anchor", 0.1, *SMALL)
    moved, kept = lw.load_actor(again)[0].state_dict(), actor[0].state_dict()
    assert any(not torch.equal(moved[name], kept[name]) for name in kept)


def test_an_evaluator_that_does_not_fit_is_named(capsys, demos, trained, tmp_path):
    out = ["--out", tmp_path / "x.safetensors", *SMALL]
    file = ["--evaluator", trained / "evaluator.safetensors"]
    assert "no file" in fails(capsys, "train", demos, *out, "--evaluator", tmp_path / "none.safetensors")
    assert "no file" in fails(capsys, "train", demos, *out, "--begin", tmp_path / "none.safetensors")
    lw.save_actor(lw.DescriptorConditionedActor(["reach"]), tmp_path / "dc.safetensors")
    error = fails(capsys, "train", demos, *out, "--begin", tmp_path / "dc.safetensors", *file)
    assert "--evaluator requires a policy that reads qaf, --begin is a DescriptorConditionedActor" in error
    assert not (tmp_path / "x.safetensors").exists()


@pytest.mark.slow
def test_cameras(capsys, demos, tmp_path):
    if missing := why_no_pictures():
        pytest.skip(missing)
    out = tmp_path / "eyes"
    args = ["train-evaluator", "reach", "--out", out, "--data", demos, "--cameras", "corner", "--picture", 24]
    printed = run(capsys, *args, *SMALL, *NET, "--every", 4, "--held-out-pairs", 0)
    assert "trained to step 4" in printed
    plans = lw.load_plans("MT50")
    lw.save_plans({"reach": plans["reach"]}, tmp_path / "plans")
    reach = next((tmp_path / "plans").iterdir())
    policy = ["train", demos, "--out", tmp_path / "seeing.safetensors", "--plans", reach, *SMALL, *NET]
    run(capsys, *policy, "--evaluator", out / "evaluator.safetensors")
    found = run(capsys, "evaluate", tmp_path / "seeing.safetensors", "--tasks", "reach", "--episodes", 1)
    assert "reach" in found
