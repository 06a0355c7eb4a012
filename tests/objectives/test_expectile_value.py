"""ExpectileValueLoss: against sums by hand, and TorchRL's estimator and IQL loss."""

import copy

import numpy as np
import pytest
import test_losses
import torch
from tensordict import TensorDict
from test_losses import COMPILING, PLANS, SMALL, assert_one_graph_with_the_same_gradients
from torchrl.objectives import IQLLoss, SoftUpdate, ValueEstimators
from torchrl.objectives.value import TD0Estimator

import lw_torchrl as lw
from lw_torchrl.modules import ObservationFeatures, Value, descriptor_trunk

CRITICS = {
    "plan": lambda ensemble, **more: lw.PlanConditionedValue(PLANS, ensemble=ensemble, **SMALL, **more),
    "description": lambda ensemble, **more: Value(descriptor_trunk("MT10", **more), ensemble=ensemble, **SMALL),
}


def make_loss(kind="plan", ensemble=2, seed=0, gamma=0.9, **options):
    """Return a loss whose target network differs from its network, as during training."""
    torch.manual_seed(seed)
    features = ObservationFeatures(noise=options.pop("noise", 0.0))
    loss = lw.objectives.ExpectileValueLoss(CRITICS[kind](ensemble, features=features), **options)
    loss.make_value_estimator(gamma=gamma)
    if options.get("delay_value", True):
        SoftUpdate(loss, eps=0.9)
        for p in loss.parameters():
            p.data += 0.05 * torch.randn(p.shape)
    return loss


def make_batch(rows=12, seed=0, steps=True):
    batch, generator = test_losses.make_batch(rows, seed), torch.Generator().manual_seed(seed)
    flags = torch.rand(2, rows, 1, generator=generator) < 0.3
    batch["next"].update({"done": flags.any(0), "terminated": flags[0]})
    if steps:
        batch["steps_to_next_obs"] = torch.randint(1, 6, (rows,), generator=generator)
    return batch


def values_of(loss, params, state):
    """Return the network's values of states with these parameters, (B, E)."""
    network = copy.deepcopy(loss.value_network)
    params.data.to_module(network)
    key = "state_values" if len(network.heads) > 1 else "state_value"
    with torch.no_grad():
        return network(state.select(*network.in_keys))[key].double().numpy()


def by_hand(loss, batch, gamma=0.9, expectile=0.7):
    """Return the loss, the mean value, the priorities and the advantages, computed row by row."""
    values = values_of(loss, loss.value_network_params, batch)
    now, following = (values_of(loss, loss.target_value_network_params, s) for s in (batch, batch["next"]))
    total, priorities, advantages = 0.0, [], []
    for row in range(len(batch)):
        n = int(batch["steps_to_next_obs"][row]) if "steps_to_next_obs" in batch.keys() else 1
        alive = 1.0 - float(batch["next", "terminated"][row])
        target = float(batch["next", "reward"][row]) + gamma**n * alive * following[row].mean()
        advantages.append([target - now[row].mean()])
        errors = [target - value for value in values[row]]
        total += sum(abs(expectile - (error < 0)) * error**2 for error in errors)
        priorities.append(max(error**2 for error in errors))
    return total / len(batch), values.mean(), np.array(priorities), np.array(advantages)


@pytest.mark.parametrize("steps", [True, False])
@pytest.mark.parametrize("ensemble", [1, 2, 3])
@pytest.mark.parametrize("kind", CRITICS)
def test_loss_by_hand(kind, ensemble, steps):
    for expectile in (0.3, 0.7, 1.0):
        loss, batch = make_loss(kind, ensemble, expectile=expectile), make_batch(steps=steps)
        expected, value, priorities, advantages = by_hand(loss, batch, expectile=expectile)
        result = loss(batch)
        np.testing.assert_allclose(result["loss_value"].item(), expected, rtol=1e-5)
        np.testing.assert_allclose(result["value"].item(), value, rtol=1e-5)
        np.testing.assert_allclose(batch["td_error"].numpy(), priorities, rtol=1e-4, atol=1e-7)
        np.testing.assert_allclose(loss.advantage(batch).numpy(), advantages, rtol=1e-4, atol=1e-6)
        assert not any(value.requires_grad for value in (result["value"], batch["td_error"]))


def test_features_read_the_angle_of_a_turned_row():
    critic = lw.PlanConditionedValue(PLANS, features=lw.modules.FocusFeatures(PLANS), **SMALL)
    loss = lw.objectives.ExpectileValueLoss(critic, delay_value=False).make_value_estimator(gamma=0.9)
    turned = lw.RandomYaw(1.0)(make_batch().set("action", torch.zeros(12, 4)))
    assert loss(turned.copy())["value"] == critic(turned.copy())["state_value"].mean()
    assert loss(turned.exclude("observation_yaw"))["value"] != loss(turned)["value"]


def test_loss_is_iqls_expectile_of_the_td0_target():
    loss, batch = make_loss(ensemble=1, delay_value=False), make_batch()
    estimator = TD0Estimator(gamma=0.9, value_network=loss.get_stateful_net("value_network"))
    expected = estimator(batch.copy())
    torch.testing.assert_close(loss.advantage(batch), expected["advantage"])
    diff = expected["value_target"] - expected["state_value"]
    torch.testing.assert_close(loss(batch)["loss_value"], IQLLoss.loss_value_diff(diff, 0.7).mean())


