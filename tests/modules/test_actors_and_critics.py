"""Actors with plans, with descriptions and with scripted skills, and critics on the trunks of policies."""

import pytest
import torch
from small_actors import PLANS, action_of, letters, make_actor, make_descriptor, make_rows
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn

import lw_torchrl as lw
from lw_torchrl.language.tasks import MT50, TASKS, task_id
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import Decode, ObservationFeatures, QValue, Value, descriptor_trunk, plan_trunk

PUSH = lw.Plans([PLANS["push"]])


@pytest.mark.parametrize("kind", ["raw", "differences", "relative", "both", "opening", "none"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_documented_keys_for_any_leading_shape(kind, shape):
    actor = make_actor(features=ObservationFeatures(kind))
    rows = make_rows(*shape)
    out = actor(rows.copy())
    assert actor.in_keys == ["qaf", "task_id", "observation"]
    assert actor.out_keys == ["skill_weights", "skill_latent", "features", "action"]
    assert [out[key].shape for key in actor.out_keys] == [
        (*shape, size) for size in (PLANS.num_steps, 6, actor.features.width, 4)
    ]
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


@pytest.mark.parametrize("encoder", [None, letters])
def test_action_of_a_description_by_hand(encoder):
    actor, rows = make_descriptor(text_encoder=encoder), make_rows(8, answered=False)
    output = action_of(actor, rows)
    assert (actor.in_keys, actor.out_keys) == (["task_id", "observation"], ["task_latent", "features", "action"])
    assert torch.equal(action_of(actor, rows.reshape(2, 4)), output.reshape(2, 4, 4))
    for row in range(8):
        vector = (encoder or encode_texts)([TASKS[MT50[rows["task_id"][row]]].description])[0]
        latent = actor.latent.encoder(vector / vector.square().mean().sqrt())  # root mean square 1
        seen = torch.cat((latent, actor.features(rows["observation"][row])), -1)
        torch.testing.assert_close(output[row], actor.decoder.network(seen))


@pytest.mark.parametrize("condition", ["description", "one-hot"])
def test_each_task_has_its_own_action(condition):
    actor = make_descriptor("MT50", condition=condition)
    rows = TensorDict(observation=torch.rand(1, 39).expand(50, 39), task_id=torch.arange(50), batch_size=[50])
    assert len({tuple(action) for action in action_of(actor, rows).tolist()}) == 50


def test_weights_do_not_depend_on_the_known_tasks():
    one, other = make_descriptor("reach"), make_descriptor("MT10", seed=1)
    other.load_state_dict(one.state_dict())
    rows = make_rows(3).set("task_id", torch.full((3,), task_id("reach")))
    assert torch.equal(action_of(one, rows), action_of(other, rows))
    with pytest.raises(ValueError, match=r"task_id.*: push"):
        one(rows.set("task_id", torch.full((3,), task_id("push"))))


@pytest.mark.parametrize("rows", [1, 4])
@pytest.mark.parametrize("batch", [[], None])
def test_task_ids_may_be_a_column(rows, batch):
    actor, data = make_descriptor(), make_rows(rows)
    expected = action_of(actor, data)
    observation, column = data["observation"], data["task_id"].unsqueeze(-1)
    moved = TensorDict(observation=observation, task_id=column, batch_size=[rows] if batch is None else batch)
    assert torch.equal(action_of(actor, moved), expected)
    assert torch.equal(actor(observation=observation, task_id=column)[-1], expected)
    in_time = TensorDict(observation=observation.unsqueeze(1), task_id=column, batch_size=moved.batch_size)
    assert torch.equal(action_of(actor, in_time), expected.unsqueeze(1))


def acting(select, qaf, **options):
    """Return the actor's weights and actions, and those of each skill, in a random state of push for each row."""
    state = make_rows(len(qaf), plans=PUSH).set("qaf", torch.tensor(qaf))
    actor = lw.ScriptedSkillActor(PUSH, select, **options)
    out = actor(state)
    return out["skill_weights"], out["action"], actor.program(state["observation"], state["task_id"])


FIRST = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1], [1, 0, 0, 0]]
MEAN = [[1, 0, 0, 0], [0, 0.5, 0.5, 0], [0, 0, 0, 1], [0.25] * 4]


