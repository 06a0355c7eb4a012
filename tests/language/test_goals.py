"""Goals: the state that a scripted skill steers to, and how plans carry them."""

import dataclasses

import pytest
import torch
from relation_truth import relation_holds

import lw_torchrl as lw
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, PlanError, PlanStep, usual_goal
from lw_torchrl.language.queries import parse_query

SKILLS = lw.load_skills()
WITH_GOAL = sorted(text for text, skill in SKILLS.items() if skill.goal)
CARRIED = {"move the peg in line with the hole", "push the peg into the hole"}  # the hand goes, and takes the peg along


def holds(clause, at, skill):
    if clause.object is None:
        held = {"open": -1.0, "closed": 1.0}[clause.predicate] == (skill.gripper > 0) - (skill.gripper < 0)
    else:
        held = relation_holds(clause.predicate, at[clause.subject], at[clause.object]).item()
    return held != clause.negated


def test_every_skill_of_mt10_has_a_goal():
    assert all(goal is not None for plan in lw.load_plans("MT10").values() for goal in plan.goals)
    assert len(WITH_GOAL) >= 100


@pytest.mark.parametrize("text", [text for text in WITH_GOAL if text not in CARRIED])
def test_a_goal_is_where_its_skill_steers_to(text):
    """What the skill moves is put where its controller comes to rest; its goal holds there."""
    found = 0
    for task in lw.TASKS.values():
        goal = usual_goal(text, task)
        if goal is None or not SKILLS[text].suits(task):
            continue
        skill = SKILLS[text].for_task(task)
        at = task.positions(torch.arange(39.0) * 0.37 % 1.1 + torch.arange(39.0) % 3)  # things far from each other
        moved = task.object(skill.moved)
        shift = at[skill.target] + torch.tensor(skill.offset) - at[skill.moved]
        for thing in task.objects:  # the points beside what moves, too
            if thing.position == moved.position and thing.position != task.object(skill.target).position:
                at[thing.name] = at[thing.name] + shift
        assert all(holds(clause, at, skill) for clause in goal.clauses), (task.name, str(goal))
        found += 1
    assert found


def test_a_plan_knows_the_goals_of_its_skills():
    plan = ConditionalPlan.from_pairs(
        "push", [("gripper open", "place gripper above puck"), ("gripper closed", "dance")]
    )
    assert [step.goal for step in plan.steps] == [None, None]
    assert [str(goal) for goal in plan.goals] == ["the robot's gripper is above the puck", "None"]


def test_a_goal_of_its_own_counts():
    near = parse_query("the gripper is near the puck", "push")
    condition = parse_query("the gripper is open", "push")
    usual = ConditionalPlan("push", (PlanStep(condition, "place the gripper above the puck"),))
    own = ConditionalPlan("push", (PlanStep(condition, "place the gripper above the puck", goal=near),))
    same = ConditionalPlan("push", (PlanStep(condition, "place gripper above puck", goal=usual.goals[0]),))
    assert own != usual == same
    assert own.goals == (near,)
    assert same.steps[0].goal is None
    assert 'goal="the robot\'s gripper is near the puck")' in str(own)


def test_a_goal_is_checked():
    condition = parse_query("the gripper is open", "push")
    with pytest.raises(PlanError, match=r"step 1 of plan 'push'.*drawer"):
        ConditionalPlan("push", (PlanStep(condition, "x", goal="the gripper is near the drawer handle"),))
    text = 'def push(robot):\n    if check("gripper open"):\n        robot.place("x", goal="the gripper is wet")\n'
    from lw_torchrl.language.plans import check_plan

    plan, faults = check_plan(text)
    assert plan is None
    assert faults[0].startswith("plan, line 3: goal: ")
    assert check_plan(text.replace("wet", "closed"))[1] == []


def test_a_task_that_lacks_what_a_goal_names_has_none():
    plan = lw.load_plans("MT50")["plate-slide-back"]
    assert usual_goal("place the gripper above the plate", plan.definition) is not None
    bare = dataclasses.replace(plan.definition, objects=plan.definition.objects[:2])
    assert bare.objects[0].name == GRIPPER
    assert usual_goal("place the gripper above the plate", bare) is None
    assert ConditionalPlan.from_pairs(bare, [("gripper open", "place the gripper above the plate")]).goals == (None,)


def test_a_skill_file_may_say_a_goal(tmp_path):
    (tmp_path / "skills.toml").write_text('["hover"]\ntarget = "puck"\ngoal = "the gripper is above the puck"\n')
    assert lw.load_skills(tmp_path / "skills.toml")["hover"].goal == "the gripper is above the puck"
    (tmp_path / "skills.toml").write_text('["hover"]\ntarget = "puck"\ngoal = 3\n')
    with pytest.raises(ValueError, match="goal of skill 'hover' must be a query in words, got 3"):
        lw.load_skills(tmp_path / "skills.toml")
