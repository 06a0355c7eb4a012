"""Offline experiments: runs have names of their own, learn by every method, and resume to the same policy."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

import lw_torchrl as lw
from benchmarks.paper.offline import DISTRIBUTIONS, BehaviourDataset, OfflineRun, offline_runs, write_table
from benchmarks.paper.recipes import MIXTURES, OFFLINE_METHODS, OFFLINE_TABLES, TASK_SETS, OfflineRecipe, Portion
from benchmarks.paper.runs import EVALUATION_SEED, execute_run
from lw_torchrl.data.collection_policy import BEHAVIOURS
from lw_torchrl.data.dataset import read_metadata

PLANS = lw.load_plans("MT10")
TINY = OfflineRecipe(steps=6, value_steps=6, batch_size=10, width=16, depth=1, critic_depth=1)


def tiny(method="advantage", actor="pcbc", critic="pcbc", recipe=TINY):
    # A few wrong skills open a drawer within 120 steps.
    return OfflineRun("two", "W", 0, recipe, 120, method, actor, critic, episodes=1)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    out = tmp_path_factory.mktemp("offline")
    for dataset in tiny().datasets:
        dataset.collect(out, progress=False)
    return out


def test_runs_and_datasets_have_different_names():
    tables = [table for name, table in OFFLINE_TABLES.items() if name != "quick"]
    runs = {run for table in tables for run in offline_runs(table, (0, 1), OfflineRecipe(), 20)}
    advantages = {run.advantages for run in runs} - {None}
    for members in (runs, advantages):
        assert len({one.folder for one in members}) == len(members)
        assert len({json.dumps(one.describe(PLANS), sort_keys=True) for one in members}) == len(members)
    folders = {name: {dataset.folder for dataset in OfflineRun("five", name, 0).datasets} for name in MIXTURES}
    assert folders["W"] < folders["B"]
    seeds = [BehaviourDataset("five", Portion(who, 1), seed).options["seed"] for who in BEHAVIOURS for seed in (0, 99)]
    assert len({*seeds}) == len(seeds)
    assert max(seeds) < EVALUATION_SEED


def test_tables_compare_their_methods():
    for table in OFFLINE_TABLES.values():
        for rows in table.rows.values():
            assert rows[0] == ("advantage", "pcbc", "pcbc")
            assert len({*rows}) == len(rows)
    assert {row[0] for row in OFFLINE_TABLES["methods"].rows["B"]} == {*OFFLINE_METHODS}
    assert {method.loss for method in OFFLINE_METHODS.values()} == {*DISTRIBUTIONS}


def test_data_have_the_mixtures_behaviours(out):
    for dataset in tiny().datasets:
        config = read_metadata(out / dataset.folder).config
        assert (config.behaviour, config.tasks) == (dataset.portion.behaviour, TASK_SETS["two"])
        assert config.episodes_per_task == dataset.portion.episodes


@pytest.mark.parametrize("method", OFFLINE_METHODS)
@pytest.mark.parametrize(("actor", "critic"), [("pcbc", "pcbc"), pytest.param("dc", "one-hot", marks=pytest.mark.slow)])
def test_every_method_learns_and_is_evaluated_once(out, method, actor, critic, monkeypatch):
    run = tiny(method, actor, critic)
    result = execute_run(run, PLANS, out, progress=False)
    assert {*result.success_once} == {*TASK_SETS["two"]}
    assert lw.load_actor(out / run.folder / "policy.safetensors").tasks == TASK_SETS["two"]
    assert not (out / run.folder / "checkpoint.safetensors").exists()
    monkeypatch.setattr(OfflineRun, "learn", None)
    assert execute_run(run, PLANS, out, progress=False).episodes == result.episodes


def test_advantages_are_standardised_by_task_and_depend_on_the_critic(out):
    advantages = [tiny(critic=critic).advantages.make(PLANS, out, False) for critic in ("pcbc", "dc", "one-hot")]
    for first, second in pairwise(advantages):
        assert not torch.equal(first["advantage"], second["advantage"])
    roots = [out / dataset.folder for dataset in tiny().datasets]
    task = lw.LanguageWorldExperienceReplay(roots, label="executed", terminate_on_success=True)[:]["task_id"]
    for number in task.unique():
        rows = advantages[0]["advantage"][task == number].double()
        assert abs(rows.mean().item()) < 1e-4
        assert abs(rows.std(correction=0).item() - 1) < 1e-3


def test_run_stopped_anywhere_ends_with_the_same_policy(out, tmp_path, monkeypatch):
    run = tiny()
    expected = execute_run(run, PLANS, out, progress=False)
    shutil.copytree(out / "data", tmp_path / "data")
    real = lw.OfflineTrainer.step
    for stop in (4, 5):  # in the training of the value, then of the policy
        left = [stop]

        def step(self, left=left):
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            return real(self)

        monkeypatch.setattr(lw.OfflineTrainer, "step", step)
        with pytest.raises(KeyboardInterrupt):
            execute_run(run, PLANS, tmp_path, progress=False)
    monkeypatch.setattr(lw.OfflineTrainer, "step", real)
    assert execute_run(run, PLANS, tmp_path, progress=False).success_once == expected.success_once
    ours, theirs = (lw.load_actor(root / run.folder / "policy.safetensors").state_dict() for root in (tmp_path, out))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


def test_results_and_advantages_of_another_recipe_raise(out):
    execute_run(tiny(), PLANS, out, progress=False)
    other = tiny(recipe=replace(TINY, beta=1.5))
    with pytest.raises(ValueError, match=r"results.json' is of another configuration, it differs in recipe.beta"):
        execute_run(other, PLANS, out, progress=False)
    with pytest.raises(ValueError, match=r"its run differs in recipe.beta"):
        other.advantages.make(PLANS, out, progress=False)


def test_table_shows_means_and_differences(out):
    runs = [tiny(), tiny("filtered-bc"), tiny("bc", "dc")]
    results = {run: execute_run(run, PLANS, out, progress=False) for run in runs}
    head = write_table("quick", runs, results, out)
    for run in runs:
        assert f"{run.label} " in head
        assert f"{results[run].mean_success:.3f}" in head
    text = (out / "quick.md").read_text()
    assert "20 noisy-30, 20 wrong, 10 random" in text
    assert "advantage, plan - filtered-bc, plan:" in text
    assert {*json.loads((out / "quick.json").read_text())["W"]["methods"]} == {run.label for run in runs}
    assert (out / "quick.png").stat().st_size > 10_000
