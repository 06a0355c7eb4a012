"""PlanConditionedActor: keys of its parts, mixing by hand, replaced parts, shared weights."""

import pytest
import torch
from small_actors import PLANS, action_of, letters, make_actor, make_role_actor, make_rows, rows_for
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import Decode, ObservationFeatures


@pytest.mark.parametrize("kind", ["raw", "differences", "relative", "both"])
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


def test_canonical_plans_and_the_refusal_of_others():
    assert make_actor().plans is PLANS
    canonical = lw.canonical_plans({"coffee-pull": lw.load_plans("MT50")["coffee-pull"]}, fallback=True)
    actor = make_role_actor(canonical)
    assert (actor.plans, actor.tasks, actor.in_keys) == (
        canonical,
        ("coffee-pull",),
        ["qaf", "task_id", "turn", "observation"],
    )
    rows = rows_for(actor, 6)
    assert actor(rows.clone())["action"].shape == (6, 4)
    written = lw.QAFTransform(lw.load_plans("MT50"))(make_rows(6, plans=canonical, answered=False))
    with pytest.raises(ValueError, match="coffee-pull"):
        actor(written)


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


def test_assigned_in_keys():
    actor, rows = make_actor(), make_rows(4)
    expected = action_of(actor, rows)
    trunk = actor.trunk
    actor.in_keys = [("plan", "truth"), "task_id", ("robot", "state")]
    moved = TensorDict({("plan", "truth"): rows["qaf"], ("robot", "state"): rows["observation"]}, [4])
    moved["task_id"] = rows["task_id"]
    assert torch.equal(action_of(actor, moved), expected)
    with pytest.raises(ValueError, match="truth"):
        actor(rows.copy())
    assert trunk(rows.copy())["features"].shape == (4, 56), "a trunk that shares the parts reads its own names"
    queries = lw.modules.transform_of(actor)
    assert (queries.in_keys, queries.out_keys[0]) == ([("robot", "state"), "task_id"], ("plan", "truth"))
    with pytest.raises(ValueError, match="in_keys"):
        actor.in_keys = ["observation"]


def other_plans():
    pairs = [
        ("the gripper is open", "move the gripper to the reach target"),
        ("the gripper is closed", "wait a little while"),
    ]
    return Plans([ConditionalPlan.from_pairs("reach", pairs), ConditionalPlan.from_pairs("sweep", pairs[:1])])


@pytest.mark.parametrize("training", [True, False])
def test_with_plans_keeps_statistics_and_mode(training):
    actor = make_actor(text_encoder=letters).train(training)
    actor.features.fit(make_rows(50))
    other = actor.with_plans(other_plans())
    assert (other.mixer.text_encoder, other.training) == (letters, training)
    other.features.fit(make_rows(50, seed=1))
    assert torch.equal(other.features.mean, actor.features.mean)
