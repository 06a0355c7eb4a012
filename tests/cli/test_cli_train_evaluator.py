"""``lw-torchrl train-evaluator``, and what it leaves in an evaluation."""

from __future__ import annotations

import json

import pytest
from commands import document, run

import lw_torchrl as lw

SMALL = ["--steps", 20, "--batch-size", 64, "--width", 16, "--depth", 1, "--episodes", 2, "--behaviours", "random"]


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    path = tmp_path_factory.mktemp("policy") / "scripted.safetensors"
    plans = lw.load_plans("MT10")
    lw.save_actor(lw.ScriptedSkillActor(lw.Plans([plans["push"], plans["reach"]])), path)
    return path


def test_it_is_trained_reported_and_used(capsys, tmp_path, policy):
    out = tmp_path / "evaluator"
    args = ["train-evaluator", "push", "reach", "--out", out, "--held-out-tasks", "reach", *SMALL]
    printed = run(capsys, *args)
    assert "trained to step 20, loss 0." in printed
    assert "held-out tasks" in printed
    report = json.loads((out / "report.json").read_text())
    assert report["about"]["held_out_tasks"] == ["reach"]
    assert set(report["parts"]) == {"states", "queries", "tasks"}
    before = (out / "evaluator.safetensors").read_bytes()
    assert "trained to step 20\n" in run(capsys, *args)
    told = document(capsys, *args)
    assert (told["loss"], told["parts"]) == (None, report["parts"])
    assert (out / "evaluator.safetensors").read_bytes() == before
    found = run(
        capsys, "evaluate", policy, "--evaluator", out / "evaluator.safetensors", "--episodes", 1, "--tasks", "reach",
        "--out", tmp_path / "result",
    )  # fmt: skip
    assert "reach" in found
    saved = json.loads((tmp_path / "result" / "results.json").read_text())
    assert saved["origin"]["evaluator"]["path"] == str(out / "evaluator.safetensors")
    rows = run(capsys, "train-evaluator", "push", "--out", tmp_path / "b", "--data", out / "data" / "random", *SMALL)
    assert "trained queries" in rows
    assert not (tmp_path / "b" / "data").exists()
