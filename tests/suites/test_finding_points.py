"""Points on things that shapes tell: where fingers fit, above the table, and used by plans that name things alone."""

from __future__ import annotations

import pytest
from toy_suite import make_toy_suite

import lw_torchrl as lw
from lw_torchrl.language.canonical import canonical_plan
from lw_torchrl.suites import find_points
from lw_torchrl.suites.finding_points import BETWEEN_FINGERS, PADS

FREE = ("assembly", "coffee-pull", "dial-turn", "plate-slide-side", "push", "stick-pull")


@pytest.fixture(scope="module")
def found():
    return find_points(FREE, episodes=1)


def points(task):
    return {one.name: one.offset for one in task.objects if one.ours}


def test_a_puck_is_taken_hold_of_in_its_middle_as_low_as_fingers_reach(found):
    (offset,) = points(found["push"]).values()
    assert offset == pytest.approx((0.0, 0.0, PADS - 0.015), abs=2e-3)  # its middle is 15 mm above the table


def test_a_wrench_is_taken_hold_of_where_its_ring_does_not_reach(found):
    x, y, _ = points(found["assembly"])["wrench grip"]
    assert -0.04 < x < 0.04  # the ring is from -0.2 to -0.06, the handle's end at 0.038
    assert abs(y) < 0.005


def test_what_is_too_wide_for_the_fingers_is_pushed_from_behind(found):
    x, y, z = points(found["plate-slide-side"])["plate side"]
    assert x == pytest.approx(0.05 + 0.015, abs=5e-3)  # the target is to the left, the plate's radius 5 cm
    assert abs(y) < 0.02
    assert z >= PADS - 0.02
    assert BETWEEN_FINGERS < 2 * 0.05


def test_what_turns_on_a_hinge_keeps_its_position(found):
    assert not points(found["dial-turn"])


def test_points_that_people_named_are_not_looked_at(found):
    assert set(points(found["coffee-pull"])) == {"mug grip"}
    assert find_points(lw.TASKS["coffee-pull"].published, episodes=1)["coffee-pull"] == found["coffee-pull"]


def test_a_plan_that_names_the_thing_alone_gets_the_point(found):
    plan = lw.ConditionalPlan.from_pairs(
        found["coffee-pull"],
        [("the gripper is not near the mug", "go to the mug"), ("the gripper is near the mug", "grab the mug")],
    )
    assert "mug grip" in {step.target for step in canonical_plan(plan).every_step}


def test_an_engine_without_a_model_is_refused():
    toy = make_toy_suite()
    with pytest.raises(TypeError, match="must have an engine with model and poses"):
        find_points(toy.name, suite=toy)
