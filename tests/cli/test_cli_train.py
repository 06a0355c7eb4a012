"""``lw-torchrl train`` with offline losses and evaluators, and ``train-evaluator``."""

import csv
import json
import re
from functools import partial

import pytest
import torch
from commands import document, fails, run
from pictures import why_no_pictures
from speed import first_fast

import lw_torchrl as lw
from lw_torchrl.cli.main import main

SMALL = ["--steps", 4, "--batch-size", 8]
NET = ["--width", 8, "--depth", 1]
SHORT = {"episodes_per_task": 2, "max_steps": 40, "progress": False}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noisy"
    lw.collect_demonstrations(["push", "reach"], root=root, policy="noisy-60", **SHORT)
    return root


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("demos") / "reach"
    lw.collect_demonstrations("reach", root=root, **SHORT)
    return root


@pytest.fixture(scope="module")
def trained(demos, tmp_path_factory):
    """Return a folder with a trained policy and an evaluator."""
    path = tmp_path_factory.mktemp("trained")
    plans = lw.load_plans("MT10")
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(plans), sampler=lw.TaskBalancedSampler())
    actor = lw.PlanConditionedActor(plans, decoder=lw.modules.MLPDecoder(width=8, depth=1))
    config = lw.BehavioralCloningConfig(steps=5, batch_size=8)
    lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path / "policy.safetensors", progress=False).train()
    lw.training.save_evaluator(lw.modules.StateQueryEvaluator(plans, width=8), path / "evaluator.safetensors")
    return path


@pytest.mark.parametrize("loss", first_fast(["iql", "advantage", "td3-bc", "cql"]))
def test_an_offline_loss_trains_a_policy_and_resumes(capsys, noisy, tmp_path, loss):
    out = tmp_path / "policy.safetensors"
    args = ("train", noisy, "--out", out, "--loss", loss, *SMALL, *NET)
    assert "trained to step 4, loss" in run(capsys, *args)
    assert f"trained to step 4: {out}" in run(capsys, *args)
    actor = lw.load_actor(out)
    assert actor.decoder.network.config["width"] == 8
    assert hasattr(actor, "get_dist") is (loss in ("iql", "cql"))
    assert re.search(r"- training: loss \w+Loss, reward dense_cost, steps 4,", run(capsys, "info", out))
    assert lw.evaluate(actor, tasks="reach", episodes_per_task=1, seed=1000, max_steps=5, progress=False)


def test_success_rates_are_evaluated_and_logged_while_training(capsys, noisy, tmp_path, monkeypatch):
    monkeypatch.setattr(lw, "evaluate", partial(lw.evaluate, max_steps=20))
    out = tmp_path / "policy.safetensors"
    options = ["--loss", "td3-bc", "--evaluate-every", 2, "--evaluate-episodes", 1, "--logger", "csv"]
    main(list(map(str, ["train", noisy, "--out", out, *options, *SMALL, *NET])))
    printed = capsys.readouterr().err
    for step in (2, 4):
        assert re.search(rf"step {step}: success [01]\.\d{{3}} \(1 episode of each task, seed 1000\)", printed)
    (file,) = (tmp_path / "logs").rglob("evaluation/success.csv")
    rows = list(csv.reader(file.read_text().splitlines()))
    assert [int(step) for step, _ in rows] == [2, 4]
    assert all(0.0 <= float(rate) <= 1.0 for _, rate in rows)
    error = fails(capsys, "train", noisy, "--out", tmp_path / "x", "--evaluate-every", 2, "--evaluate-seed", 0)
    assert "--evaluate-seed 0" in error


