"""Canonical plans: the roles of steps, when a plan keeps its own steps, and independence of the shipped plans."""

import inspect
from dataclasses import replace

import pytest
from cases import read_cases
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from benchmarks.language import as_branches
from lw_torchrl.language import canonical, roles, step_parser
from lw_torchrl.language.canonical import canonical_plan, canonical_plans, explain_canonical, fallback_plan
from lw_torchrl.language.coverage import coverage_of
from lw_torchrl.language.objects import GOAL, GRIPPER, NamedObject
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans
from lw_torchrl.language.roles import StepRole, mark_objects, role_vectors
from lw_torchrl.language.step_parser import parse_steps
from lw_torchrl.language.tasks import first_object, role_object

CASES = read_cases("language/steps.toml")
OWN, MT10_SKILLS = lw.load_plans("MT50"), lw.load_plans("MT50", skills="MT10")
G = GRIPPER


def plan_of(task, *steps):
    return lw.ConditionalPlan.from_pairs(task, steps)


def roles_of(plan):
    return [step.role for step in canonical_plan(plan).steps]


def meanings(plan):
    return [(role.verb, role.moved, role.target, role.manner, role.direction) for role in roles_of(plan)]


def without_roles(plan):
    return replace(plan, steps=tuple(replace(step, role=None) for step in plan.steps))


@pytest.mark.parametrize(("task", "condition", "text", "verb", "moved", "target", "direction"), CASES["steps"])
def test_the_verb_objects_and_direction_of_a_step(task, condition, text, verb, moved, target, direction):
    (step,) = parse_steps(plan_of(task, (condition, text)))
    assert (step.verb, step.moved, step.target, step.direction or "") == (verb, moved, target, direction)


@pytest.mark.parametrize(("condition", "text", "moved", "target"), CASES["held"])
def test_a_held_object_moves_to_the_target_in_the_words_or_the_condition(condition, text, moved, target):
    grasp = ("gripper is near the stick handle and gripper is open", "close the gripper around the stick")
    *_, step = parse_steps(plan_of("stick-pull", grasp, (f"gripper is near the stick handle and {condition}", text)))
    assert (step.moved, step.target) == (moved, target)


def test_the_last_steps_of_a_shipped_plan():
    for task, moved, target in (
        ("assembly", "wrench ring", "peg"),  # the point that the condition compares
        ("push-wall", "puck", GOAL),  # over the wall is on the way to the goal
    ):
        assert [(role.verb, role.moved, role.target) for role in roles_of(OWN[task])[3:]] == [
            ("carry", moved, target)
        ] * 2


@pytest.mark.parametrize("task", OWN)
def test_the_canonical_form_of_a_shipped_plan_is_a_plan_and_its_own_canonical_form(task):
    for plan in (MT10_SKILLS[task], OWN[task]):
        report = explain_canonical(plan)
        assert report.source in ("plan", "completed")
        assert not report.left_out
        assert parse_plan(str(report.plan)) == without_roles(report.plan)
        for role in roles_of(report.plan):
            for name in role.objects:
                role_object(plan.definition, name)
    plan = report.plan
    again = canonical_plan(without_roles(plan))
    assert without_roles(again) == without_roles(plan)
    assert meanings(again) == meanings(plan)
    tree = explain_canonical(as_branches(OWN[task]))
    assert (tree.source, roles_of(tree.plan)) == (report.source, roles_of(plan))
    assert lw.ConditionalPlan.from_json(task, as_branches(OWN[task]).to_json()) == as_branches(OWN[task])


def test_the_parser_does_not_use_the_shipped_plans_or_skills():
    for module in (canonical, step_parser, roles):
        source = inspect.getsource(module)
        assert not any(name in source for name in ("load_plans", "load_skills", "skills_for", "usual_goal"))


def test_a_plan_that_misses_states_is_completed():
    steps = [
        ("the gripper is not above the mug", "place the gripper above the mug"),
        ("the gripper is near the mug", "place the mug at goal"),
    ]
    report = explain_canonical(plan_of("coffee-pull", *steps))
    assert report.source == "completed"
    roles = roles_of(report.plan)
    assert [role.verb for role in roles] == ["approach", "descend", "close", "carry"]
    assert [role.target for role in roles] == ["mug rim"] * 3 + [GOAL]
    assert [(note["written"], note["seen"]) for note in report.notes()] == [
        *((step[1], False) for step in steps), (steps[0][1], True), (None, True), (None, True), (steps[1][1], True)
    ]  # fmt: skip


