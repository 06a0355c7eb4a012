"""PlanConditionedActor: keys, mixing by hand, shared weights, what is learned and what is refused."""

from __future__ import annotations

import warnings

import pytest
import torch
from tensordict import TensorDict
from torchrl.objectives import BCLoss

from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.language.text import encode_texts
from lw_torchrl.modules import PlanConditionedActor

SMALL = dict(latent_size=6, width=16, depth=1, encoder_width=12)
PLANS = load_plans("MT10")


def make_state(*shape, plans=PLANS, seed=0):
    generator = torch.Generator().manual_seed(seed)
    names = list(plans)
    ids = torch.tensor([task_id(name) for name in names])
    chosen = torch.randint(len(names), tuple(shape), generator=generator)
    lengths = torch.tensor([len(plans[name].steps) for name in names])[chosen]
    qaf = torch.rand(*shape, plans.num_steps, generator=generator) > 0.6
    return TensorDict(
        {
            "observation": torch.rand(*shape, 39, generator=generator),
            "task_id": ids[chosen],
            "qaf": qaf & (torch.arange(plans.num_steps) < lengths.unsqueeze(-1)),
        },
        shape,
    )


def make_actor(seed=0, plans=PLANS, **options):
    torch.manual_seed(seed)
    return PlanConditionedActor(plans, **{**SMALL, **options}).eval()


def make_loss(actor):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        return BCLoss(actor, loss_function="l2")


@pytest.mark.parametrize("features", ["raw", "differences", "relative", "both"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4)])
def test_it_writes_the_documented_keys_on_any_leading_shape(features, shape):
    actor = make_actor(features=features)
    state = make_state(*shape)
    given = state.clone()
    out = actor(state)
    assert actor.in_keys == ["observation", "task_id", "qaf"]
    assert actor.out_keys == ["action", "skill_weights", "skill_latent"]
    assert {key: out[key].shape for key in actor.out_keys} == {
        "action": (*shape, 4),
        "skill_weights": (*shape, PLANS.num_steps),
        "skill_latent": (*shape, 6),
    }
    assert all(out[key].dtype == torch.float32 for key in actor.out_keys)
    assert out["action"].abs().max() < 1
    torch.testing.assert_close(out["skill_weights"].sum(-1), torch.ones(shape))
    assert (out.select(*actor.in_keys) == given).all()


def test_it_can_be_called_with_tensors():
    state = make_state(5)
    actor = make_actor()
    action, weights, latent = actor(**state)
    assert torch.equal(action, actor(state)["action"])
    assert (weights.shape, latent.shape) == ((5, PLANS.num_steps), (5, 6))


def test_mixing_step_by_step_by_hand():
    actor = make_actor()
    state = make_state(12)
    out = actor(state.clone())
    for row in range(12):
        task = next(name for name in PLANS if task_id(name) == state["task_id"][row])
        steps = PLANS[task].steps
        truth = state["qaf"][row, : len(steps)].float()
        weights = torch.softmax(10 * truth - 5, 0)
        vectors = encode_texts([step.skill for step in steps])
        latents = actor.encoder.texts(vectors / vectors.square().mean(-1, keepdim=True).sqrt())  # numbers of size 1
        mixed = weights @ latents
        features = actor.encoder.features(state["observation"][row])
        action = actor.head(torch.cat((mixed, features), -1))
        torch.testing.assert_close(out["skill_weights"][row, : len(steps)], weights)
        torch.testing.assert_close(out["skill_latent"][row], mixed)
        torch.testing.assert_close(out["action"][row], action)


def test_the_plan_decides_what_is_done():
    """The same state, another condition true: another action."""
    actor = make_actor()
    state = make_state(1, seed=3)
    state["task_id"][:] = task_id("reach")
    actions = []
    for step in range(2):
        state["qaf"] = torch.arange(PLANS.num_steps).unsqueeze(0) == step
        actions.append(actor(state.clone())["action"])
    assert not torch.allclose(*actions, atol=1e-3)


def test_two_actors_of_one_seed_are_equal_and_a_call_repeats():
    state = make_state(7)
    one, other = make_actor(3), make_actor(3)
    assert torch.equal(one(state.clone())["action"], other(state.clone())["action"])
    assert torch.equal(one(state.clone())["action"], one(state.clone())["action"])
    assert not torch.equal(make_actor(4)(state.clone())["action"], one(state.clone())["action"])


