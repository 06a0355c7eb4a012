"""Critics: values of states and of actions on the trunks of policies."""

import pytest
import torch
from small_actors import PLANS, letters, make_actor, make_rows
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.modules import ObservationFeatures, QValue, Value, descriptor_trunk, plan_trunk

SMALL = {"width": 8, "depth": 1}
TRUNKS = {"plan": lambda: plan_trunk(PLANS), "description": lambda: descriptor_trunk("MT10")}


def rows_of(*shape):
    return make_rows(*shape).set("action", torch.rand(*shape, 4, generator=torch.Generator().manual_seed(1)))


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize("kind", TRUNKS)
@pytest.mark.parametrize("make", [Value, QValue])
def test_ensemble_value_is_its_minimum(make, kind, shape):
    critic, rows = make(TRUNKS[kind](), ensemble=3, **SMALL).eval(), rows_of(*shape)
    output = critic(rows.clone())
    value, values = (output[key] for key in critic.out_keys)
    assert (value.shape, values.shape) == ((*shape, 1), (*shape, 3))
    assert torch.equal(value, values.amin(-1, keepdim=True))
    assert set(output.keys()) == {*rows.keys(), *critic.out_keys}, "what the trunk writes stays inside"
    assert (
        critic.out_keys
        == {Value: ["state_value", "state_values"], QValue: ["state_action_value", "state_action_values"]}[make]
    )


def test_the_value_of_an_action_depends_on_the_action():
    critic, rows = lw.PlanConditionedQValue(PLANS, **SMALL).eval(), rows_of(4)
    assert critic.in_keys == ["qaf", "task_id", "observation", "action"]
    other = rows.clone().set("action", -rows["action"])
    assert not torch.equal(critic(rows)["state_action_value"], critic(other)["state_action_value"])


def test_a_trunk_is_shared_with_the_actor():
    actor = make_actor(features=ObservationFeatures(), text_encoder=letters)
    critic = Value(actor.trunk, **SMALL)
    assert {id(one) for one in actor.mixer.parameters()} <= {id(one) for one in critic.parameters()}
    assert critic.plans is actor.plans
    critic(rows_of(4))["state_value"].sum().backward()
    assert all(weight.grad is not None for weight in actor.mixer.parameters())


@pytest.mark.parametrize("make", [Value, QValue])
def test_renamed_in_keys_leave_the_actor_on_the_same_trunk_unchanged(make):
    actor, rows = make_actor(), rows_of(4)
    critic = make(actor.trunk, **SMALL).eval()
    expected, action = critic(rows.clone())[critic.out_keys[0]], actor(rows.clone())["action"]
    critic.in_keys = [("critic", key) for key in critic.in_keys]
    moved = TensorDict({("critic", key): rows[key] for key in rows.keys()}, [4])
    assert torch.equal(critic(moved)[critic.out_keys[0]], expected)
    assert torch.equal(actor(rows.clone())["action"], action)
    assert {id(one) for one in actor.mixer.parameters()} <= {id(one) for one in critic.parameters()}


def test_action_key_may_be_nested():
    critic = lw.PlanConditionedQValue(PLANS, action_key=("agent", "action"), **SMALL)
    assert critic.in_keys[-1] == ("agent", "action")
    rows = rows_of(4)
    rows["agent", "action"] = rows.pop("action")
    assert critic(rows)["state_action_value"].shape == (4, 1)