def test_a_completed_plan_keeps_its_own_conditions_as_far_as_they_are_right():
    steps = [
        ("the gripper is not vertically aligned with the mug", "hover over the mug"),
        ("the gripper is above the mug", "descend to the mug"),  # also at the mug
        ("the gripper is near the mug and the gripper is closed", "bring the mug to the goal"),  # not if it is wide
    ]
    plan = canonical_plan(plan_of("coffee-pull", *steps))
    rim = "the robot's gripper is {} the mug rim".format
    assert [(role.written, role.verb) for role in roles_of(plan)] == [
        (steps[0][1], "approach"), (steps[1][1], "descend"), ("", "close"), (steps[2][1], "carry")
    ]  # fmt: skip
    approach, descend, _, carry = (str(step.condition) for step in plan.steps)
    assert approach.startswith(f"{rim('not vertically aligned with')} or {rim('not above')}")
    assert descend == f"{rim('above')} and {rim('not near')}"
    assert carry.startswith(f"{rim('near')} and the robot's gripper is closed or ")


@given(st.sampled_from(sorted(OWN)), st.lists(st.integers(0, 5), min_size=1, max_size=4), st.booleans())
def test_a_completed_plan_is_complete_wherever_the_hand_is(task, numbers, is_short):
    steps = [OWN[task].steps[number % len(OWN[task].steps)] for number in numbers]
    conditions = [str(step.condition.clauses[-1] if is_short else step.condition) for step in steps]
    report = explain_canonical(plan_of(task, *zip(conditions, (step.skill for step in steps), strict=True)))
    if report.source == "completed":
        assert coverage_of(report.plan.definition, report.plan.steps) >= canonical.MIN_COVERAGE


def test_a_plan_without_a_motion_becomes_the_fallback_plan():
    steps = [("the gripper is open", "place the gripper above the mug"), ("the gripper is closed", "ponder")]
    report = explain_canonical(plan_of("coffee-pull", *steps))
    assert (report.source, report.left_out) == ("fallback", ("ponder",))
    fallback = fallback_plan("coffee-pull")
    assert without_roles(report.plan) == without_roles(fallback)
    assert explain_canonical(without_roles(fallback)).source == "plan"


def test_an_unreadable_step_is_left_out_by_name():
    steps = [*((str(s.condition), s.skill) for s in OWN["push"].steps), ("the gripper is closed", "be careful")]
    report = explain_canonical(plan_of("push", *steps))
    assert report.left_out == ("be careful",)
    assert report.notes()[-1] == dict.fromkeys(("skill", "verb", "moved", "target", "condition")) | {
        "written": "be careful", "seen": False
    }  # fmt: skip


def test_objects_of_a_custom_task():
    objects = {"cup": "obs[4:7]", "saucer": "obs[36:39]"}
    points = {"cup rim": {"object": "cup", "offset": [0.0, 0.0, 0.05]}}
    task = lw.Task.from_json("stack-cup", {"description": "Stack it.", "objects": objects, "points": points})
    steps = [
        ("gripper is not near the cup rim", "lower the gripper around the cup"),
        ("gripper is near the cup rim", "grab the cup"),
        ("gripper is near the cup rim and gripper is closed", "lift the cup onto the saucer"),
    ]
    parsed = parse_steps(plan_of(task, *steps))
    assert [(step.target, step.moved) for step in parsed] == [("cup", G), ("cup", G), ("saucer", "cup")]


def test_the_hand_goes_to_the_only_object_in_a_task_without_goal_and_first_object():
    task = lw.Task("touch-second", "Touch it.", (NamedObject(G, (0, 1, 2)), NamedObject("block", (11, 12, 13))))
    plan = plan_of(task, ("the gripper is not near the block", "move the gripper to the block"))
    assert [(role.verb, role.target) for role in roles_of(plan)] == [("reach", "block")]
    fallback = roles_of(fallback_plan(task))
    assert [(role.verb, role.target) for role in fallback] == [("reach", "block"), ("hold", "block")]


words = st.text("abcdefghijklmnopqrstuvwxyz '-.,0123456789", min_size=1, max_size=60)


@given(st.sampled_from(sorted(OWN)), st.lists(st.tuples(st.integers(0, 5), words), min_size=1, max_size=6))
def test_any_words_become_a_plan_that_covers_the_task(task, written):
    own = OWN[task].steps
    steps = [(own[number % len(own)].condition, f"push {text}") for number, text in written]
    plan = canonical_plan(plan_of(task, *steps))
    assert plan.steps
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
    assert report.source == other.source
    assert [step.skill for step in report.plan.steps] == [step.skill for step in other.plan.steps]


def test_the_longest_name_is_marked():
    task = OWN["drawer-open"].definition
    assert mark_objects("Pull the drawer handle, then the drawer", task) == "pull <drawer handle>, then <drawer handle>"
    assert first_object(lw.TASKS["reach"]) is None


