"""PlanFocus: the way between what the steps compare, by hand and by the attention."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lw_torchrl.modules.relative_positions import PlanFocus
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.task_index import PlanTables

HAND, OBJECT, SECOND, GOAL = slice(0, 3), slice(4, 7), slice(11, 14), slice(36, 39)


def focus_of(task, *conditions):
    plans = Plans([ConditionalPlan.from_pairs(task, [(condition, "wait") for condition in conditions])])
    return PlanFocus(plans, PlanTables(plans))


def positions(focus, observation, weights=None):
    """(B, 2, 3) metres: of each step's first and last clause."""
    weights = torch.ones(len(observation), 1) if weights is None else weights
    found = focus(observation, weights, torch.zeros(len(observation), dtype=torch.int64))
    assert found.shape == (len(observation), 18)
    return found[:, :6].reshape(-1, 2, 3) / 10


@pytest.fixture
def observation():
    return torch.randn(5, 39, generator=torch.Generator().manual_seed(0))


def test_the_first_and_the_last_clause_that_compares_two_things(observation):
    condition = "the gripper is above the puck and the gripper is open and the puck is near the target location"
    found = positions(focus_of("push", condition), observation)
    torch.testing.assert_close(found[:, 0], observation[:, OBJECT] - observation[:, HAND])
    torch.testing.assert_close(found[:, 1], observation[:, GOAL] - observation[:, OBJECT])
    found = positions(focus_of("push", "the gripper is not above the puck"), observation)
    assert torch.equal(found[:, 0], found[:, 1])
    assert not positions(focus_of("push", "the gripper is open"), observation).any()


def test_points_have_offsets_and_fixed_places(observation):
    found = positions(focus_of("hammer", "the hammer head is near the nail"), observation)
    head = observation[:, OBJECT] + torch.tensor([0.16, 0.06, 0.0])
    torch.testing.assert_close(found[:, 0], observation[:, SECOND] - head)
    found = positions(focus_of("bin-picking", "the gripper is near the other bin"), observation)
    torch.testing.assert_close(found[:, 0], torch.tensor([0.12, 0.7, 0.02]) - observation[:, HAND])


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**31))
def test_steps_are_mixed_by_attention(seed):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.randn(4, 39, generator=generator)
    weights = torch.rand(4, 2, generator=generator).softmax(-1)
    conditions = ("the gripper is above the puck", "the puck is near the target location")
    each = [positions(focus_of("push", condition), observation) for condition in conditions]
    mixed = positions(focus_of("push", *conditions), observation, weights)
    torch.testing.assert_close(mixed, weights[:, 0, None, None] * each[0] + weights[:, 1, None, None] * each[1])


def test_fine_and_coarse_copies(observation):
    focus = focus_of("push", "the gripper is above the puck")
    found = focus(observation, torch.ones(5, 1), torch.zeros(5, dtype=torch.int64))
    way = found[:, :6] / 10
    torch.testing.assert_close(found[:, 6:12], torch.tanh(way / 0.02))
    torch.testing.assert_close(found[:, 12:], torch.tanh(way / 0.1))


def test_any_leading_shape_and_noise_in_training_alone():
    plans = lw.load_plans("MT50")
    focus = PlanFocus(plans, PlanTables(plans), noise=0.1).eval()
    observation, rows = torch.randn(2, 3, 39), torch.randint(50, (2, 3))
    weights = torch.rand(2, 3, plans.num_steps)
    once = focus(observation, weights, rows)
    assert once.shape == (2, 3, 18)
    flat = focus(observation.reshape(6, 39), weights.reshape(6, -1), rows.reshape(6))
    torch.testing.assert_close(flat.reshape(2, 3, 18), once)
    assert not torch.equal(focus.train()(observation, weights, rows), once)


def test_an_actor_sees_the_way_of_its_own_plans():
    own = {name: lw.load_plans("MT10")[name] for name in ("push", "reach")}
    actor = lw.PlanConditionedActor(own, focus=True, width=16, depth=1)
    other = actor.with_plans(lw.load_plans("MT10"))
    for one in (actor, other):
        steps = one.plans.num_steps
        state = TensorDict(
            observation=torch.randn(4, 39),
            task_id=torch.full((4,), lw.task_id("push")),
            qaf=torch.ones(4, steps, dtype=torch.bool),
        )
        assert one.eval()(state)["action"].shape == (4, 4)
        assert one.prepare(state)[2].shape == (4, 56 + 18)
    assert other.head is actor.head
    assert other.encoder.focus is not actor.encoder.focus
