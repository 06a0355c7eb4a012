"""Conditional plans: checked and kept in one spelling; their goals, and mappings of them."""

import dataclasses

import pytest
import torch
from hypothesis import given, settings
from plan_texts import DRAWER, conditional_plans, plan
from speed import within
from states import relation_holds

import lw_torchrl as lw
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans, PlanStep, as_plans, usual_goal
from lw_torchrl.language.queries import Clause, Query, QueryError, parse_query

OPEN = parse_query("gripper open", "push")
DRAWER_NEAR = parse_query("gripper near drawer handle", "drawer-open")


@settings(deadline=None)
@given(conditional_plans())
def test_a_plan_is_in_canonical_spelling(drawn):
    assert ConditionalPlan(drawn.task, drawn.steps) == drawn
    for step in drawn.steps:
        assert step.skill == " ".join(step.skill.split())
        assert isinstance(step.condition, Query)


@pytest.mark.parametrize(
    ("written", "skill"),
    [
        ("push the puck", "push the puck"),
        ("push puck", "push the puck"),
        ("  push\n the   puck ", "push the puck"),
        ("_let__go_ puck", "let go the puck"),
        ('say "hello" to the \\ puck', 'say "hello" to the \\ puck'),
    ],
)
def test_a_skill_is_kept_in_canonical_spelling(written, skill):
    kept = plan("push", ("gripper open", written))
    assert kept.steps[0].skill == skill
    assert parse_plan(str(kept)) == kept


@pytest.mark.parametrize(
    "written", ["don't", "pick-up the puck", "3 steps forward", "", " \n", "_", "(push)", "# push"]
)
def test_a_skill_without_a_plain_word_is_refused(written):
    with pytest.raises(PlanError, match="step 1 of plan 'push': skill"):
        plan("push", ("gripper open", written))


def test_a_condition_is_kept_in_canonical_spelling():
    for condition in (Query((Clause("gripper", "open"),)), Query((Clause(GRIPPER, "open"),))):
        assert ConditionalPlan("push", (PlanStep(condition, "push the puck"),)).steps[0].condition == OPEN


def test_reasons_do_not_count_for_equality():
    same = ConditionalPlan("push", (PlanStep(OPEN, "push the puck", "so"),))
    assert (same, hash(same)) == (plan(), hash(plan()))


@pytest.mark.parametrize(
    ("steps", "message"),
    [
        ((), "1 to 1000 steps, got 0"),
        (plan().steps * 1001, "1 to 1000 steps, got 1001"),
        ((PlanStep(DRAWER_NEAR, "x"),), "step 1"),
        ((PlanStep(OPEN, "push"), PlanStep(Query((Clause("puck", "open"),)), "push")), "step 2"),
        ((PlanStep(OPEN, "x", goal=DRAWER_NEAR),), "step 1"),
    ],
)
def test_a_faulty_plan_is_refused(steps, message):
    with pytest.raises(PlanError, match=message):
        ConditionalPlan("push", steps)


def test_from_pairs_accepts_any_spelling_and_refuses_the_rest():
    assert plan("push", ("Is the gripper open?", "push puck")) == plan("push", ("gripper open", "push the puck"))
    with pytest.raises(QueryError, match="nearest query"):
        plan("push", ("the gripper flies", "push"))


def test_plans_are_a_sorted_immutable_mapping():
    drawer = parse_plan(DRAWER)
    plans = Plans([plan(), drawer])
    assert list(plans.items()) == [("drawer-open", drawer), ("push", plan())]
    assert plans.num_steps == 3
    lower, place = (f"{verb} the drawer handle" for verb in ("lower the gripper around", "place the gripper above"))
    assert plans.skills == (lower, place, "pull back", "push the puck")
    assert as_plans(plans) is plans
    assert as_plans(dict(plans)) == as_plans([*plans.values()]) == plans
    with pytest.raises(TypeError):
        plans["reach"] = plan("reach", ("gripper open", "reach"))


def test_faulty_plans_are_refused():
    for wrong, message in (
        ({}, "at least one plan"),
        ([plan(), plan()], "one per task"),
        ({"reach": plan()}, r"plans\['reach'\].*'push'"),
    ):
        with pytest.raises(PlanError, match=message):
            Plans(wrong)
    with pytest.raises(PlanError, match="reach, soccer; they cover push"):
        Plans([plan()]).require(["reach", "push", "soccer"])
    Plans([plan()]).require(["push"])


