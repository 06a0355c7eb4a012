"""StochasticActor: TorchRL's sampling on our trunks, as a copy of a trained actor."""

from functools import partial

import pytest
import torch
from small_actors import CANONICAL, make_actor, make_descriptor, make_role_actor, make_rows
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import ExplorationType, set_exploration_type

from lw_torchrl.modules import Concat, FocusFeatures, ObservationFeatures, RoleFeatures


def trained(kind="plan", **options):
    """Return a deterministic actor with fitted statistics and noisy features."""
    make = make_actor if kind == "plan" else partial(make_descriptor, condition=kind)
    actor = make(features=ObservationFeatures(noise=0.3), **options)
    actor.features.fit(make_rows(50, seed=9))
    return actor


def make(kind="plan", distribution="tanh_normal", init_std=0.3, **options):
    return trained(kind, **options).stochastic(distribution, init_std=init_std)


def drawn(actor, rows, seed=0):
    torch.manual_seed(seed)
    with set_exploration_type(ExplorationType.RANDOM):
        return actor(rows.clone())


by_kind = pytest.mark.parametrize("kind", ["plan", "description", "one-hot"])
by_distribution = pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])


@by_kind
@by_distribution
@pytest.mark.parametrize("shape", [(), (5,), (2, 3)])
def test_documented_keys_and_log_probabilities(kind, distribution, shape):
    actor, rows = make(kind, distribution), make_rows(*shape)
    assert isinstance(actor, ProbabilisticTensorDictSequential)
    out = drawn(actor, rows)
    assert actor.out_keys[-4:] == ["loc", "scale", "action", "action_log_prob"]
    assert [out[key].shape for key in actor.out_keys[-4:]] == [(*shape, 4)] * 3 + [shape]
    torch.testing.assert_close(actor.get_dist(rows.clone()).log_prob(out["action"]), out["action_log_prob"])
    torch.testing.assert_close(actor.build_dist_from_params(out).log_prob(out["action"]), out["action_log_prob"])
    torch.testing.assert_close(actor.log_prob(out.clone()), out["action_log_prob"])


@by_distribution
def test_actions_are_drawn_only_under_exploration(distribution):
    actor, rows = make(distribution=distribution), make_rows(5)
    assert torch.equal(actor(rows.clone())["action"], actor(rows.clone())["action"])
    assert not torch.equal(drawn(actor, rows)["action"], actor(rows.clone())["action"])
    assert not torch.equal(drawn(actor, rows, 1)["action"], drawn(actor, rows)["action"])
    assert torch.equal(drawn(actor, rows)["action"], drawn(actor, rows)["action"])
    many = make_rows(1).expand(20_000).clone()
    median = drawn(actor, many)["action"].median(0).values
    torch.testing.assert_close(median, actor(many[:1].clone())["action"][0], atol=0.02, rtol=0)


@by_kind
@by_distribution
def test_copy_has_the_actors_action_as_mode(kind, distribution):
    before, rows = trained(kind), make_rows(5)
    actor = before.stochastic(distribution, init_std=0.2)
    torch.testing.assert_close(actor(rows.clone())["action"], before(rows.clone())["action"])
    torch.testing.assert_close(actor(rows.clone())["scale"], torch.full((5, 4), 0.2))
    weights = [weight.clone() for weight in before.parameters()]
    for weight in actor.parameters():
        weight.data.add_(1.0)
    assert all(torch.equal(old, new) for old, new in zip(weights, before.parameters(), strict=True))


def test_feature_noise_is_off_in_likelihoods():
    features = Concat(ObservationFeatures(noise=0.2), FocusFeatures(CANONICAL, 0.2), RoleFeatures(CANONICAL, 0.2))
    before = make_actor(CANONICAL, features=features)
    actor, rows = before.stochastic().train(), make_rows(50, plans=CANONICAL)
    first, second = (actor.get_dist(rows.clone()).log_prob(torch.zeros(50, 4)) for _ in range(2))
    assert torch.equal(first, second)
    assert [part.noise for part in before.features.parts] == [0.2, 0.2, 0.2]


def test_contacts_are_copied():
    before = make_role_actor()
    before.features.contact.fill_(0.1)
    actor = before.stochastic()
    before.features.contact.fill_(0.2)
    assert torch.equal(actor.module["features"].contact, torch.full_like(before.features.contact, 0.1))