def test_options_are_checked_before_anything_is_read(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("lw_torchrl.cli.train.find_spec", lambda name: None)
    train = "train", tmp_path / "nothing", "--out", tmp_path / "x.safetensors"
    assert "pip install wandb" in fails(capsys, *train, "--logger", "wandb")
    assert "--qaf-anchor" in fails(capsys, *train, "--loss", "iql", "--qaf-anchor", 1)


def test_a_new_evaluator_is_trained_with_the_policy(capsys, demos, tmp_path):
    out = tmp_path / "policy.safetensors"
    args = "train", demos, "--out", out, "--evaluator", "StateQueryEvaluator", "--qaf-anchor", 1, *SMALL, *NET
    assert document(capsys, *args)["steps"] == 4
    actor = lw.load_actor(out)
    assert isinstance(actor[0], lw.modules.StateQueryEvaluator)
    assert actor[0].answers == "soft"
    assert "qaf" not in actor.in_keys


def test_a_trained_policy_is_fine_tuned_with_an_evaluator(capsys, demos, trained, tmp_path):
    out, again = tmp_path / "tuned.safetensors", tmp_path / "again.safetensors"
    begin, evaluator = trained / "policy.safetensors", trained / "evaluator.safetensors"
    fixed = ("--begin", begin, "--evaluator", evaluator, "--learning-rate", 0.0)
    run(capsys, "train", demos, "--out", out, *fixed, *SMALL)
    actor = lw.load_actor(out)
    assert actor[0].answers == "hard"
    before, after = lw.load_actor(begin).state_dict(), actor[1].state_dict()
    assert before.keys() == after.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    run(capsys, "train", demos, "--out", again, "--begin", out, "--qaf-anchor", 0.1, *SMALL)
    moved, kept = lw.load_actor(again)[0].state_dict(), actor[0].state_dict()
    assert any(not torch.equal(moved[name], kept[name]) for name in kept)


def test_missing_files_and_unsuitable_policies_are_errors(capsys, demos, trained, tmp_path):
    out = ["--out", tmp_path / "x.safetensors", *SMALL]
    for option in ("--evaluator", "--begin"):
        assert "none.safetensors" in fails(capsys, "train", demos, *out, option, tmp_path / "none.safetensors")
    lw.save_actor(lw.modules.DescriptorConditionedActor(["reach"]), tmp_path / "dc.safetensors")
    file = ["--evaluator", trained / "evaluator.safetensors"]
    error = fails(capsys, "train", demos, *out, "--begin", tmp_path / "dc.safetensors", *file)
    assert "--evaluator requires a policy that reads qaf" in error
    assert not (tmp_path / "x.safetensors").exists()


@pytest.mark.slow
def test_train_evaluator_writes_an_evaluator_and_a_report(capsys, tmp_path):
    out, policy = tmp_path / "evaluator", tmp_path / "scripted.safetensors"
    plans = lw.load_plans("MT10")
    lw.save_actor(lw.ScriptedSkillActor(lw.Plans([plans["push"], plans["reach"]])), policy)
    small = ["--steps", 20, "--batch-size", 64, *NET, "--episodes", 2, "--behaviours", "random"]
    args = ["train-evaluator", "push", "reach", "--out", out, "--held-out-tasks", "reach", *small]
    printed = run(capsys, *args)
    assert "trained to step 20, loss 0." in printed
    assert "held-out tasks" in printed
    report = json.loads((out / "report.json").read_text())
    assert report["about"]["held_out_tasks"] == ["reach"]
    assert set(report["parts"]) == {"states", "queries", "tasks"}
    before = (out / "evaluator.safetensors").read_bytes()
    again = document(capsys, *args)
    assert (again["loss"], again["parts"]) == (None, report["parts"])
    assert (out / "evaluator.safetensors").read_bytes() == before
    file, result = out / "evaluator.safetensors", tmp_path / "result"
    run(capsys, "evaluate", policy, "--evaluator", file, "--episodes", 1, "--tasks", "reach", "--out", result)
    assert json.loads((result / "results.json").read_text())["origin"]["evaluator"]["path"] == str(file)
    rows = run(capsys, "train-evaluator", "push", "--out", tmp_path / "b", "--data", out / "data" / "random", *small)
    assert "trained queries" in rows
    assert not (tmp_path / "b" / "data").exists()


@pytest.mark.slow
def test_an_evaluator_of_pictures_is_trained_and_used(capsys, demos, tmp_path):
    if reason := why_no_pictures():
        pytest.skip(reason)
    out = tmp_path / "eyes"
    args = ["train-evaluator", "reach", "--out", out, "--data", demos, "--cameras", "corner", "--picture", 24]
    printed = run(capsys, *args, *SMALL, *NET, "--every", 4, "--held-out-pairs", 0)
    assert "trained to step 4" in printed
    lw.save_plans({"reach": lw.load_plans("MT50")["reach"]}, tmp_path / "plans")
    plan = next((tmp_path / "plans").iterdir())
    policy = ["train", demos, "--out", tmp_path / "seeing.safetensors", "--plans", plan, *SMALL, *NET]
    run(capsys, *policy, "--evaluator", out / "evaluator.safetensors")
    assert "reach" in run(capsys, "evaluate", tmp_path / "seeing.safetensors", "--tasks", "reach", "--episodes", 1)