def test_noise_is_on_the_features_while_training_and_only_then():
    state = make_state(7)
    actor, plain = make_actor(feature_noise=0.3), make_actor(feature_noise=0.0)
    assert torch.equal(actor(state.clone())["action"], plain(state.clone())["action"])
    assert torch.equal(plain.train()(state.clone())["action"], plain.eval()(state.clone())["action"])
    actor.train()
    one, other = actor(state.clone()), actor(state.clone())
    assert not torch.equal(one["action"], other["action"])
    assert torch.equal(one["skill_weights"], other["skill_weights"])
    assert torch.equal(one["skill_latent"], other["skill_latent"])


def test_depth_and_width_make_the_networks():
    def linears(module):
        return [(m.in_features, m.out_features) for m in module.modules() if isinstance(m, torch.nn.Linear)]

    actor = make_actor(latent_size=5, width=7, depth=2, encoder_width=9, encoder_depth=3, features="raw")
    assert linears(actor.encoder.texts) == [(384, 9), (9, 9), (9, 9), (9, 5)]
    assert linears(actor.head) == [(44, 7), (7, 7), (7, 4)]
    assert linears(make_actor(depth=0, encoder_depth=0, features="raw").head) == [(45, 4)]


# ---- other plans


def other_plans():
    pairs = [
        ("the gripper is open", "move the gripper to the reach target"),
        ("the gripper is closed", "wait a little while"),
    ]
    return Plans([ConditionalPlan.from_pairs("reach", pairs), ConditionalPlan.from_pairs("sweep", pairs[:1])])


def hashed(texts):
    """A text encoder of one's own: letters counted."""
    return torch.tensor([[float(text.count(letter)) for letter in "aeiou"] for text in texts])


def test_with_plans_shares_the_weights_both_ways():
    actor = make_actor(text_encoder=hashed)
    other = actor.with_plans(other_plans())
    ours, theirs = dict(actor.named_parameters()), dict(other.named_parameters())
    assert ours.keys() == theirs.keys()
    assert all(ours[name] is theirs[name] for name in ours)
    state, seen = make_state(4, plans=other_plans()), make_state(4)
    before, mine = other(state.clone())["action"], actor(seen.clone())["action"]
    for one, trained in ((actor, seen), (other, state)):
        optimizer = torch.optim.SGD(one.parameters(), 0.1)
        one(trained.clone())["action"].sum().backward()
        optimizer.step()
        optimizer.zero_grad()
        assert not torch.allclose(other(state.clone())["action"], before)
        assert not torch.allclose(actor(seen.clone())["action"], mine)
        before, mine = other(state.clone())["action"], actor(seen.clone())["action"]


def test_with_plans_follows_the_other_plans():
    actor = make_actor(text_encoder=hashed)
    other = actor.with_plans(other_plans())
    assert list(other.plans) == ["reach", "sweep"]
    out = other(make_state(6, plans=other_plans()))
    assert out["skill_weights"].shape == (6, 2)
    fresh = PlanConditionedActor(other_plans(), text_encoder=hashed, **SMALL).eval()
    fresh.load_state_dict(actor.state_dict())
    state = make_state(6, plans=other_plans())
    assert torch.equal(fresh(state.clone())["action"], other(state.clone())["action"])


@pytest.mark.parametrize("training", [True, False])
def test_with_plans_keeps_options_normalisation_and_mode(training):
    actor = make_actor(features="differences", text_encoder=hashed).train(training)
    actor.fit_normalization(make_state(50)["observation"])
    other = actor.with_plans(other_plans())
    assert other.config == actor.config
    assert other.encoder.text_encoder is hashed
    assert other.training is training
    assert torch.equal(other.encoder.features.mean, actor.encoder.features.mean)
    other.fit_normalization(make_state(50, seed=1)["observation"])
    assert torch.equal(other.encoder.features.mean, actor.encoder.features.mean)


def test_the_saved_state_holds_no_tables_of_the_plans():
    actor = make_actor(text_encoder=hashed)
    assert actor.state_dict().keys() == actor.with_plans(other_plans()).state_dict().keys()
    assert not any("skill" in key or "attention" in key for key in actor.state_dict())
    assert {key.split(".")[0] for key in actor.state_dict()} == {"encoder", "head"}