def test_the_hand_cannot_be_its_own_target():
    far, over = "the gripper is not above the plate edge", "the gripper is above the plate edge"
    # As a small model wrote it.
    written = (far, "set the plate with the gripper above it"), (over, "lower the gripper onto the plate")
    report = explain_canonical(plan_of("plate-slide-back", *written, (over, "pull the plate to the target location")))
    assert report.source == "completed"
    assert {role.target for role in roles_of(report.plan) if role.moved == GRIPPER} == {"plate edge"}


# ---- roles

DIAL = canonical_plan(OWN["dial-turn"], fallback=True)


@pytest.fixture(scope="module")
def shipped():
    return canonical_plans(OWN, fallback=True)


def test_canonical_plans_are_plans_with_roles(shipped):
    assert shipped.has_roles
    assert not OWN.has_roles
    assert shipped.task_ids == OWN.task_ids == {task: lw.task_id(task) for task in lw.MT50}
    assert all(step.skill == step.role.skill for plan in shipped.values() for step in plan.steps)


def test_json_keeps_roles(shipped):
    for plans in (shipped, OWN):
        again = Plans.from_json(plans.to_json())
        assert again == plans
        assert again.numbers == plans.numbers
    assert OWN["push"].to_json() == {"plan": str(OWN["push"])}
    earlier = {**DIAL.to_json(), "confidence": 0.5}  # a key of earlier versions, which is ignored
    assert ConditionalPlan.from_json("dial-turn", earlier) == DIAL


def test_roles_do_not_change_which_queries_are_answered(shipped):
    bare = Plans([without_roles(plan) for plan in shipped.values()])
    assert bare != shipped
    assert bare.numbers == shipped.numbers


def test_canonical_plans_are_not_parsed_again(shipped):
    assert canonical_plans(shipped) == shipped
    assert canonical_plan(canonical_plan(OWN["push"]), fallback=True) == canonical_plan(OWN["push"], fallback=True)


def test_the_fallback_plan_follows_the_steps_of_the_plan():
    own = canonical_plan(OWN["dial-turn"])
    assert DIAL.steps[: len(own.steps)] == own.steps
    assert [step.role.fallback for step in DIAL.steps] == [False] * len(own.steps) + [True] * 5
    assert [step.role.verb for step in DIAL.steps[-5:]] == ["approach", "descend", "close", "move", "carry"]
    replaced = canonical_plan(plan_of("push", ("gripper is open", "ponder")), fallback=True)
    assert [step.role.fallback for step in replaced.steps] == [False] * 4 + [True] * 5
    assert [step.role.verb for step in replaced.steps[-3:]] == ["close", "carry", "move"], "first what it did not try"


def test_a_role_names_the_objects_of_a_step():
    (step,) = plan_of("push", ("gripper is open", "put the puck at the target location")).steps
    task, role = lw.TASKS["push"], StepRole("push", G, "puck", "push", "goal")
    assert step.mentions(task) == {G, "puck", GOAL}
    assert replace(step, skill="nudge it", role=role).mentions(task) == {G, "puck", GOAL}
    assert replace(step, skill="nudge it", role=replace(role, direction="left")).mentions(task) == {G, "puck"}


def test_vectors_of_roles_have_a_one_for_verb_and_manner_each():
    vectors = role_vectors([step.role for step in DIAL.steps])
    assert {sum(vector) for vector in vectors} == {2.0}
    assert len({tuple(vector) for vector in vectors}) > 3


def test_broken_json_is_refused():
    row = DIAL.to_json()
    role, *others = row["roles"]
    changes = {"verb": "juggle", "direction": "north", "target": "moon", "confidence": None, "colour": "red"}
    wrong = [("roles", [role | {name: value}, *others], name) for name, value in changes.items()]
    for key, value, message in [("roles", [], "one entry per step"), ("more", 1, "must be an object"), *wrong]:
        message = {"target": "object of task 'dial-turn'"}.get(message, message)
        with pytest.raises(PlanError, match=message):
            ConditionalPlan.from_json("dial-turn", row | {key: value})


def test_a_plan_in_order_of_priority_keeps_its_steps():
    rules = [
        ("gripper near puck and gripper closed", "carry the puck to the target location"),
        ("gripper near puck and gripper open", "close the gripper around the puck"),
        ("gripper above puck and gripper not near puck", "lower the gripper around the puck"),
        ("gripper not above puck and gripper not near puck", "place the gripper above the puck"),
    ]
    for pairs in (rules, rules[::-1]):
        assert explain_canonical(plan_of("pick-place", *pairs)).source == "plan"
    rules[0] = ("gripper above puck or gripper near puck and gripper closed", rules[0][1])  # also before the grasp
    assert explain_canonical(plan_of("pick-place", *rules)).source == "completed"
