"""AdvantageWeightedLoss and standardize_by_task: against sums by hand, and TorchRL's BCLoss."""

import math

import numpy as np
import pytest
import test_losses
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from test_losses import COMPILING, assert_one_graph_with_the_same_gradients
from torchrl.objectives import BCLoss

import lw_torchrl as lw

DISTANCES = ("l2", "l1", "smooth_l1")
FLOATS = st.floats(-100, 100, width=32)


def make_actor(kind="plan", distribution=None, **options):
    torch.manual_seed(0)
    return test_losses.make_actor(kind, distribution, noise=0.0, **options)


def make_batch(rows=12, seed=0, spread=2.0):
    advantage = torch.randn(rows, 1, generator=torch.Generator().manual_seed(seed)) * spread
    return test_losses.make_batch(rows, seed).exclude("next").set("advantage", advantage)


def distance(given, expected, name):
    off = abs(given - expected)
    if name == "l2":
        return off**2
    return off if name == "l1" else (off**2 / 2 if off < 1 else off - 0.5)


@pytest.mark.parametrize("distribution", [None, "normal", "tanh_normal"])
@pytest.mark.parametrize("name", DISTANCES)
@pytest.mark.parametrize("kind", ["plan", "description"])
def test_loss_by_hand(kind, name, distribution):
    actor, batch = make_actor(kind, distribution), make_batch()
    loss = lw.objectives.AdvantageWeightedLoss(actor, beta=1.5, max_weight=5.0, loss_function=name)
    actions = actor(batch.copy())["action"].double().tolist()
    exponentials = [math.exp(1.5 * advantage) for advantage in batch["advantage"].flatten().tolist()]
    weights, clipped, total = [min(each, 5.0) for each in exponentials], sum(each > 5.0 for each in exponentials), 0.0
    for row in range(12):
        off = [distance(a, b, name) for a, b in zip(actions[row], batch["action"][row].tolist(), strict=True)]
        total += weights[row] * sum(off) / 4
    result = loss(batch)
    np.testing.assert_allclose(result["loss_actor"].item(), total / sum(weights), rtol=1e-5)
    np.testing.assert_allclose(result["weight_clipped"].item(), clipped / 12, rtol=1e-6)
    np.testing.assert_allclose(result["ESS"].item(), sum(weights) ** 2 / sum(w**2 for w in weights) / 12, rtol=1e-5)
    assert 0 < clipped < 12
    assert not any(result[key].requires_grad for key in ("ESS", "weight_clipped"))


@pytest.mark.filterwarnings("ignore:.*target_actor_network_params")
@pytest.mark.parametrize("name", [*DISTANCES, "log_prob"])
def test_equal_advantages_give_torchrls_bc_loss(name):
    actor = make_actor(distribution="normal" if name == "log_prob" else None)
    batch = make_batch()
    expected = BCLoss(actor, loss_function=None if name == "log_prob" else name)(batch.copy())["loss_bc"]
    loss = lw.objectives.AdvantageWeightedLoss(actor, beta=2.0, loss_function=name)
    equal = batch.clone().set("advantage", torch.zeros(12, 1))
    torch.testing.assert_close(loss(equal)["loss_actor"], expected)
    assert loss(equal)["ESS"] == 1
    assert not torch.isclose(loss(batch)["loss_actor"], expected)
    unweighted = lw.objectives.AdvantageWeightedLoss(actor, beta=0.0, loss_function=name)
    torch.testing.assert_close(unweighted(batch)["loss_actor"], expected)
    assert unweighted(batch)["weight_clipped"] == 0


@pytest.mark.parametrize("name", ["l2", "log_prob"])
def test_gradients_reach_every_parameter_but_no_advantage(name):
    actor, batch = make_actor(distribution="tanh_normal" if name == "log_prob" else None), make_batch()
    loss = lw.objectives.AdvantageWeightedLoss(actor, loss_function=name)
    batch["advantage"].requires_grad_()
    loss(batch)["loss_actor"].backward()
    assert all(p.grad.abs().sum() > 0 for p in loss.parameters())
    assert batch["advantage"].grad is None


@settings(max_examples=30, deadline=None)
@given(advantages=st.lists(FLOATS, min_size=4, max_size=4), beta=st.floats(0, 5, width=32))
def test_loss_lies_within_those_of_its_rows_and_grows_with_their_weights(advantages, beta):
    """Also for huge advantages, whose weights must not all underflow."""
    batch = make_batch(4).set("advantage", torch.tensor(advantages).unsqueeze(-1))
    loss = lw.objectives.AdvantageWeightedLoss(ACTOR, beta=beta)
    result = loss(batch)
    rows = [lw.objectives.AdvantageWeightedLoss(ACTOR)(batch[i : i + 1])["loss_actor"].item() for i in range(4)]
    assert min(rows) - 1e-5 <= result["loss_actor"] <= max(rows) + 1e-5
    assert 0.25 - 1e-5 <= result["ESS"] <= 1 + 1e-5
    order = np.argsort(rows)
    best = batch.clone()  # the advantages in the order of the rows' own losses: no other order gives more
    best["advantage"][torch.from_numpy(order)] = batch["advantage"].sort(0).values
    assert loss(best)["loss_actor"] >= result["loss_actor"] - 1e-5


