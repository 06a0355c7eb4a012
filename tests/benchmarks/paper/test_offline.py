"""Offline experiments: runs have different names, and learn by every method; losses whose actor imitates by l1."""

import json
from unittest.mock import patch

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw
from benchmarks.paper import recipes
from benchmarks.paper.offline import BehaviourDataset, OfflineRun, offline_runs, write_table
from benchmarks.paper.offline_losses import L1CQLLoss, L1IQLLoss, L1TD3BCLoss
from benchmarks.paper.recipes import MIXTURES, OFFLINE_METHODS, OFFLINE_TABLES, TASK_SETS, OfflineRecipe, Portion
from benchmarks.paper.runs import EVALUATION_SEED, execute_run
from lw_torchrl.data.collection_policy import BEHAVIOURS

PLANS = lw.load_plans("MT10")
TINY = OfflineRecipe(steps=6, value_steps=6, batch_size=10, width=16, depth=1, critic_depth=1)


SMALL = {**MIXTURES, "tiny": (Portion("expert", 1), Portion("wrong", 2), Portion("random", 2))}


def tiny(method="advantage", actor="pcbc", critic="pcbc", recipe=TINY):
    # The expert opens the door within 85 steps, but not the drawer.
    return OfflineRun("two", "tiny", 0, recipe, 85, method, actor, critic, episodes=1)


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    with patch.object(recipes, "MIXTURES", SMALL):
        yield tmp_path_factory.mktemp("offline")


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
    assert "1 expert, 2 wrong, 2 random" in text
    assert "advantage, plan - filtered-bc, plan:" in text
    assert {*json.loads((out / "quick.json").read_text())["tiny"]["methods"]} == {run.label for run in runs}
    assert (out / "quick.png").stat().st_size > 10_000


TWO = lw.Plans([PLANS[task] for task in ("drawer-open", "reach")])
SIZE = {"width": 16, "depth": 1}
TASKS = torch.tensor([lw.task_id(task) for task in TWO]).repeat_interleave(4)
DISTRIBUTIONS = {"iql": "normal", "td3-bc": None, "cql": "tanh_normal"}


def make_l1(name, alpha):
    torch.manual_seed(0)
    features, decoder = lw.modules.ObservationFeatures(), lw.modules.MLPDecoder(**SIZE)
    actor = lw.PlanConditionedActor(TWO, features=features, decoder=decoder)
    if DISTRIBUTIONS[name] is not None:
        actor = actor.stochastic(DISTRIBUTIONS[name])
    q, value = lw.PlanConditionedQValue(TWO, **SIZE), lw.PlanConditionedValue(TWO, **SIZE)
    pair = {"num_qvalue_nets": 2, "loss_function": "l2"}
    if name == "iql":
        loss = L1IQLLoss(actor, q, value, temperature=alpha, max_weight=20.0, **pair)
        SoftUpdate(loss, eps=0.995)
        return loss
    if name == "td3-bc":
        return L1TD3BCLoss(actor, q, bounds=(-1.0, 1.0), alpha=alpha, delay_actor=True, **pair)
    return L1CQLLoss(actor, q, alpha=alpha, loss_function="l2", num_random=1, alpha_init=1e-9)


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_actor_imitates_by_l1_and_values_change_only_the_actor(name):
    loss, n = make_l1(name, alpha=0.0), len(TASKS)
    rows = TensorDict(observation=torch.rand(n, 39), task_id=TASKS, action=torch.rand(n, 4) * 2 - 1)
    batch = lw.QAFTransform(TWO)(rows.auto_batch_size_(1))
    with loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
        acted = loss.actor_network(batch.exclude("action"))
    if name != "td3-bc":
        acted["action"] = loss.actor_network.build_dist_from_params(acted).deterministic_sample
    imitation = (acted["action"] - batch["action"]).abs().mean()
    torch.testing.assert_close(loss.actor_loss(batch.clone())[0], imitation)
    loss = make_l1(name, alpha=1.0)
    with_values, _ = loss.actor_loss(batch.clone())
    assert not torch.equal(with_values, imitation)
    with_values.backward()
    reached = {key.partition(".")[0] for key, value in loss.named_parameters() if value.grad is not None}
    assert reached == {"actor_network_params"}
