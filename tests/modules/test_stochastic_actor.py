"""Actors with a distribution: what they write, when they draw, and one made of a trained one."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import ExplorationType, TransformedEnv, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import ValueEstimators

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
SMALL = dict(width=16, depth=1)


def make(kind="plan", distribution="tanh_normal", **options):
    options = {**SMALL, "distribution": distribution, **options}
    if kind == "plan":
        return lw.PlanConditionedActor(PLANS, **options)
    return lw.DescriptorConditionedActor("MT10", condition=kind, **options)


def make_state(rows=5, seed=0, plans=PLANS):
    generator = torch.Generator().manual_seed(seed)
    ids = torch.tensor([lw.task_id(task) for task in PLANS])[torch.randint(10, (rows,), generator=generator)]
    state = TensorDict(observation=torch.rand(rows, 39, generator=generator), task_id=ids)
    return lw.QAFTransform(plans)(state.auto_batch_size_())


def drawn(actor, state, seed=0):
    torch.manual_seed(seed)
    with set_exploration_type(ExplorationType.RANDOM):
        return actor(state.clone())


by_kind = pytest.mark.parametrize("kind", ["plan", "description", "one-hot"])
by_distribution = pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])


@by_kind
@by_distribution
@pytest.mark.parametrize("rows", [(), (5,), (2, 3)])
def test_what_it_writes(kind, distribution, rows):
    actor = make(kind, distribution)
    state = make_state(max(1, torch.Size(rows).numel()))
    state = (state[0] if rows == () else state.reshape(rows)).clone()
    out = drawn(actor, state)
    assert actor.out_keys[-3:] == ["loc", "scale", "action_log_prob"]
    assert {key: tuple(out[key].shape) for key in ("action", "loc", "scale", "action_log_prob")} == {
        "action": (*rows, 4),
        "loc": (*rows, 4),
        "scale": (*rows, 4),
        "action_log_prob": rows,
    }
    torch.testing.assert_close(actor.get_dist(state).log_prob(out["action"]), out["action_log_prob"])
    torch.testing.assert_close(actor.build_dist_from_params(out).log_prob(out["action"]), out["action_log_prob"])


@by_distribution
def test_it_draws_under_exploration_alone(distribution):
    actor, state = make(distribution=distribution), make_state()
    assert torch.equal(actor(state.clone())["action"], actor(state.clone())["action"])
    assert not torch.equal(drawn(actor, state)["action"], actor(state.clone())["action"])
    assert not torch.equal(drawn(actor, state, 1)["action"], drawn(actor, state)["action"])
    assert torch.equal(drawn(actor, state)["action"], drawn(actor, state)["action"])
    many = make_state(1).expand(20_000).clone()
    found = drawn(actor, many)["action"]
    wanted = actor(many[:1].clone())["action"]
    middle = found.median(0).values
    torch.testing.assert_close(middle, wanted[0], atol=0.02, rtol=0)


@by_kind
@by_distribution
def test_one_made_of_a_trained_one_does_the_same(kind, distribution):
    trained = make(kind, None)
    trained.fit_normalization(torch.randn(50, 39))
    state = make_state()
    actor = trained.eval().stochastic(distribution, init_std=0.2)
    assert type(actor) is type(trained)
    torch.testing.assert_close(actor(state.clone())["action"], trained(state.clone())["action"])
    torch.testing.assert_close(actor(state.clone())["scale"], torch.full((5, 4), 0.2))
    before = [p.clone() for p in trained.parameters()]
    for p in actor.parameters():
        p.data.add_(1.0)
    assert all(torch.equal(a, b) for a, b in zip(before, trained.parameters(), strict=True)), "a copy"
    with pytest.raises(ValueError, match=f"this actor has one already, '{distribution}'"):
        actor.stochastic()


def test_features_have_no_noise_that_would_change_the_likelihood():
    actor, state = make().train(), make_state()
    assert torch.equal(actor(state.clone())["loc"], actor(state.clone())["loc"])
    assert make("plan", None).config["feature_noise"] == 0.05
    trained = make("plan", None, feature_noise=0.3)
    assert trained.stochastic().config["feature_noise"] == 0.0
    assert make(feature_noise=0.1).config["feature_noise"] == 0.1, "asked for"


@by_kind
@by_distribution
def test_it_is_saved_and_loaded_like_any(kind, distribution, tmp_path):
    actor = make(kind, distribution, init_std=0.7)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    state = make_state()
    out, ours = loaded(state.clone()), actor.eval()(state.clone())
    assert all(torch.equal(out[key], ours[key]) for key in actor.out_keys)
    assert loaded.config == actor.config


def test_it_can_be_pickled_and_copied():
    actor, state = make(), make_state()
    for other in (pickle.loads(pickle.dumps(actor)), copy.deepcopy(actor)):
        assert torch.equal(other(state.clone())["loc"], actor(state.clone())["loc"])


def test_keys_of_ones_own():
    names = ["a", "weights", "latent", ("d", "loc"), ("d", "scale"), "lp"]
    actor = make(out_keys=names)
    assert (actor.dist_params_keys, actor.log_prob_keys, actor.dist_sample_keys) == (names[3:5], ["lp"], ["a"])
    out = drawn(actor, make_state())
    assert set(names) <= set(out.keys(True, True))
    assert actor.spec["a"].shape == (4,)
    moved = make("plan", None, out_keys=[("agent", "action"), "w", "l"]).stochastic()
    assert moved.log_prob_keys == [("agent", "action_log_prob")]
    assert moved.spec["agent", "action"].shape == (4,)


def test_without_a_distribution_that_is_said():
    actor = make("plan", None)
    for ask in (lambda: actor.get_dist(make_state()), actor.as_sequential):
        with pytest.raises(TypeError, match="has no distribution; make it with distribution='tanh_normal'"):
            ask()
    assert (actor.log_prob_keys, actor.dist_sample_keys, actor.dist_params_keys) == ([], [], [])


def test_a_trained_one_is_evaluated_and_collects(tmp_path):
    actor = make().eval()
    result = lw.evaluate(actor, tasks="push", episodes_per_task=1, seed=1_000, max_steps=5)
    assert result.mean_success == 0.0
    env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"]), actor.transform())
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(4, actor)
    env.close()
    assert data["action_log_prob"].shape == (2, 4)


def test_nothing_random_is_left_in_the_likelihoods_of_one_made_of_a_trained_one():
    trained = make("plan", None, roles=True, focus=True, jitter=0.03, swap_unmentioned=0.5)
    actor, state = trained.stochastic().train(), make_state(50, plans=trained.plans)
    first, second = (actor.get_dist(state).log_prob(torch.zeros(50, 4)) for _ in range(2))
    assert torch.equal(first, second)


@by_kind
@by_distribution
def test_as_torchrls_own_it_is_the_same_to_the_bit(kind, distribution):
    actor, state = make(kind, distribution), make_state()
    own = actor.as_sequential()
    assert isinstance(own, ProbabilisticTensorDictSequential)
    assert (own.in_keys, sorted(own.out_keys), own.spec) == (actor.in_keys, sorted(actor.out_keys), actor.spec)
    for name in ("dist_params_keys", "dist_sample_keys", "log_prob_keys"):
        assert getattr(own, name) == getattr(actor, name), name
    for mode in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC):
        found = []
        for each in (actor, own, copy.deepcopy(own)):
            torch.manual_seed(0)
            with set_exploration_type(mode):
                found.append(each(state.clone()))
        assert all(torch.equal(found[0][key], other[key]) for key in actor.out_keys for other in found)
    done = found[0]
    assert torch.equal(own.log_prob(done.clone()), actor.log_prob(done))
    assert torch.equal(actor.log_prob(done), done["action_log_prob"])
    assert torch.equal(actor.log_prob(done, dist=actor.build_dist_from_params(done)), done["action_log_prob"])
    for p in own.parameters():
        p.data.add_(1.0)
    assert not torch.equal(actor(state.clone())["loc"], done["loc"]), "the weights are the actor's"


@pytest.mark.parametrize("chosen", [["action"], ["scale", "action"], ["skill_weights"]])
def test_selected_keys_do_not_move_the_distributions(chosen):
    actor, state = make(), make_state()
    everything = drawn(actor, state)
    actor.select_out_keys(*chosen)
    assert (actor.dist_params_keys, actor.log_prob_keys) == (["loc", "scale"], ["action_log_prob"])
    assert actor.dist_sample_keys == ["action"]
    assert torch.equal(actor.log_prob(everything), everything["action_log_prob"])
    assert torch.equal(
        actor.build_dist_from_params(everything).log_prob(everything["action"]), everything["action_log_prob"]
    )
    assert actor.get_dist_params(state.clone())["scale"].equal(everything["scale"])
    assert actor.spec["action"].shape == (4,)


def test_new_names_move_them():
    actor = make()
    actor.out_keys = [("new", key) for key in actor.out_keys]
    found = drawn(actor, make_state())
    assert actor.dist_params_keys == [("new", "loc"), ("new", "scale")]
    assert torch.equal(actor.log_prob(found), found["new", "action_log_prob"])
    assert actor.as_sequential().dist_params_keys == actor.dist_params_keys
    with pytest.raises(ValueError, match="out_keys must be a list of 6, in this order: action, skill_weights"):
        actor.out_keys = ["action"]


def test_v_trace_takes_it():
    actor, value = lw.modules.plan_actor_value(PLANS, **SMALL)
    rows = drawn(actor, make_state(6)).detach().reshape(1, 6)
    flag = torch.zeros(1, 6, 1, dtype=torch.bool)
    rows["next"] = (
        make_state(6, 1).reshape(1, 6).update({"reward": torch.ones(1, 6, 1), "done": flag, "terminated": flag})
    )
    loss = ClipPPOLoss(actor, value)
    loss.make_value_estimator(ValueEstimators.VTrace)
    assert loss(rows)["loss_objective"].isfinite()
