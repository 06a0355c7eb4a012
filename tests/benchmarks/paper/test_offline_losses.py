"""TorchRL's offline losses with imitation by l1: what the actor minimises."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import SoftUpdate

import lw_torchrl as lw
from benchmarks.paper.offline_losses import L1CQLLoss, L1IQLLoss, L1TD3BCLoss

PLANS = lw.Plans([lw.load_plans("MT10")[task] for task in ("drawer-open", "reach")])
SMALL = {"width": 16, "depth": 1}
TASKS = torch.tensor([lw.task_id(task) for task in PLANS]).repeat_interleave(4)
DISTRIBUTIONS = {"iql": "normal", "td3-bc": None, "cql": "tanh_normal"}


def make(name, alpha):
    torch.manual_seed(0)
    features, decoder = lw.modules.ObservationFeatures(), lw.modules.MLPDecoder(**SMALL)
    actor = lw.PlanConditionedActor(PLANS, features=features, decoder=decoder)
    if DISTRIBUTIONS[name] is not None:
        actor = actor.stochastic(DISTRIBUTIONS[name])
    q, value = lw.PlanConditionedQValue(PLANS, **SMALL), lw.PlanConditionedValue(PLANS, **SMALL)
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
    loss, n = make(name, alpha=0.0), len(TASKS)
    rows = TensorDict(observation=torch.rand(n, 39), task_id=TASKS, action=torch.rand(n, 4) * 2 - 1)
    batch = lw.QAFTransform(PLANS)(rows.auto_batch_size_(1))
    with loss.actor_network_params.to_module(loss.actor_network, preserve_module_state=False):
        acted = loss.actor_network(batch.exclude("action"))
    if name != "td3-bc":
        acted["action"] = loss.actor_network.build_dist_from_params(acted).deterministic_sample
    imitation = (acted["action"] - batch["action"]).abs().mean()
    torch.testing.assert_close(loss.actor_loss(batch.clone())[0], imitation)
    loss = make(name, alpha=1.0)
    with_values, _ = loss.actor_loss(batch.clone())
    assert not torch.equal(with_values, imitation)
    with_values.backward()
    reached = {key.partition(".")[0] for key, value in loss.named_parameters() if value.grad is not None}
    assert reached == {"actor_network_params"}