@COMPILING
@pytest.mark.parametrize(
    ("name", "distribution"),
    [("l2", None), *(pytest.param(name, "normal", marks=pytest.mark.slow) for name in ("smooth_l1", "log_prob"))],
)
def test_compiled_loss_is_one_graph_with_the_same_gradients(name, distribution):
    loss = lw.objectives.AdvantageWeightedLoss(make_actor(distribution=distribution), loss_function=name)
    assert_one_graph_with_the_same_gradients(loss, lambda run: [run(make_batch())["loss_actor"]])


def test_renamed_and_nested_keys():
    batch = make_batch()
    keys, out = [("agent", "task_id"), ("agent", "observation")], [("agent", "action")]
    plain = lw.objectives.AdvantageWeightedLoss(make_actor("description"))
    other = lw.objectives.AdvantageWeightedLoss(make_actor("description", in_keys=keys, out_keys=out))
    other.set_keys(action=("agent", "action"), advantage=("agent", "better"))
    renamed = batch.select("observation", "task_id", "action").set("better", batch["advantage"])
    renamed = TensorDict(agent=renamed, batch_size=[12])
    assert torch.equal(other(renamed)["loss_actor"], plain(batch)["loss_actor"])
    assert set(other.in_keys) == {*keys, ("agent", "action"), ("agent", "better")}
    with pytest.raises(ValueError, match="reward"):
        other.set_keys(reward="reward")


def test_in_keys_suffice_and_the_input_stays_unchanged():
    loss, batch = lw.objectives.AdvantageWeightedLoss(make_actor("description")), make_batch()
    before = batch.clone()
    expected = loss(batch)
    assert (batch == before).all()
    for key, value in zip(loss.out_keys, loss(**{key: batch[key] for key in loss.in_keys}), strict=True):
        assert torch.equal(value, expected[key])


ADVANTAGES = st.lists(st.tuples(st.integers(0, 3), FLOATS), min_size=1, max_size=20)


def tensors(rows):
    ids, advantages = zip(*rows, strict=True)
    return torch.tensor(advantages).unsqueeze(-1), torch.tensor(ids)


@settings(max_examples=50, deadline=None)
@given(rows=ADVANTAGES)
def test_standardized_advantages_by_hand(rows):
    result = lw.objectives.standardize_by_task(*tensors(rows))
    assert (result.shape, result.dtype) == ((len(rows), 1), torch.float32)
    for (task, advantage), one in zip(rows, result.squeeze(-1).tolist(), strict=True):
        own = np.array([np.float64(a) for t, a in rows if t == task])
        expected = 0.0 if (own == own[0]).all() else (advantage - own.mean()) / own.std()
        assert one == pytest.approx(expected, rel=1e-5, abs=1e-6)


@pytest.mark.parametrize("same", [0.1, 1e-30, -1e30])
def test_equal_advantages_of_a_task_become_zero(same):
    """The mean of seven times 0.1 is not 0.1, in floating point."""
    advantage = torch.full((7, 1), same)
    assert (lw.objectives.standardize_by_task(advantage, torch.zeros(7, dtype=torch.int64)) == 0).all()
    assert (lw.objectives.standardize_by_task(advantage, torch.arange(7)) == 0).all()
    assert lw.objectives.standardize_by_task(torch.zeros(0, 1), torch.zeros(0, dtype=torch.int64)).shape == (0, 1)


ACTOR = make_actor()


@pytest.mark.parametrize("distribution", [None, "normal"])
def test_reductions(distribution):
    batch, result = make_batch(spread=3.0), {}
    options = {"loss_function": "l2" if distribution is None else "log_prob"}
    actor = make_actor(distribution=distribution).eval()
    for reduction in ("none", "sum", "mean", None):
        loss = lw.objectives.AdvantageWeightedLoss(actor, beta=1.5, reduction=reduction, **options)
        result[reduction] = loss(batch)["loss_actor"]
    weights = (1.5 * batch["advantage"].squeeze(-1)).exp().clamp(max=20.0)
    assert result["none"].shape == (12,)
    torch.testing.assert_close(result["none"].sum(), result["sum"])
    torch.testing.assert_close(result["sum"] / weights.sum(), result["mean"])
    assert torch.equal(result["mean"], result[None])
    alone = lw.objectives.AdvantageWeightedLoss(actor, beta=0.0, **options)
    each = [alone(batch[row : row + 1])["loss_actor"] for row in range(12)]  # with the weight 1
    torch.testing.assert_close(result["none"], weights * torch.stack(each))
