"""check_plan says of a plan what it was taken for, and where its conditions hold."""

from __future__ import annotations

import pytest

import lw_torchrl as lw
from lw_torchrl.planners.checking import check_plan

ANSWER = """def reach(robot):
    if check("the robot's gripper is not near the reach target"):
        robot.place("gripper at the reach target")
    if check("the robot's gripper is near the reach target and the robot's gripper is not near the reach target"):
        robot.close("the gripper around the puck")
    if check("the moon is full"):
        robot.howl()
"""


def test_a_step_that_never_fires_is_named():
    plan = lw.load_plans("MT10")["push"]
    pairs = [(str(step.condition), step.skill) for step in plan.steps]
    pairs.insert(1, ("the robot's gripper is open and the robot's gripper is closed", pairs[0][1]))
    spoilt = lw.ConditionalPlan.from_pairs("push", pairs)
    found = check_plan(lw.encode_plan(spoilt, "basic_py"), "push", "basic_py", episodes=2)
    assert found.never == (1,)
    assert found.expert.true[1] == found.own.true[1] == 0.0
    assert found.success == 1.0
    printed = str(found)
    assert "push, 5 steps" in printed or f"push, {len(pairs)} steps" in printed
    assert "Step 2 never fires" in printed
    assert "succeeds in 100% of episodes" in printed


def test_states_where_no_condition_holds_are_named():
    plan = lw.ConditionalPlan("push", lw.load_plans("MT10")["push"].steps[:2])
    found = check_plan(lw.encode_plan(plan, "basic_py"), "push", "basic_py", episodes=2)
    episode, first, last = max(found.expert.gaps, key=lambda gap: gap[2] - gap[1])
    assert 0 < first < last
    assert f"No condition holds in steps {first} to {last} of the expert's episode {episode}." in str(found)


def test_mappings_and_what_was_left_out_are_told():
    found = check_plan(ANSWER, "reach", "basic_py", episodes=1)
    printed = str(found)
    assert "hold the gripper at the reach target   <- '" in printed
    assert "the moon is full" in printed
    assert found.expert.covered < 1.0 or found.expert.true[0] > 0.5


@pytest.mark.parametrize("text", ["", "I am sorry, I cannot do that."])
def test_what_is_no_plan_says_why(text):
    found = check_plan(text, "reach", "chain_md")
    assert found.never == ()
    assert str(found).startswith("reach: no plan: ")


def test_an_unknown_task_is_refused():
    with pytest.raises(ValueError, match="did you mean 'reach'"):
        check_plan("", "reech", "chain_md")