@pytest.mark.parametrize(("select", "expected"), [("first", FIRST), ("mix", MEAN)])
def test_true_steps_act_or_the_last_if_none_is_true(select, expected):
    weights, action, each = acting(select, [[1.0, 0, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0], [1, 1, 1, 1]])
    assert weights.tolist() == expected
    torch.testing.assert_close(action, (weights.unsqueeze(-1) * each).sum(-2))


def test_random_step_is_uniform_over_true_steps_and_depends_on_the_seed():
    qaf = [[False, True, True, True]] * 3000
    weights, _, _ = acting("random", qaf, seed=3)
    assert weights.sum(0).tolist() == pytest.approx([0, 1000, 1000, 1000], abs=100)
    assert torch.equal(weights, acting("random", qaf, seed=3)[0])
    assert not torch.equal(weights, acting("random", qaf, seed=4)[0])


@pytest.mark.parametrize("select", ["first", "mix", "random"])
def test_soft_truth_is_true_above_a_half(select):
    soft = [[0.1, 0.9, 0.4, 0.0], [0.6, 0.9, 0.1, 0.5], [0.5, 0.4, 0.1, 0.0]]
    weights = acting(select, soft, seed=5)[0]
    assert torch.equal(weights, acting(select, [[truth > 0.5 for truth in row] for row in soft], seed=5)[0])
    assert weights[::2].tolist() == [[0, 1, 0, 0], [0, 0, 0, 1]]


def test_padding_gets_no_weight():
    rows = make_rows(40)
    weights = lw.ScriptedSkillActor(PLANS)(rows.set("qaf", torch.zeros_like(rows["qaf"])))["skill_weights"]
    assert weights.argmax(-1).tolist() == [len(PLANS[MT50[task]].steps) - 1 for task in rows["task_id"]]


def test_plans_of_mt10_succeed():
    options = {"noise_scale": 0.0, "stop_at_success": True, "progress": False}
    result = lw.evaluate(lw.ScriptedSkillActor(PLANS), tasks="MT10", episodes_per_task=5, seed=31, **options)
    assert result.mean_success >= 0.98, result.table()


def test_custom_skills_and_other_plans(tmp_path):
    path = tmp_path / "skills.toml"
    path.write_text('["stay put"]\ntarget = "robot\'s gripper"\n')
    plans = lw.Plans([lw.ConditionalPlan.from_pairs("reach", [("the gripper is open", "stay put")])])
    actor = lw.ScriptedSkillActor(plans, skills=lw.load_skills(path))
    assert not actor(make_rows(1, plans=plans))["action"].any()
    assert actor.with_plans(plans).plans == actor.plans


SMALL = {"width": 8, "depth": 1}
TRUNKS = {"plan": lambda: plan_trunk(PLANS), "description": lambda: descriptor_trunk("MT10")}


@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
@pytest.mark.parametrize("kind", TRUNKS)
@pytest.mark.parametrize("make", [Value, QValue])
def test_ensemble_value_is_its_minimum(make, kind, shape):
    critic = make(TRUNKS[kind](), ensemble=3, **SMALL).eval()
    rows = make_rows(*shape).set("action", torch.rand(*shape, 4))
    output = critic(rows.clone())
    value, values = (output[key] for key in critic.out_keys)
    assert (value.shape, values.shape) == ((*shape, 1), (*shape, 3))
    assert torch.equal(value, values.amin(-1, keepdim=True))
    assert set(output.keys()) == {*rows.keys(), *critic.out_keys}, "what the trunk writes stays inside"
    name = "state_value" if make is Value else "state_action_value"
    assert critic.out_keys == [name, f"{name}s"]


@pytest.mark.parametrize("make", [Value, QValue])
def test_critic_with_renamed_keys_shares_the_trunk_of_an_actor(make):
    actor, rows = make_actor(), make_rows(4).set("action", torch.rand(4, 4))
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
