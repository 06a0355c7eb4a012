"""What a plan mentions stays where it is; the rest is swapped between rows, and told by no feature."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lw_torchrl.modules.plan_encoder import mentioned, swap_unmentioned
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.task_index import PlanTables

PLACES = {0: [*range(4, 11), *range(22, 29)], 1: [*range(11, 18), *range(29, 36)], 2: [36, 37, 38]}


def table(task, *pairs):
    plans = Plans([ConditionalPlan.from_pairs(task, pairs)])
    return mentioned(plans, PlanTables(plans))[0].int().tolist()


def test_conditions_and_skills_mention_things():
    assert table("push", ("the gripper is above the puck", "lower the gripper")) == [[1, 0, 0]]
    assert table("push", ("the gripper is open", "move the puck to the target location")) == [[1, 0, 1]]
    assert table("push", ("the gripper is open", "wait")) == [[0, 0, 0]]
    assert table("push", ("the gripper is above the puck", "wait"), ("the gripper is open", "wait")) == [
        [1, 0, 0],
        [0, 0, 0],
    ]


def test_points_beside_an_object_are_its_mention_and_fixed_places_are_none():
    assert table("hammer", ("the gripper is above the hammer handle", "wait")) == [[1, 0, 0]]
    assert table("hammer", ("the hammer head is near the nail", "wait")) == [[1, 1, 0]]
    assert table("bin-picking", ("the gripper is above the other bin", "wait")) == [[0, 0, 0]]
    plans = lw.load_plans("MT50")
    assert mentioned(plans, PlanTables(plans)).any(-1).any(-1).all()


rows = st.integers(1, 30)
seeds = st.integers(0, 2**31)


@settings(max_examples=50, deadline=None)
@given(rows, seeds, st.floats(0.0, 1.0))
def test_only_the_unmentioned_moves_and_only_to_where_it_is_in_another_row(number, seed, probability):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(number, 39, generator=generator)
    kept = torch.rand(number, 3, generator=generator) < 0.5
    before = observation.clone()
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        swapped = swap_unmentioned(observation, kept, probability)
    assert torch.equal(observation, before)
    others = [column for column in range(39) if not any(column in place for place in PLACES.values())]
    assert torch.equal(swapped[:, others], observation[:, others])
    for thing, place in PLACES.items():
        assert torch.equal(swapped[kept[:, thing]][:, place], observation[kept[:, thing]][:, place])
        for row in swapped[:, place]:
            assert (observation[:, place] == row).all(-1).any()


def test_the_probability_is_one_of_each_swap():
    observation = torch.arange(4000.0)[:, None].expand(-1, 39)
    kept = torch.zeros(4000, 3, dtype=torch.bool)
    with torch.random.fork_rng():
        torch.manual_seed(0)
        moved = swap_unmentioned(observation, kept, 0.3) != observation
        assert torch.equal(swap_unmentioned(observation, kept, 0.0), observation)
        shaped = swap_unmentioned(observation.reshape(40, 100, 39), kept.reshape(40, 100, 3), 0.3)
    assert moved[:, 36].float().mean().item() == pytest.approx(0.3, abs=0.03)
    assert torch.equal(moved[:, 4], moved[:, 28])
    assert not torch.equal(moved[:, 4], moved[:, 36])
    assert shaped.shape == (40, 100, 39)


def test_a_policy_in_training_cannot_see_what_its_step_does_not_mention():
    plans = lw.load_plans("MT10")
    actor = lw.PlanConditionedActor(plans, feature_noise=0.0, swap_unmentioned=1.0)
    reach = torch.full((64,), lw.task_id("reach"))
    state = TensorDict(
        observation=torch.randn(64, 39), task_id=reach, qaf=torch.ones(64, plans.num_steps, dtype=torch.bool)
    )
    ours = actor.encoder.features(state["observation"])

    def differs(seen):  # by the pair: hand-object, hand-second, hand-goal, ...
        return (seen[:, :18] != ours[:, :18]).reshape(64, 6, 3).all(-1).float().mean(0)

    with torch.random.fork_rng():
        torch.manual_seed(0)
        found = differs(actor.train().prepare(state)[2])
    assert found[0] > 0.9
    assert found[2] == 0.0
    assert differs(actor.eval().prepare(state)[2]).sum() == 0.0


@pytest.mark.parametrize("skills", ["own", "MT10"])
def test_what_an_actor_on_roles_moves_and_its_target_stay_where_they_are(skills):
    """Also where the words do not speak of it: "lift the puck out of the hole" is on its way to the target location."""
    plans = lw.load_plans("MT50", skills=skills)
    options = {"features": "opening", "roles": True, "feature_noise": 0.0}
    actor = lw.PlanConditionedActor(plans, swap_unmentioned=1.0, **options)
    rows = [(lw.task_id(task), step) for task, plan in actor.plans.items() for step in range(len(plan.steps))]
    task_id, step = torch.tensor(rows).T
    truth = torch.nn.functional.one_hot(step, actor.plans.num_steps).bool()
    generator = torch.Generator().manual_seed(0)
    state = TensorDict(observation=torch.randn(len(rows), 39, generator=generator), task_id=task_id, qaf=truth)
    ways = [mode.prepare(state)[2][:, 1:4] for mode in (actor.eval(), actor.train())]
    mixed = 0.01  # of the other steps' ways: each has a weight of 1e-4
    torch.testing.assert_close(*ways, atol=10 * mixed, rtol=0.0)


def test_what_it_refuses():
    plans = lw.load_plans("MT10")
    with pytest.raises(ValueError, match=r"swap_unmentioned must be from 0 to 1, got 1\.5"):
        lw.PlanConditionedActor(plans, swap_unmentioned=1.5)
    with pytest.raises(ValueError, match="swap_unmentioned must be finite and at least 0"):
        lw.PlanConditionedActor(plans, swap_unmentioned=-0.1)
