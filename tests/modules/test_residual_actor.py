"""ResidualActor: at first its base's actions to the bit; then a correction that can be saved."""

from __future__ import annotations

import json

import pytest
import torch

import lw_torchrl as lw
from lw_torchrl.modules import make_policy
from lw_torchrl.training.checkpoint import check_can_be_saved

PLANS = lw.load_plans("MT10")
SMALL = {"width": 16, "depth": 1}


def make_base(method="pcbc", seed=0, **options):
    torch.manual_seed(seed)
    return make_policy(method, PLANS, feature_noise=0.3, **SMALL, **options)


def state(policy, rows=6):
    env = lw.LanguageWorldEnv(["push", "reach"], num_envs=rows)
    found = env.reset()
    env.close()
    transform = policy.transform()
    return found if transform is None else transform(found)


def disturb(actor):
    with torch.no_grad():
        actor.network[-1].weight.normal_()
    return actor


methods = pytest.mark.parametrize("method", ["pcbc", "dc", "one-hot"])


@methods
def test_at_first_it_does_what_its_base_does(method):
    base = make_base(method).eval()
    seen = state(base)
    expected = base(seen.copy())["action"]
    actor = lw.ResidualActor(base, **SMALL)
    for mode in (True, False):  # in training too: the base's features have no noise any more
        assert torch.equal(actor.train(mode)(seen.copy())["action"], expected)
    assert (actor.in_keys, actor.out_keys, actor.tasks) == (base.in_keys, ["action"], base.tasks)
    assert actor.plans is base.plans


@methods
def test_it_corrects_by_the_scale_at_most_and_stays_within_bounds(method):
    actor = disturb(lw.ResidualActor(make_base(method), scale=0.2, **SMALL))
    with torch.no_grad():
        actor.network[-1].weight.mul_(1e3)
    seen = state(actor)
    there = actor(seen.copy())["action"]
    more = there - actor.base(seen.copy())["action"]
    assert 0.19 < more.abs().max() <= 0.2 + 1e-6
    actor.base.head.network[-1].bias.data.fill_(9.0)
    assert actor(seen.copy())["action"].max() <= 1.0


def test_the_correction_sees_where_things_are_and_what_the_base_does():
    actor = disturb(lw.ResidualActor(make_base(), **SMALL))
    seen = state(actor)
    encoding = actor.base.encoder.encode(*actor.prepare(seen)).joined
    action = actor.base.head(encoding)
    expected = action + 0.3 * actor.network(torch.cat([encoding, action], -1)).tanh()
    torch.testing.assert_close(actor(seen)["action"], expected.clamp(-1, 1))


def test_only_the_correction_is_trained():
    actor = disturb(lw.ResidualActor(make_base(), **SMALL)).train()
    actor(state(actor))["action"].square().sum().backward()
    trained = {name for name, p in actor.named_parameters() if p.grad is not None}
    assert trained == {name for name, _ in actor.named_parameters() if name.startswith("network.")}
    assert trained == {name for name, p in actor.named_parameters() if p.requires_grad}


@methods
def test_it_is_saved_and_loaded(method, tmp_path):
    actor = disturb(lw.ResidualActor(make_base(method), scale=0.5, width=(16, 8)))
    check_can_be_saved(actor)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    again = lw.load_actor(tmp_path / "policy.safetensors")
    assert isinstance(again, lw.ResidualActor)
    assert json.dumps(again.describe()) == json.dumps(actor.describe())
    seen = state(actor)
    assert torch.equal(again(seen.copy())["action"], actor(seen.copy())["action"])
    result = lw.evaluate(again, tasks="reach", episodes_per_task=1, seed=0, max_steps=3, progress=False)
    assert result.mean_success in (0.0, 1.0)


def test_other_plans_have_the_same_weights():
    actor = disturb(lw.ResidualActor(make_base(), **SMALL)).eval()
    other = actor.with_plans(lw.load_plans("MT50"))
    assert other.tasks == lw.MT50
    assert other.network is actor.network
    assert not other.training
    seen, its = state(actor), state(other)
    torch.testing.assert_close(other(its)["action"], actor(seen)["action"])
    with pytest.raises(TypeError, match="with_plans is for policies with plans"):
        lw.ResidualActor(make_base("dc"), **SMALL).with_plans(PLANS)


def test_a_base_that_cannot_be_is_refused():
    with pytest.raises(TypeError, match=r"base must be a PlanConditionedActor or .* got ScriptedSkillActor"):
        lw.ResidualActor(lw.ScriptedSkillActor(PLANS))
    with pytest.raises(TypeError, match="got ResidualActor"):
        lw.ResidualActor(lw.ResidualActor(make_base(), **SMALL))
    with pytest.raises(ValueError, match="base must have no distribution, this one's is 'normal'"):
        lw.ResidualActor(make_base(distribution="normal"))
    with pytest.raises(ValueError, match="scale"):
        lw.ResidualActor(make_base(), scale=-1.0)


@pytest.mark.parametrize("kind", ["ResidualActor", "ActorEnsemble"])
def test_a_description_of_residuals_within_residuals_is_refused(kind):
    described = lw.ResidualActor(make_base(), **SMALL).describe()
    nested = {**described, "base": {**described, "kind": kind}}
    with pytest.raises(ValueError, match="the base of a residual must be a policy that is neither"):
        lw.ResidualActor.from_description(nested)
