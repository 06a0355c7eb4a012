"""PlanConditionedActor: keys of its parts, mixing by hand, replaced parts, shared weights."""

import pytest
import torch
from small_actors import PLANS, action_of, make_actor, make_rows
from tensordict.nn import TensorDictModule
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import Decode, ObservationFeatures


@pytest.mark.parametrize("kind", ["raw", "differences", "relative", "both", "opening", "none"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_documented_keys_for_any_leading_shape(kind, shape):
    actor = make_actor(features=ObservationFeatures(kind))
    rows = make_rows(*shape)
    out = actor(rows.copy())
    assert actor.in_keys == ["qaf", "task_id", "observation"]
    assert actor.out_keys == ["skill_weights", "skill_latent", "features", "action"]
    assert {key: out[key].shape for key in actor.out_keys} == {
        "skill_weights": (*shape, PLANS.num_steps),
        "skill_latent": (*shape, 6),
        "features": (*shape, actor.features.width),
        "action": (*shape, 4),
    }
    assert all(out[key].dtype == torch.float32 for key in actor.out_keys)
    assert out["action"].abs().max() < 1
    torch.testing.assert_close(out["skill_weights"].sum(-1), torch.ones(shape))
    assert (out.select(*actor.in_keys) == rows).all()


def test_action_by_hand():
    actor, rows = make_actor(), make_rows(12)
    out = actor(rows.copy())
    for row in range(12):
        steps = PLANS[lw.MT50[rows["task_id"][row]]].steps
        weights = torch.softmax(10 * rows["qaf"][row, : len(steps)].float() - 5, 0)
        vectors = encode_texts([step.skill for step in steps])
        latents = actor.mixer.encoder(vectors / vectors.square().mean(-1, keepdim=True).sqrt())
        mixed = weights @ latents
        features = actor.features(rows["observation"][row])
        torch.testing.assert_close(out["skill_weights"][row, : len(steps)], weights)
        torch.testing.assert_close(out["skill_latent"][row], mixed)
        torch.testing.assert_close(out["action"][row], actor.decoder.network(torch.cat((mixed, features), -1)))


def test_assigned_part_is_used():
    actor, rows = make_actor(), make_rows(5)
    actor.decoder = net = nn.Sequential(nn.LazyLinear(4), nn.Tanh())
    assert (actor.decoder.network, type(actor.decoder)) == (net, Decode)
    out = actor(rows.copy())
    encoding = torch.cat((out["skill_latent"], out["features"]), -1)
    assert torch.equal(out["action"], net(encoding))
    assert {id(one) for one in net.parameters()} <= {id(one) for one in actor.parameters()}
    actor.features = nn.Linear(39, actor.features.width)
    assert (type(actor.features), actor.features.out_keys) == (TensorDictModule, ["features"])
    assert not torch.equal(action_of(actor, rows), out["action"])
    actor.features = TensorDictModule(nn.Linear(3, 56), in_keys=["hand"], out_keys=["features"])
    assert actor.in_keys == ["qaf", "task_id", "hand"]
    with pytest.raises(TypeError, match="decoder"):
        actor.decoder = 3
