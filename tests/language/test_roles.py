"""Roles: which thing a step brings where, from scripted skills, words and conditions."""

from dataclasses import replace

import pytest

import lw_torchrl as lw
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.roles import Roles, plan_roles, role_object

OWN, MT10_SKILLS = lw.load_plans("MT50"), lw.load_plans("MT50", skills="MT10")
G = "robot's gripper"

BY_EYE = [
    ("drawer-open", 2, "drawer handle", G),
    ("coffee-pull", 0, "mug rim", G),
    ("coffee-pull", 3, "target location", "mug"),
    ("assembly", 3, "peg", "wrench ring"),
    ("basketball", 1, "ball top", G),  # the skill goes to the ball, the condition names its top
    ("basketball", 3, "hoop", "ball"),
    ("disassemble", 2, "peg foot", "wrench"),
    ("button-press-wall", 0, "button center", G),
    ("door-close", 1, "target location", G),
    ("hammer", 4, "nail", "hammer head"),
    ("stick-pull", 5, "target location", "thermos"),
    ("plate-slide", 2, "target location", "plate"),
    ("peg-insert-side", 0, "peg", G),
    ("peg-insert-side", 4, "hole", "peg"),  # held, though its script steers the gripper
    ("pick-place", 3, "target location", "puck"),
    ("reach-wall", 0, "target location", G),
]


@pytest.mark.parametrize(("task", "step", "target", "moved"), BY_EYE)
def test_roles_by_eye(task, step, target, moved):
    assert plan_roles(OWN[task])[step] == Roles(target, moved, "skill")


@pytest.mark.parametrize("plans", [OWN, MT10_SKILLS], ids=["own", "MT10"])
def test_every_shipped_step_has_two_things_of_its_task(plans):
    for plan in plans.values():
        for found in plan_roles(plan):
            assert {found.target, found.moved} <= {*plan.definition.object_names, "target location"}
            assert found.target != found.moved


def test_plans_in_mt10_words_are_read_as_any_plan_is():
    """Where the words are no skill's of the task, they and the condition tell, never the task's own skills."""
    same = 0
    for task, plan in MT10_SKILLS.items():
        for own, found in zip(plan_roles(OWN[task]), plan_roles(plan), strict=True):
            same += (own.moved, own.target) == (found.moved, found.target)
    assert same == 166  # of 186


def test_the_target_location_is_the_goal_in_every_task():
    assert role_object(OWN["push"].definition, "target location") == OWN["push"].definition.object("target location")
    goal = role_object(OWN["peg-unplug-side"].definition, "target location")
    assert (goal.position, goal.offset) == ((36, 37, 38), (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"must be one of .*'peg head'"):
        role_object(OWN["peg-unplug-side"].definition, "target")


@pytest.mark.parametrize(
    ("condition", "moved"),
    [
        ("gripper is near the peg and gripper is closed", "peg"),
        ("gripper is near the peg", G),  # pushed, perhaps: nothing says that it is held
        ("gripper is closed", G),
        ("gripper is not near the peg and gripper is closed", G),
    ],
)
def test_what_is_held_is_moved_though_a_script_steers_the_gripper(condition, moved):
    assert of("peg-insert-side", (condition, "push the peg into the hole")) == (Roles("hole", moved, "skill"),)


def of(task, *steps, skills=None):
    return plan_roles(ConditionalPlan.from_pairs(task, steps), skills)


@pytest.mark.parametrize(
    ("task", "condition", "text", "target", "moved", "source"),
    [
        ("push", "gripper is open", "carry the puck over to the target location", "target location", "puck", "words"),
        ("push", "gripper is open", "nudge the puck forward", "puck", G, "words"),
        ("push", "the puck is not near the target location", "nudge the puck", "target location", "puck", "words"),
        ("push", "gripper is near the puck", "shove it onwards", "puck", G, "condition"),
        ("push", "the puck is right of the target location", "shove it", "target location", "puck", "condition"),
        ("push", "the puck is right of the target location", "hold the gripper still", None, None, "nothing"),
        ("push", "gripper is open", "wait", None, None, "nothing"),
        ("stick-push", "gripper is open", "shove the thermos away with the stick", "thermos", "stick", "words"),
        ("stick-push", "gripper is open", "bring the stick in line with the thermos", "thermos", "stick", "words"),
        ("stick-push", "gripper is open", "push the thermos with the stick to the target location", "target location",
         "thermos", "words"),
        ("push-wall", "gripper is open", "avoid the wall and bring the puck to the target location", "target location",
         "puck", "words"),
        ("push-wall", "gripper is open", "lift over the wall, then carry the puck to the target location",
         "target location", "puck", "words"),
        ("hand-insert", "gripper is above the puck top", "reach down to the puck", "puck top", G, "words"),
        # Words of other tasks, also under a condition of the shipped plan.
        ("coffee-pull", "gripper is near the mug rim and gripper is closed", "move the puck to the target location",
         "target location", "mug rim", "words"),
        ("coffee-pull", "gripper is near the mug rim", "move the puck to the target location", "target location",
         "mug rim", "words"),
        ("coffee-pull", "gripper is near the mug rim", "close the gripper around the puck", "mug rim", G, "condition"),
    ],
)  # fmt: skip
def test_words_and_conditions_tell_where_no_skill_does(task, condition, text, target, moved, source):
    assert of(task, (condition, text)) == (Roles(target, moved, source),)


def test_of_skills_nothing_but_target_and_moved_is_read():
    plan = OWN["coffee-push"]
    changed = {
        text: replace(skill, offset=(1.0, 2.0, 3.0), gain=(0.0, 0.0, 0.0), gripper=-0.5, variants={})
        for text, skill in lw.load_skills().items()
    }
    assert plan_roles(plan, changed) == plan_roles(plan)
    text = plan.steps[3].skill
    changed[text] = replace(changed[text], moved="mug rim")
    assert plan_roles(plan, changed)[3].moved == "mug rim"


def test_words_alone_give_most_shipped_roles():
    pairs = [
        (one, other) for plan in OWN.values() for one, other in zip(plan_roles(plan), plan_roles(plan, {}), strict=True)
    ]
    same = sum((one.target, one.moved) == (other.target, other.moved) for one, other in pairs)
    assert all(other.source != "skill" for _, other in pairs)
    assert (same, len(pairs)) == (174, 186)


def test_ones_own_task_has_its_own_things(tmp_path):
    (tmp_path / "tasks.toml").write_text("""
[stack-cup]
description = "Put the cup on the saucer."
objects.cup = "obs[4:7]"
objects.saucer = "obs[36:39]"
points."cup rim" = { object = "cup", offset = [0.0, 0.0, 0.05] }
[push]
description = "Push the disc to the target."
objects.disc = "obs[4:7]"
""")
    tasks = lw.load_tasks(tmp_path / "tasks.toml")
    steps = [
        ("gripper is not near the cup rim", "lower the gripper around the cup"),
        ("gripper is near the cup rim", "lift the cup onto the saucer"),
        ("gripper is near the cup rim", "place the gripper above the puck"),
    ]
    found = of(tasks["stack-cup"], *steps)
    assert [(one.target, one.moved) for one in found] == [("cup rim", G), ("saucer", "cup"), ("cup rim", G)]
    # A shipped skill's text does not name things that the task of this name lacks.
    assert of(tasks["push"], ("gripper is open", "place the gripper above the puck")) == (Roles(None, None, "nothing"),)
