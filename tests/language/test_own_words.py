"""Steps in words of one's own: what people say is read as what the shipped plans say in theirs."""

import json
import time
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.canonical import canonical_plan, explain_canonical
from lw_torchrl.language.objects import NamedObject
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.roles import mark_objects, simplify
from lw_torchrl.language.step_parser import parse_steps

PLANS = lw.load_plans("MT50")
SAYINGS = json.loads((Path(__file__).parent / "sayings.json").read_text("utf-8"))
"""Skills of 30 shipped plans, and ten paraphrases of each by three writers who saw neither rules nor plans."""
G = "robot's gripper"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("hover over the mug", "move <{G}> over <mug>"),
        ("carefully go straight down to it", "lower <{G}> to it"),
        ("reach for the mug", "move <{G}> for <mug>"),
        ("approach the mug", "move <{G}> to <mug>"),
        ("over the mug", "move <{G}> over <mug>"),
        ("line yourself up over the mug", "line <{G}> up over <mug>"),
        ("go on until the mug is between your fingers", "lower <{G}> around <mug>"),
        ("move until the mug is right below you", "move <{G}> above <mug>"),
        ("descend until the fingertips touch the mug", "lower <{G}> to <mug>"),
        ("get a firm grip on the mug", "grasp <mug>"),
        ("take hold of the mug", "grasp <mug>"),
        ("take the mug", "grasp <mug>"),
        ("get the mug to the goal", "carry <mug> to <target location>"),
        ("wrap your fingers around the mug", "grasp <{G}> around <mug>"),
        ("bring your fingers together on the mug", "close <{G}> around <mug>"),
        ("spread the fingers", "open <{G}>"),
        ("keep dragging the mug back", "dragg <mug> back"),
        ("keep pulling the mug back", "pull <mug> back"),
        ("give the mug a good shove to the left", "push <mug> to the left"),
        ("use the robot arm to shove the mug left", "push <mug> left"),
        ("yank the mug along the negative y axis", "pull <mug> backward"),
        ("apply a downward force to the mug", "press <mug> down"),
        ("line the mug up with the goal", "carry <mug> in line with <target location>"),
        ("let the mug down", "lower <mug> down"),
        ("put the gripper above the mug", "put <{G}> above <mug>"),
        ("go sit over that mug", "move <{G}> over <mug>"),
        ("make the gripper shut so it holds the mug", "close <{G}>"),
        ("move down till the mug is between both fingers", "lower <{G}> around <mug>"),
        ("press against the mug to displace it away from the robot", "press against <mug> away from the robot"),
    ],
)  # fmt: skip
def test_many_words_become_those_that_the_rules_know(text, said):
    assert simplify(mark_objects(text, lw.TASKS["coffee-pull"])) == said.format(G=G)


@pytest.mark.parametrize("skills", ["own", "MT10"])
def test_the_words_of_shipped_plans_are_known(skills):
    for task, plan in lw.load_plans("MT50", skills=skills).items():
        for step in plan.steps:
            marked = mark_objects(step.skill, lw.TASKS[task])
            assert simplify(marked) == marked


def steps_of(plan):
    return [(role.verb, role.moved, role.target, role.manner, role.direction) for role in (s.role for s in plan.steps)]


def test_nine_of_ten_paraphrases_are_read_as_what_they_paraphrase():
    alike, unread = [], 0
    for plan in PLANS.values():
        meant = steps_of(canonical_plan(plan))
        for step in plan.steps:
            for text in SAYINGS.get(step.skill, ()):
                said = [(one.condition, text if one is step else one.skill) for one in plan.steps]
                report = explain_canonical(ConditionalPlan.from_pairs(plan.definition, said))
                alike.append(steps_of(report.plan) == meant)
                unread += bool(report.left_out)
    assert len(alike) > 1100
    assert sum(alike) >= 0.9 * len(alike)
    assert unread < 0.02 * len(alike)


@pytest.mark.parametrize("hand", ["gripper", "fingers", "the hand"])
def test_to_open_it_is_no_name_of_the_gripper(hand):
    (found,) = parse_steps(ConditionalPlan.from_pairs("push", [("gripper is near the puck", f"open {hand}")]))
    assert found.verb == "open"


def test_it_is_what_the_step_before_was_done_to():
    held = "gripper is near the stick handle and gripper is closed"
    steps = ("gripper is near the stick handle and gripper is open", "grab the stick"), (held, "aim it at the thermos")
    plan = ConditionalPlan.from_pairs("stick-pull", [*steps, (held, "then poke it into the thermos")])
    assert [(one.moved, one.target) for one in parse_steps(plan)[1:]] == [("stick", "thermos")] * 2


def test_it_is_the_gripper_where_the_thing_is_named_besides():
    over = (
        ("gripper not above the mug", "go over the mug"),
        ("gripper not near the mug", "bring it down next to the mug"),
    )
    assert [one.moved for one in parse_steps(ConditionalPlan.from_pairs("coffee-pull", over))] == [G, G]


def test_two_motions_in_a_step_are_the_last_where_a_plan_has_no_other():
    over, near = "gripper not above the drawer handle", "gripper near the drawer handle"
    steps = (over, "hover over the drawer handle"), (near, "grab the handle and yank it back")
    *_, found = parse_steps(ConditionalPlan.from_pairs("drawer-open", steps))
    assert (found.verb, found.target, found.direction) == ("pull", "drawer handle", "toward")
    closed = near + " and gripper is closed"
    plan = ConditionalPlan.from_pairs("drawer-open", [*steps, (closed, "pull the drawer back")])
    assert [one.verb for one in parse_steps(plan)] == ["approach", "close", "move"]


def test_a_thing_called_like_a_hand_is_a_thing():
    task = replace(
        lw.TASKS["push"], name="shake", objects=(*lw.TASKS["push"].objects[:1], NamedObject("hand", (4, 5, 6)))
    )
    assert mark_objects("take the hand with your fingers", task) == f"take <hand> with your <{G}>"


@given(st.lists(st.sampled_from(["go", "to", "the mug", "it", "until", "is", "between", "on", "a", "keep", "lying"])))
def test_any_text_is_rewritten_and_no_thing_comes_from_nowhere(words):
    marked = mark_objects(" ".join(words), lw.TASKS["coffee-pull"])
    found = simplify(marked)
    assert found.count("<mug>") <= marked.count("<mug>")


def test_a_text_of_any_length_takes_no_time():
    started = time.perf_counter()
    for text in ("go " + "to " * 80_000, "line <mug> " + "a " * 80_000, "until " * 40_000):
        simplify(text)
    assert time.perf_counter() - started < 5
