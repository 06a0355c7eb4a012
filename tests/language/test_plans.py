"""Conditional plans made by hand: checked, and kept in one spelling."""

import time

import pytest
from hypothesis import given, settings
from plan_texts import DRAWER, conditional_plans, plan

from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans, PlanStep, as_plans, parse_plan
from lw_torchrl.language.queries import Clause, Query, QueryError, parse_query


@settings(deadline=None)
@given(conditional_plans())
def test_a_plan_is_in_canonical_spelling(given):
    assert ConditionalPlan(given.task, given.steps) == given
    for step in given.steps:
        assert step.skill == " ".join(step.skill.split())
        assert isinstance(step.condition, Query)


@pytest.mark.parametrize(
    ("given", "skill"),
    [
        ("push the puck", "push the puck"),
        ("push puck", "push the puck"),
        ("  push\n the   puck ", "push the puck"),
        ("let_go the puck", "let go the puck"),
        ("let_go puck", "let go the puck"),
        ("_let__go_ puck", "let go the puck"),
        ('say "hello" to the \\ puck', 'say "hello" to the \\ puck'),
        ("don't", None),
        ("pick-up the puck", None),
        ("3 steps forward", None),
        ("", None),
        (" \n", None),
        ("_", None),
        ("(push)", None),
        ("# push", None),
    ],
)
def test_a_skill_is_kept_in_canonical_spelling_or_refused(given, skill):
    if skill is None:
        with pytest.raises(PlanError, match="step 1 of plan 'push': skill must begin with a plain word"):
            plan("push", ("gripper open", given))
    else:
        kept = plan("push", ("gripper open", given))
        assert kept.steps[0].skill == skill
        assert parse_plan(str(kept)) == kept


def test_a_condition_is_kept_in_canonical_spelling():
    for condition in ("Gripper open?", Query((Clause("gripper", "open"),)), Query((Clause(GRIPPER, "open"),))):
        step = ConditionalPlan("push", (PlanStep(condition, "push the puck"),)).steps[0]
        assert step.condition == Query((Clause(GRIPPER, "open"),))


def test_reasons_play_no_part_in_equality():
    step = PlanStep(parse_query("gripper open", "push"), "push the puck", "so")
    assert ConditionalPlan("push", (step,)) == plan()
    assert hash(ConditionalPlan("push", (step,))) == hash(plan())


@pytest.mark.parametrize(
    ("task", "steps", "error", "says"),
    [
        ("push", (), PlanError, "at least one step"),
        ("psuh", (PlanStep("gripper open", "push"),), ValueError, "'push'"),
        (3, (PlanStep("gripper open", "push"),), TypeError, "task"),
        ("push", (("gripper open", "push"),), TypeError, "step 1"),
        ("push", (PlanStep("gripper open", "push"), None), TypeError, "step 2"),
        ("push", (PlanStep(None, "push"),), TypeError, "string"),
        ("push", (PlanStep("gripper open", "push"), PlanStep("gripper flies", "push")), PlanError, "step 2"),
        ("push", (PlanStep(parse_query("gripper near drawer handle", "drawer-open"), "x"),), PlanError, "step 1"),
        ("push", (PlanStep(Query(()), "push"),), PlanError, "step 1"),
    ],
)
def test_a_plan_by_hand_is_checked(task, steps, error, says):
    with pytest.raises(error, match=says):
        ConditionalPlan(task, steps)


def test_a_step_has_a_text_for_its_skill():
    with pytest.raises(TypeError, match="skill must be a string, got None"):
        PlanStep("gripper open", None)


def test_from_pairs_takes_any_spelling_and_refuses_the_rest():
    assert plan("push", ("Is the gripper open?", "push puck")) == plan("push", ("gripper open", "push the puck"))
    with pytest.raises(PlanError, match="at least one step"):
        ConditionalPlan.from_pairs("push", [])
    with pytest.raises(QueryError, match="nearest query"):
        plan("push", ("the gripper flies", "push"))
    with pytest.raises(ValueError, match="did you mean 'push'"):
        ConditionalPlan.from_pairs("psuh", [("gripper open", "push")])


def test_steps_in_a_list_make_the_same_plan():
    assert ConditionalPlan("push", list(plan().steps)) == plan()
    assert {ConditionalPlan("push", list(plan().steps)), plan()} == {plan()}


def test_plans_are_a_sorted_mapping():
    drawer = parse_plan(DRAWER)
    found = Plans([plan(), drawer])
    assert list(found) == ["drawer-open", "push"]
    assert len(found) == 2
    assert found["push"] == plan()
    assert found == {"push": plan(), "drawer-open": drawer}
    assert found.num_steps == 3
    assert found.skills == (
        "lower the gripper around the drawer handle",
        "place the gripper above the drawer handle",
        "pull back",
        "push the puck",
    )
    assert as_plans(found) is found
    assert as_plans(dict(found)) == found
    with pytest.raises(TypeError):
        found["reach"] = plan("reach", ("gripper open", "reach"))


def test_plans_name_what_is_wrong():
    with pytest.raises(PlanError, match="at least one plan"):
        Plans({})
    with pytest.raises(PlanError, match=r"plans\['reach'\] is a plan for another task, 'push'"):
        Plans({"reach": plan()})
    with pytest.raises(PlanError, match="one plan for each task"):
        Plans([plan(), plan()])
    with pytest.raises(TypeError, match=r"ConditionalPlan|a mapping or a list"):
        Plans({"push": "def push(robot):"})
    for wrong in (plan(), [plan()], "push", None):
        with pytest.raises(TypeError, match="plans must map"):
            as_plans(wrong)
    with pytest.raises(PlanError, match="plans lack reach, soccer; they cover push"):
        Plans([plan()]).require(["reach", "push", "soccer"])
    Plans([plan()]).require(["push"])


@pytest.mark.parametrize("unit", ["puck ", "puck, ", "puck,", "a-very-long-word puck ", "above the puck "])
def test_long_texts_take_time_in_proportion(unit):
    skill = "place " + unit * (500_000 // len(unit))
    start = time.process_time()
    found = ConditionalPlan.from_pairs("push", [("the gripper is open", skill)]).steps[0].skill
    assert time.process_time() - start < 5
    few = ConditionalPlan.from_pairs("push", [("the gripper is open", "place " + unit * 20)]).steps[0].skill
    assert found.startswith(few.rstrip(","))
