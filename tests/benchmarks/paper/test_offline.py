"""Offline experiments: runs have names of their own, and learn by every method."""

import json

import pytest

import lw_torchrl as lw
from benchmarks.paper.offline import BehaviourDataset, OfflineRun, offline_runs, write_table
from benchmarks.paper.recipes import MIXTURES, OFFLINE_METHODS, OFFLINE_TABLES, TASK_SETS, OfflineRecipe, Portion
from benchmarks.paper.runs import EVALUATION_SEED, execute_run
from lw_torchrl.data.collection_policy import BEHAVIOURS

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
