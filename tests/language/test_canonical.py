"""Canonical plans: what anyone's words become, when a plan keeps its own steps, and that nothing looks at our plans."""

import inspect
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language import canonical, roles, step_parser
from lw_torchrl.language.canonical import MIN_CONFIDENCE, canonical_plan, explain_canonical, fallback_plan
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.roles import mark_objects, role_vectors
from lw_torchrl.language.step_parser import parse_steps
from lw_torchrl.language.tasks import first_object, role_object

OWN, MT10_SKILLS = lw.load_plans("MT50"), lw.load_plans("MT50", skills="MT10")
G = GRIPPER


def plan_of(task, *steps):
    return lw.ConditionalPlan.from_pairs(task, steps)


def roles_of(plan):
    return [step.role for step in canonical_plan(plan).steps]


def without_roles(plan):
    return replace(plan, steps=[replace(step, role=None) for step in plan.steps], confidence=None)


def read_one(task, condition, text):
    (found,) = parse_steps(plan_of(task, (condition, text)))
    return found


@pytest.mark.parametrize(
    ("task", "condition", "text", "verb", "moved", "target", "direction"),
    [
        ("push", "gripper is closed", "carry the puck over to the goal", "carry", "puck", GOAL, None),
        ("push", "gripper is open", "nudge the puck forward", "push", G, "puck", "away"),
        ("push", "gripper is not near the puck", "grab the puck", "descend", G, "puck", None),
        ("push", "gripper is near the puck", "grab it", "close", G, "puck", None),
        ("push", "gripper is near the puck", "grip a puck", "close", G, "puck", None),
        ("push", "gripper is open", "let go of the puck with the gripper", "open", G, "puck", None),
        ("push", "gripper is open", "position gripper over puck", "approach", G, "puck", None),
        ("push", "gripper is open", "put the hand around the puck", "descend", G, "puck", None),
        ("dial-turn", "gripper is open", "turn the dial", "push", G, "dial", "goal"),
        ("dial-turn", "gripper is open", "rotate the dial left", "push", G, "dial", "left"),
        ("drawer-open", "gripper is open", "pull drawer open", "pull", G, "drawer handle", "goal"),
        ("drawer-close", "gripper is open", "gripper in front of drawer", "beside", G, "drawer handle", "away"),
        ("handle-press-side", "gripper is open", "press the handle down", "push", G, "handle", "down"),
        ("handle-pull-side", "gripper is open", "lift the handle", "move", "handle", "handle", "up"),
        ("reach", "gripper is open", "reach toward the goal", "reach", G, GOAL, None),
        ("reach", "gripper is open", "stay at the target", "hold", G, GOAL, None),
    ],
)  # fmt: skip
def test_a_step_says_its_verb_things_and_direction(task, condition, text, verb, moved, target, direction):
    found = read_one(task, condition, text)
    assert (found.verb, found.moved, found.target, found.direction) == (verb, moved, target, direction)


GRASP = ("gripper is near the stick handle and gripper is open", "close the gripper around the stick")
HELD = "gripper is near the stick handle and gripper is closed"


@pytest.mark.parametrize(
    ("condition", "text", "moved", "target"),
    [
        (HELD, "bring the stick in line with the thermos", "stick", "thermos"),
        (HELD, "pull the thermos to the goal with the stick", "thermos", GOAL),
        (HELD, "shove the thermos with the stick", "stick", "thermos"),
        (HELD + " and the stick is right of the thermos", "move the stick onwards", "stick", "thermos"),
        (HELD, "move the gripper over the goal", "stick", GOAL),
    ],
)
def test_what_is_held_goes_where_words_or_conditions_say(condition, text, moved, target):
    *_, found = parse_steps(plan_of("stick-pull", GRASP, (condition, text)))
    assert (found.moved, found.target) == (moved, target if target != GOAL else "target location")


def test_the_point_that_a_condition_compares_is_what_is_moved():
    roles = roles_of(OWN["assembly"])
    assert [(role.verb, role.moved, role.target) for role in roles[3:]] == [("carry", "wrench ring", "peg")] * 2


def test_over_a_wall_is_on_the_way_to_the_goal():
    roles = roles_of(OWN["push-wall"])
    assert [(role.verb, role.moved, role.target) for role in roles[3:]] == [("carry", "puck", GOAL)] * 2


@pytest.mark.parametrize("task", OWN)
def test_shipped_plans_are_read_and_their_canonical_form_is_a_plan(task):
    for plan in (OWN[task], MT10_SKILLS[task]):
        report = explain_canonical(plan)
        assert report.source in ("plan", "completed")
        assert not report.left_out
        assert lw.language.plans.parse_plan(str(report.plan)) == without_roles(report.plan)
        for role in roles_of(plan):
            for name in role.objects:
                role_object(plan.definition, name)


@pytest.mark.parametrize("task", OWN)
def test_the_canonical_form_of_a_canonical_plan_is_itself(task):
    plan = canonical_plan(OWN[task])
    again = canonical_plan(without_roles(plan))
    assert without_roles(again) == without_roles(plan)
    assert [(r.verb, r.moved, r.target, r.direction) for r in roles_of(again)] == [
        (r.verb, r.moved, r.target, r.direction) for r in roles_of(plan)
    ]


def test_nothing_of_a_plan_comes_from_the_shipped_plans_or_skills():
    for module in (canonical, step_parser, roles):
        source = inspect.getsource(module)
        assert not any(name in source for name in ("load_plans", "load_skills", "skills_for", "usual_goal"))


