"""The baselines that imitate by l1: what is minimised, which networks it reaches, and that no task's scale counts."""

from __future__ import annotations

import pytest
import torch
from lw_torchrl.paper.offline_losses import L1CQLLoss, L1IQLLoss, L1TD3BCLoss, in_deviations_of_task
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw

PLANS = lw.Plans([lw.load_plans("MT10")[task] for task in ("drawer-open", "reach")])
SMALL = {"width": 16, "depth": 1}
TASKS = torch.tensor([lw.task_id(task) for task in PLANS]).repeat_interleave(4)


def networks(distribution):
    torch.manual_seed(0)
    small = dict(width=16, depth=1)
    actor = lw.PlanConditionedActor(PLANS, **{**SMALL, "feature_noise": 0.0, "distribution": distribution})
    return actor, lw.PlanConditionedQValue(PLANS, **small), lw.PlanConditionedValue(PLANS, **small)


def make(name, alpha=0.0):
    pair = {"num_qvalue_nets": 2, "loss_function": "l2"}
    if name == "iql":
        loss = L1IQLLoss(*networks("normal"), temperature=alpha, max_weight=20.0, **pair)
        SoftUpdate(loss, eps=0.995)
        return loss
    if name == "td3-bc":
        actor, q, _ = networks(None)
        return L1TD3BCLoss(actor, q, bounds=(-1.0, 1.0), alpha=alpha, delay_actor=True, **pair)
    actor, q, _ = networks("tanh_normal")
    return L1CQLLoss(actor, q, alpha=alpha, loss_function="l2", num_random=1, alpha_init=1e-9)


def rows():
    torch.manual_seed(1)
    found = TensorDict(observation=torch.rand(len(TASKS), 39), task_id=TASKS, action=torch.rand(len(TASKS), 4) * 2 - 1)
    return lw.QAFTransform(PLANS)(found.auto_batch_size_(1))


@pytest.mark.parametrize("name", ["iql", "td3-bc", "cql"])
def test_without_values_the_actor_imitates_by_l1(name):
    loss, batch = make(name), rows()
    with loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
        acted = loss.actor_network(batch.exclude("action"))
    if name != "td3-bc":
        acted["action"] = loss.actor_network.build_dist_from_params(acted).deterministic_sample
    expected = (acted["action"] - batch["action"]).abs().mean()
    torch.testing.assert_close(loss.actor_loss(batch.clone())[0], expected)


@pytest.mark.parametrize("name", ["iql", "td3-bc", "cql"])
def test_values_change_the_actor_and_the_actor_changes_no_values(name):
    loss, batch = make(name, alpha=1.0), rows()
    found, _ = loss.actor_loss(batch.clone())
    assert not torch.equal(found, make(name).actor_loss(batch.clone())[0])
    found.backward()
    reached = {key.partition(".")[0] for key, value in loss.named_parameters() if value.grad is not None}
    assert reached == {"actor_network_params"}


def test_no_tasks_scale_counts():
    q = torch.randn(len(TASKS), 1)
    scale = (1.0 + TASKS.float()).unsqueeze(-1)
    torch.testing.assert_close(in_deviations_of_task(q * scale, TASKS), in_deviations_of_task(q, TASKS))