def test_a_text_encoder_of_ones_own():
    seen = []

    def encoder(texts):
        seen.append(tuple(texts))
        return hashed(texts).double()

    actor = make_actor(text_encoder=encoder)
    assert seen == [PLANS.skills]
    assert actor.skills == PLANS.skills
    assert actor.encoder.text_vectors.dtype == torch.float32
    assert next(actor.encoder.texts.parameters()).shape[1] == 5
    actor(make_state(3))["action"].sum().backward()


@pytest.mark.parametrize("shape", [(3, 5), (5,), ()])
def test_a_text_encoder_that_gives_another_number_of_vectors_is_refused(shape):
    with pytest.raises(ValueError, match=rf"text_encoder must give \({len(PLANS.skills)}, E\)"):
        make_actor(text_encoder=lambda texts: torch.zeros(shape))


# ---- learning


def make_batch(rows=64, seed=0):
    state = make_state(rows, seed=seed)
    target = torch.stack((state["observation"][:, 0], state["qaf"][:, 0].float(), -state["observation"][:, 5]), -1)
    return state.set("action", torch.cat((target, target[:, :1] * 0), -1) * 0.8)


def test_bc_loss_trains_it():
    actor = make_actor()
    loss, batch = make_loss(actor), make_batch()
    optimizer = torch.optim.Adam(loss.parameters(), 1e-2)
    values = []
    for _ in range(60):
        value = loss(batch.clone())["loss_bc"]
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        values.append(value.item())
    assert values[-1] < 0.2 * values[0]
    with torch.no_grad():
        error = (actor(batch.exclude("action"))["action"] - batch["action"]).square()
    assert error.mean() < 0.1, "the actor itself has learned, not a copy"


def test_the_gradient_reaches_every_weight():
    actor = make_actor()
    make_loss(actor)(make_batch(256))["loss_bc"].backward()
    for name, parameter in actor.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.abs().sum() > 0, name


def test_only_networks_are_trained():
    actor = make_actor()
    names = {name.split(".")[0] for name, _ in actor.named_parameters()}
    assert names == {"encoder", "head"}
    assert not any("mean" in name or "std" in name for name, _ in actor.named_parameters())


def test_the_normalisation_is_saved_with_the_actor():
    actor, other = make_actor(0), make_actor(1)
    actor.fit_normalization(make_state(50)["observation"] * 3 + 1)
    other.load_state_dict(actor.state_dict())
    state = make_state(6)
    assert torch.equal(other(state.clone())["action"], actor(state.clone())["action"])
    assert actor.encoder.features.mean.abs().sum() > 0


# ---- bad input


def broken(key, change, rows=3):
    state = make_state(rows)
    return TensorDict({**state, key: change(state[key])}, [rows])


def poke(index, value):
    def change(tensor):
        tensor = tensor.clone()
        tensor[index] = value
        return tensor

    return change


@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("observation", poke((1, 5), torch.nan), "observation must hold finite numbers"),
        ("observation", poke((0, 0), torch.inf), "observation must hold finite numbers"),
        ("observation", lambda x: x[:, :38], r"observation must be float32 of shape \(..., 39\).*\(3, 38\)"),
        ("observation", lambda x: x.double(), "observation must be float32.*float64"),
        ("qaf", lambda x: x[:, 1:], "qaf must have shape.*QAFTransform the same plans"),
        ("qaf", lambda x: torch.cat((x, x), -1), "qaf must have shape"),
        ("task_id", poke(0, task_id("sweep-into")), "without a plan.*: sweep-into"),
        ("task_id", poke(0, 50), "task_id.*50"),
        ("task_id", poke(0, -1), "task_id.*-1"),
        ("task_id", lambda x: x.float(), "task_id.*float32"),
        ("task_id", lambda x: x.unsqueeze(-1), "qaf must have shape"),
    ],
)
def test_wrong_input_is_named(key, change, message):
    with pytest.raises(ValueError, match=message):
        make_actor()(broken(key, change))


@pytest.mark.parametrize("wrong", [torch.nan, torch.inf])
def test_normalisation_cannot_be_fitted_to_what_are_no_numbers(wrong):
    actor = make_actor()
    with pytest.raises(ValueError, match="observation must hold finite numbers"):
        actor.fit_normalization(poke((2, 2), wrong)(make_state(5)["observation"]))
    actor(make_state(2))