def test_a_plan_that_leaves_states_out_is_completed():
    steps = [
        ("the gripper is not above the mug", "place the gripper above the mug"),
        ("the gripper is near the mug", "place the mug at goal"),
    ]
    report = explain_canonical(plan_of("coffee-pull", *steps))
    assert report.source == "completed"
    assert report.plan.confidence < MIN_CONFIDENCE
    roles = roles_of(report.plan)
    assert [role.verb for role in roles] == ["approach", "descend", "close", "carry"]
    assert [role.target for role in roles] == ["mug rim"] * 3 + [GOAL]
    assert [(note["written"], note["seen"]) for note in report.notes()] == [
        *((step[1], False) for step in steps), (None, True), (None, True), (None, True), (steps[1][1], True)
    ]  # fmt: skip


def test_a_plan_without_a_motion_becomes_the_fallback_plan():
    steps = [("the gripper is open", "place the gripper above the mug"), ("the gripper is closed", "ponder")]
    report = explain_canonical(plan_of("coffee-pull", *steps))
    assert (report.source, report.plan.confidence, report.left_out) == ("fallback", 0.0, ("ponder",))
    fallback = fallback_plan("coffee-pull")
    assert without_roles(report.plan) == without_roles(fallback)
    assert canonical_plan(without_roles(fallback)).confidence == 1.0


def test_what_cannot_be_read_is_left_out_by_name():
    steps = [*((str(s.condition), s.skill) for s in OWN["push"].steps), ("the gripper is closed", "be careful")]
    report = explain_canonical(plan_of("push", *steps))
    assert report.left_out == ("be careful",)
    assert report.notes()[-1] == dict.fromkeys(("skill", "verb", "moved", "target", "condition")) | {
        "written": "be careful", "confidence": 0.0, "seen": False
    }  # fmt: skip


def test_ones_own_task_has_its_own_things(tmp_path):
    (tmp_path / "tasks.toml").write_text("""
[stack-cup]
description = "Put the cup on the saucer."
objects.cup = "obs[4:7]"
objects.saucer = "obs[36:39]"
points."cup rim" = { object = "cup", offset = [0.0, 0.0, 0.05] }
""")
    tasks = lw.load_tasks(tmp_path / "tasks.toml")
    steps = [
        ("gripper is not near the cup rim", "lower the gripper around the cup"),
        ("gripper is near the cup rim", "grab the cup"),
        ("gripper is near the cup rim and gripper is closed", "lift the cup onto the saucer"),
    ]
    found = parse_steps(plan_of(tasks["stack-cup"], *steps))
    assert [(one.target, one.moved) for one in found] == [("cup", G), ("cup", G), ("saucer", "cup")]


def test_a_hand_goes_to_the_thing_that_is_named_where_a_task_has_no_goal_and_no_first_object(tmp_path):
    (tmp_path / "tasks.toml").write_text("""
[touch-second]
description = "Touch the second block."
objects.block = "obs[11:14]"
""")
    task = lw.load_tasks(tmp_path / "tasks.toml")["touch-second"]
    plan = plan_of(task, ("the gripper is not near the block", "move the gripper to the block"))
    assert [(role.verb, role.target) for role in roles_of(plan)] == [("reach", "block")]
    fallback = roles_of(fallback_plan(task))
    assert [(role.verb, role.target) for role in fallback] == [("reach", "block"), ("hold", "block")]


words = st.text("abcdefghijklmnopqrstuvwxyz '-.,0123456789", min_size=1, max_size=60)


@given(st.sampled_from(sorted(OWN)), st.lists(st.tuples(st.integers(0, 5), words), min_size=1, max_size=6))
def test_any_words_become_a_plan_that_covers_the_task(task, written):
    """Whatever is written, there is a plan whose steps name objects of the task, and a confidence in [0, 1]."""
    own = OWN[task].steps
    steps = [(own[number % len(own)].condition, f"push {text}") for number, text in written]
    plan = canonical_plan(plan_of(task, *steps))
    assert plan.steps
    assert 0.0 <= plan.confidence <= 1.0
    assert len(role_vectors(roles_of(plan))) == len(plan.steps)
    assert plan.definition == OWN[task].definition


@given(st.randoms(use_true_random=False), st.sampled_from(sorted(OWN)))
def test_the_order_of_clauses_does_not_matter(random, task):
    plan = OWN[task]
    shuffled = [
        (" and ".join(map(str, random.sample(step.condition.clauses, len(step.condition.clauses)))), step.skill)
        for step in plan.steps
    ]
    report, other = explain_canonical(plan), explain_canonical(plan_of(task, *shuffled))
    assert (report.source, report.plan.confidence) == (other.source, other.plan.confidence)
    assert [step.skill for step in report.plan.steps] == [step.skill for step in other.plan.steps]


def test_marks_are_of_the_longest_name():
    task = OWN["drawer-open"].definition
    assert mark_objects("Pull the drawer handle, then the drawer", task) == "pull <drawer handle>, then <drawer handle>"
    assert first_object(OWN["reach"].definition) is None


def test_a_hand_that_is_told_to_go_to_itself_goes_to_the_thing():
    """As a small model put it."""
    far, over = "the gripper is not above the plate edge", "the gripper is above the plate edge"
    written = (far, "set the plate with the gripper above it"), (over, "lower the gripper onto the plate")
    report = explain_canonical(plan_of("plate-slide-back", *written, (over, "pull the plate to the target location")))
    assert report.source == "completed"
    assert {role.target for role in roles_of(report.plan) if role.moved == GRIPPER} == {"plate edge"}