@pytest.mark.parametrize("kind", CRITICS)
def test_gradients_reach_every_parameter_but_no_target(kind):
    loss, batch = make_loss(kind), make_batch()
    loss(batch)["loss_value"].backward()
    assert all(p.grad.abs().sum() > 0 for p in loss.parameters())
    targets = list(loss.target_value_network_params.values(True, True))
    assert targets
    assert not any(target.requires_grad or target.grad is not None for target in targets)
    assert not loss.advantage(batch).requires_grad


@COMPILING
@pytest.mark.slow
@pytest.mark.parametrize("kind", CRITICS)
def test_compiled_loss_is_one_graph_with_the_same_gradients(kind):
    def values(run):
        batch = make_batch()
        return [run(batch)["loss_value"], batch["td_error"]]

    assert_one_graph_with_the_same_gradients(make_loss(kind), values)


def test_renamed_and_nested_keys():
    keys = [("agent", "task_id"), ("agent", "observation")]
    names = {"value": ("agent", "v"), "values": ("agent", "vs"), "reward": ("agent", "gain"), "priority": "urgency"}
    names |= {"done": ("agent", "over"), "terminated": ("agent", "dead"), "steps_to_next_obs": ("agent", "n")}

    def make(in_keys=None, out_keys=None):
        torch.manual_seed(3)
        value = Value(descriptor_trunk("MT10"), ensemble=2, out_keys=out_keys, **SMALL)
        value.in_keys = in_keys or value.in_keys
        return lw.objectives.ExpectileValueLoss(value, delay_value=False)

    plain, other = make().make_value_estimator(gamma=0.9), make(keys, [names["value"], names["values"]])
    other.make_value_estimator(gamma=0.9)
    other.set_keys(**names)
    batch = make_batch()
    new = {"reward": "gain", "done": "over", "terminated": "dead", "steps_to_next_obs": "n"}
    parts = batch.exclude("next"), batch["next"]
    own, ahead = ({new.get(key, key): value for key, value in rows.items()} for rows in parts)
    renamed = TensorDict(agent=own, next={"agent": ahead}, batch_size=[12])
    assert torch.equal(other(renamed)["loss_value"], plain(batch)["loss_value"])
    assert torch.equal(renamed["urgency"], batch["td_error"])
    assert torch.equal(other.advantage(renamed), plain.advantage(batch))
    assert ("next", "agent", "gain") in other.in_keys
    again = make(keys, [names["value"], names["values"]])
    again.set_keys(**names)
    again.make_value_estimator(gamma=0.9)  # in the other order
    assert torch.equal(again(renamed)["loss_value"], plain(batch)["loss_value"])


def test_feature_noise_is_in_the_loss_but_not_in_advantages():
    loss, batch = make_loss(noise=0.3), make_batch()
    assert loss.value_network.training
    assert loss(batch)["loss_value"] != loss(batch)["loss_value"]
    assert torch.equal(loss.advantage(batch), loss.advantage(batch))
    quiet = make_loss()
    assert torch.equal(loss.advantage(batch), quiet.advantage(batch))
    assert loss.value_network.trunk.module["features"].training  # as it was
    loss.eval()
    assert torch.equal(loss(batch)["loss_value"], quiet(batch)["loss_value"])
    loss.train()
    assert loss(batch)["loss_value"] != loss(batch)["loss_value"]


def test_input_gains_only_td_error():
    loss, batch = make_loss(), make_batch()
    before = batch.clone()
    loss.advantage(batch)
    assert (batch == before).all()
    loss(batch)
    assert (batch.pop("td_error") >= 0).all()
    assert (batch == before).all()


def test_other_estimators():
    loss, batch = make_loss(), make_batch()
    expected = loss.advantage(batch)
    assert torch.equal(loss.make_value_estimator("td0", gamma=0.9).advantage(batch), expected)
    custom = TD0Estimator(gamma=0.9, value_network=None)
    assert torch.equal(loss.make_value_estimator(custom).advantage(batch), expected)
    with pytest.raises(NotImplementedError, match="TDLambda"):
        loss.make_value_estimator(ValueEstimators.TDLambda)


@pytest.mark.parametrize("weighted", [False, True])
def test_reductions(weighted):
    batch, result = make_batch(), {}
    if weighted:
        batch["priority_weight"] = torch.rand(12, generator=torch.Generator().manual_seed(0))
    for reduction in ("none", "sum", "mean", None):
        result[reduction] = make_loss(reduction=reduction)(batch.copy())["loss_value"]
    one_by_one = [make_loss()(batch[row : row + 1].exclude("priority_weight"))["loss_value"] for row in range(12)]
    weights = batch["priority_weight"] if weighted else torch.ones(12)
    torch.testing.assert_close(result["none"], torch.stack(one_by_one) * weights)
    torch.testing.assert_close(result["sum"], result["none"].sum())
    torch.testing.assert_close(result["mean"], result["sum"] / weights.sum())
    assert torch.equal(result["mean"], result[None])
