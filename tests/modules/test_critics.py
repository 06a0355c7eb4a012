"""Critics: values of states and of actions on the trunks of policies."""

import pytest
import torch
from small_actors import PLANS, make_actor, make_rows
from tensordict import TensorDict

from lw_torchrl.modules import QValue, Value, descriptor_trunk, plan_trunk

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
    name = "state_value" if make is Value else "state_action_value"
    assert critic.out_keys == [name, f"{name}s"]


@pytest.mark.parametrize("make", [Value, QValue])
def test_critic_with_renamed_keys_shares_the_trunk_of_an_actor(make):
    actor, rows = make_actor(), rows_of(4)
    keys = {"action_key": ("critic", "action")} if make is QValue else {}
    critic = make(actor.trunk, **keys, **SMALL).eval()
    assert critic.plans is actor.plans
    action = actor(rows.clone())["action"]
    expected = make(actor.trunk, **SMALL)
    expected.load_state_dict(critic.state_dict())
    expected = expected.eval()(rows.clone())[critic.out_keys[0]]
    critic.in_keys = [key if isinstance(key, tuple) else ("critic", key) for key in critic.in_keys]
    value = critic(TensorDict({("critic", key): rows[key] for key in rows.keys()}, [4]))[critic.out_keys[0]]
    assert torch.equal(value, expected)
    assert torch.equal(actor(rows.clone())["action"], action)
    value.sum().backward()
    assert all(weight.grad.any() for weight in actor.mixer.parameters())
    with pytest.raises(ValueError, match="in_keys"):
        critic.in_keys = []
