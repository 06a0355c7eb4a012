"""Plans in reserve: the default plan's steps behind a plan's own, attended to in their own turns alone."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.canonical import read_canonical, with_reserve
from lw_torchrl.transforms import FallbackTurns, QAFTransform

MT10, MT50 = lw.load_plans("MT10"), lw.load_plans("MT50")
SMALL = {"width": 8, "depth": 1, "latent_size": 4, "encoder_width": 8, "feature_noise": 0.0}
ROLES = {"roles": True, "features": "none", **SMALL}


def make(plans=MT50, **options):
    torch.manual_seed(0)
    return lw.PlanConditionedActor(plans, **ROLES, **options).eval()


def states(actor, turn=None, task="dial-turn", rows=200):
    torch.manual_seed(1)
    state = TensorDict(observation=torch.rand(rows, 39), task_id=torch.full((rows,), lw.task_id(task)))
    state = actor.transform()(state.auto_batch_size_())
    return state if turn is None else state.set("turn", torch.full((rows,), turn))


def test_its_plans_end_with_the_default_plans_steps():
    actor = make(reserve=True)
    for task, plan in actor.plans.items():
        own, other = read_canonical(MT50[task]), fallback_plan(task)
        skills = [step.skill for step in own.steps]
        if skills != [step.skill for step in other.steps]:
            assert [step.skill for step in plan.steps] == [*skills, *(step.skill for step in other.steps)]
            assert plan.steps[len(own.steps)].role.fallback


def test_what_is_the_default_plan_already_has_none():
    wrong = lw.ConditionalPlan.from_pairs("push", [("the gripper is open", "ponder")])
    assert not with_reserve(read_canonical(wrong)).reserve


@pytest.mark.parametrize("turn", [None, 0, 1, 2, 3])
def test_only_the_steps_of_the_turn_have_weight(turn):
    actor = make(reserve=True)
    own = len(read_canonical(MT50["dial-turn"]).steps)
    weights = actor(states(actor, turn))["skill_weights"]
    here, there = (slice(own), slice(own, None)) if not (turn or 0) % 2 else (slice(own, None), slice(own))
    assert torch.allclose(weights[:, here].sum(-1), torch.ones(200))
    assert not weights[:, there].any()


def test_in_its_own_turn_a_policy_does_what_it_does_without():
    reserved, without = make(reserve=True), make()
    reserved.load_state_dict(without.state_dict(), strict=False)
    own, alone = (actor(states(actor))["action"] for actor in (reserved, without))
    assert torch.allclose(own, alone, atol=1e-6)


def test_in_reserve_it_does_what_it_does_under_the_default_plan():
    actor = make(reserve=True)
    default = actor.with_plans(lw.Plans([fallback_plan(plan.task) for plan in MT50.values()]))
    assert torch.allclose(actor(states(actor, 1))["action"], default(states(default))["action"], atol=1e-6)


def test_its_transform_counts_turns_and_answers_queries():
    kinds = [type(one) for one in make(reserve=True).transform().transforms]
    assert kinds == [QAFTransform, FallbackTurns]


def test_a_policy_that_gets_nowhere_comes_to_its_reserve():
    actor = make(MT10, reserve=True)
    torch.nn.init.zeros_([*actor.head.parameters()][-1])
    seen = []
    lw.evaluate(
        actor,
        tasks="reach",
        episodes_per_task=1,
        seed=1_000,
        also_record=["turn"],
        on_episode=lambda episode: seen.append(episode.steps["turn"].max()),
        progress=False,
    )
    assert max(seen) >= 1


def test_it_is_saved_and_loaded(tmp_path):
    actor = make(MT10, reserve=True)
    lw.save_actor(actor, tmp_path / "policy.safetensors")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    state = states(actor, 1, "push")
    assert torch.equal(loaded(state.clone())["action"], actor(state.clone())["action"])


def test_it_needs_canonical_plans():
    with pytest.raises(ValueError, match="canonical must be true with reserve"):
        lw.PlanConditionedActor(MT10, reserve=True, **SMALL)
