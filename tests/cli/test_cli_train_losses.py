"""``lw-torchrl train --loss``: offline losses on any data, and evaluations while training."""

from __future__ import annotations

import csv
import re

import pytest
from commands import fails, run

import lw_torchrl as lw
from lw_torchrl.cli.main import main

SMALL = ["--steps", 4, "--batch-size", 8, "--width", 8, "--depth", 1]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("data") / "noisy"
    lw.collect_demonstrations(
        ["push", "reach"], episodes_per_task=2, root=root, policy="spoilt-60", max_steps=40, progress=False
    )
    return root


@pytest.mark.parametrize(
    "loss", ["iql", *(pytest.param(loss, marks=pytest.mark.slow) for loss in ("advantage", "td3-bc", "cql"))]
)
def test_a_policy_is_learned_offline_and_resumes(capsys, data, tmp_path, loss):
    out = tmp_path / "policy.safetensors"
    printed = run(capsys, "train", data, "--out", out, "--loss", loss, *SMALL)
    assert "trained to step 4, loss" in printed
    assert f"trained to step 4: {out}" in run(capsys, "train", data, "--out", out, "--loss", loss, *SMALL)
    actor = lw.load_actor(out)
    assert actor.decoder.network.config["width"] == 8
    assert hasattr(actor, "get_dist") is (loss in ("iql", "cql"))
    card = run(capsys, "info", out)
    assert re.search(r"- training: loss \w+Loss, reward dense_cost, steps 4,", card)
    assert lw.evaluate(actor, tasks="reach", episodes_per_task=1, seed=1000, max_steps=5, progress=False)


def test_success_on_held_out_seeds_is_logged(capsys, data, tmp_path):
    out = tmp_path / "policy.safetensors"
    options = ["--loss", "td3-bc", "--evaluate-every", 2, "--evaluate-episodes", 1, "--logger", "csv"]
    main(list(map(str, ["train", data, "--out", out, *options, *SMALL])))
    printed = capsys.readouterr().err
    for step in (2, 4):
        assert re.search(rf"step {step}: success [01]\.\d{{3}} \(1 episode of each task, seed 1000\)", printed)
    (file,) = (tmp_path / "logs").rglob("evaluation/success.csv")
    rows = list(csv.reader(file.read_text().splitlines()))
    assert [int(step) for step, _ in rows] == [2, 4]
    assert all(0.0 <= float(rate) <= 1.0 for _, rate in rows)
    error = fails(capsys, "train", data, "--out", tmp_path / "x", "--evaluate-every", 2, "--evaluate-seed", 0)
    assert "--evaluate-seed 0 is the seed of the demonstrations" in error


def test_options_of_bc_alone_are_refused(capsys, data, tmp_path):
    out = ["--out", tmp_path / "policy.safetensors", "--loss", "iql", *SMALL]
    assert "only apply to --loss bc" in fails(capsys, "train", data, *out, "--qaf-anchor", 1)
    assert "--answers requires --evaluator" in fails(capsys, "train", data, *out, "--answers", "hard")
