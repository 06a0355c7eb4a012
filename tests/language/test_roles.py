"""Roles of steps: canonical plans are plans, keep their roles in JSON, and answer the same queries."""

from dataclasses import replace

import pytest

import lw_torchrl as lw
from lw_torchrl.language.canonical import canonical_plan, canonical_plans
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans
from lw_torchrl.language.roles import StepRole, role_vectors

OWN = lw.load_plans("MT50")
CANONICAL = canonical_plans(OWN, fallback=True)
DIAL = CANONICAL["dial-turn"]


def test_canonical_plans_are_plans_with_roles():
    assert isinstance(CANONICAL, Plans)
    assert CANONICAL.has_roles
    assert not OWN.has_roles
    assert CANONICAL.task_ids == OWN.task_ids == {task: lw.task_id(task) for task in lw.MT50}
    assert all(step.skill == step.role.skill for plan in CANONICAL.values() for step in plan.steps)


@pytest.mark.parametrize("plans", [CANONICAL, OWN], ids=["roles", "none"])
def test_roles_and_confidence_are_kept_in_json(plans):
    again = Plans.from_json(plans.to_json())
    assert again == plans
    assert [plan.confidence for plan in again.values()] == [plan.confidence for plan in plans.values()]
    assert again.numbers == plans.numbers


def test_a_plan_without_roles_has_the_json_it_always_had():
    assert OWN["push"].to_json() == {"plan": str(OWN["push"])}


def test_roles_do_not_change_which_queries_are_answered():
    def without_roles(plan):
        return replace(plan, steps=[replace(step, role=None) for step in plan.steps])

    bare = Plans([without_roles(plan) for plan in CANONICAL.values()])
    assert bare != CANONICAL
    assert bare.numbers == CANONICAL.numbers


def test_canonical_plans_are_not_read_again():
    assert canonical_plans(CANONICAL) == CANONICAL
    assert canonical_plan(canonical_plan(OWN["push"]), fallback=True) == canonical_plan(OWN["push"], fallback=True)


def test_the_fallback_plan_follows_the_steps_of_the_plan():
    own = canonical_plan(OWN["dial-turn"])
    assert DIAL.steps[: len(own.steps)] == own.steps
    assert [step.role.fallback for step in DIAL.steps] == [False] * len(own.steps) + [True] * 4
    assert [step.role.verb for step in DIAL.steps[-4:]] == ["approach", "descend", "close", "move"]


def test_the_fallback_plan_has_no_fallback():
    wrong = lw.ConditionalPlan.from_pairs("push", [("gripper is open", "ponder")])
    plan = canonical_plan(wrong, fallback=True)
    assert not any(step.role.fallback for step in plan.steps)
    assert plan.confidence == 0.0


def test_a_role_says_which_objects_a_step_mentions():
    (step,) = lw.ConditionalPlan.from_pairs("push", [("gripper is open", "put the puck at the target location")]).steps
    task = lw.TASKS["push"]
    assert step.mentions(task) == {"robot's gripper", "puck", "target location"}
    role = StepRole("push", "robot's gripper", "puck", "push", "goal")
    assert replace(step, skill="nudge it", role=role).mentions(task) == {"robot's gripper", "puck", "target location"}
    role = replace(role, direction="left")
    assert replace(step, skill="nudge it", role=role).mentions(task) == {"robot's gripper", "puck"}


def test_vectors_of_roles_have_a_one_for_verb_and_manner_each():
    vectors = role_vectors([step.role for step in DIAL.steps])
    assert {sum(vector) for vector in vectors} == {2.0}
    assert len({tuple(vector) for vector in vectors}) > 3


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"roles": []}, "one entry for each of its"),
        ({"roles": [{"verb": "push"}]}, "one entry for each of its"),
        ({"confidence": 2}, "confidence must be from 0 to 1"),
        ({"confidence": "high"}, "confidence must be a number"),
        ({"more": 1}, "must be like"),
    ],
)
def test_broken_json_is_refused(change, problem):
    with pytest.raises(PlanError, match=problem):
        ConditionalPlan.from_json("dial-turn", DIAL.to_json() | change)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"verb": "juggle"}, "verb must be one of"),
        ({"direction": "north"}, "direction must be one of"),
        ({"target": "moon"}, "object of task 'dial-turn' must be one of"),
        ({"confidence": None}, "confidence must be a number"),
        ({"colour": "red"}, "role must be a table of"),
    ],
)
def test_broken_roles_are_refused(change, problem):
    row = DIAL.to_json()
    row["roles"][0] = row["roles"][0] | change
    with pytest.raises(PlanError, match=problem):
        ConditionalPlan.from_json("dial-turn", row)