@pytest.mark.parametrize("unit", ["puck ", "puck, ", "puck,", "a-very-long-word puck ", "above the puck "])
def test_long_texts_take_time_in_proportion(unit):
    skill = "place " + unit * (500_000 // len(unit))
    with within(5):
        long = ConditionalPlan.from_pairs("push", [("the gripper is open", skill)]).steps[0].skill
    few = ConditionalPlan.from_pairs("push", [("the gripper is open", "place " + unit * 20)]).steps[0].skill
    assert long.startswith(few.rstrip(","))


# ---- goals

SKILLS = lw.load_skills()
WITH_GOAL = sorted(text for text, skill in SKILLS.items() if skill.goal)
CARRIED = {"move the peg in line with the hole", "push the peg into the hole"}  # the hand moves and takes the peg along


def is_true(clause, at, skill):
    if clause.object is None:
        truth = {"open": -1.0, "closed": 1.0}[clause.predicate] == (skill.gripper > 0) - (skill.gripper < 0)
    else:
        truth = relation_holds(clause.predicate, at[clause.subject], at[clause.object]).item()
    return truth != clause.negated


def test_every_skill_of_mt10_has_a_goal():
    assert all(goal is not None for plan in lw.load_plans("MT10").values() for goal in plan.goals)
    assert len(WITH_GOAL) >= 100


@pytest.mark.parametrize("text", [text for text in WITH_GOAL if text not in CARRIED])
def test_a_goal_is_true_where_its_skill_comes_to_rest(text):
    checked = 0
    for task in lw.TASKS.values():
        goal = usual_goal(text, task)
        if goal is None or not SKILLS[text].suits(task):
            continue
        skill = SKILLS[text].for_task(task)
        at = task.positions(torch.arange(39.0) * 0.37 % 1.1 + torch.arange(39.0) % 3)  # objects far from each other
        moved = task.object(skill.moved)
        shift = at[skill.target] + torch.tensor(skill.offset) - at[skill.moved]
        for named in task.objects:  # the points on the moved object move, too
            if named.position == moved.position and named.position != task.object(skill.target).position:
                at[named.name] = at[named.name] + shift
        assert all(is_true(clause, at, skill) for clause in goal.clauses), (task.name, str(goal))
        checked += 1
    assert checked


def test_a_plan_has_the_usual_goals_of_its_skills():
    steps = ("gripper open", "place gripper above puck"), ("gripper closed", "dance")
    assert [step.goal for step in plan("push", *steps).steps] == [None, None]
    assert [str(goal) for goal in plan("push", *steps).goals] == ["the robot's gripper is above the puck", "None"]


def test_a_step_s_own_goal_replaces_the_usual_one():
    def placed(goal=None):
        return ConditionalPlan("push", (PlanStep(OPEN, "place gripper above puck", goal=goal),))

    near, usual = parse_query("the gripper is near the puck", "push"), placed()
    own, same = placed(near), placed(usual.goals[0])
    assert own != usual == same
    assert own.goals == (near,)
    assert same.steps[0].goal is None
    assert 'goal="the robot\'s gripper is near the puck")' in str(own)


def test_a_task_without_the_goal_s_objects_has_no_usual_goal():
    skill, task = "place the gripper above the plate", lw.load_plans("MT50")["plate-slide-back"].definition
    assert usual_goal(skill, task) is not None
    bare = dataclasses.replace(task, objects=task.objects[:2])
    assert usual_goal(skill, bare) is None
    assert ConditionalPlan.from_pairs(bare, [("gripper open", skill)]).goals == (None,)


def test_plans_queries_and_answers_do_without_torch(python):
    program = """
import sys, numpy as np, lw_torchrl as lw, lw_torchrl.language.canonical
from lw_torchrl.language.nearest import nearest_query
plans = lw.canonical_plans(lw.load_plans("MT50"), fallback=True)
assert lw.Plans.from_json(plans.to_json()) == plans
assert lw.parse_query("the gripper above the puck", "push") == nearest_query("gripper over the puck", "push").query
assert lw.decode_plan(lw.encode_plan(lw.load_plans("MT10")["push"], "chain_py"), "push", "chain_py").all_scripted
assert lw.TASKS["push"].positions(np.arange(39.0))["puck"].tolist() == [4.0, 5.0, 6.0]
print(sorted({"torch", "tensordict", "torchrl", "numba", "mujoco"} & set(sys.modules)))
"""
    done = python(program)
    assert done.stdout.strip() == "[]", done.stderr
