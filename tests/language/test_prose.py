"""Prose: rules with labels, titles or numbers, and above notes; what no step says is named in a note."""

import pytest
from speed import within

import lw_torchrl as lw
from lw_torchrl.language.formats.base import Clause, Note
from lw_torchrl.language.formats.labels import labelled_rules, without_asides
from lw_torchrl.language.unread import unread

C, S = "the gripper is left of the drawer handle", "pull the drawer handle"
D, T = "the gripper is open", "close the gripper"
PLAN = [("the robot's gripper is left of the drawer handle", S), ("the robot's gripper is open", T)]
YAML = {
    "objects": f"- condition: {C}\n  action: {S}\n- condition: {D}\n  action: {T}",
    "tree": f"selector:\n- sequence:\n  - condition: {C}\n  - action: {S}",
    "documents": f"when: {C}\nact: {S}\n---\nwhen: {D}\nact: {T}",
}
RULES = f"1. If {C}, {S}.\n2. If {D}, {T}.\n\n"


def steps(text, task="drawer-open"):
    plan = lw.decode_plan(text, task).plan
    return [] if plan is None else [(str(step.condition), step.skill) for step in plan.steps]


@pytest.mark.parametrize("name", YAML)
def test_objects_of_yaml_are_not_rewritten(name):
    assert labelled_rules(YAML[name]) == YAML[name]


def test_labels_of_exceptions_and_other_cases_are_kept():
    text = f"**When:** {C}\n**Unless:** {D}\n**Do:** {S}\n**Otherwise:** {T}"
    rule = f"- When {C} and not ({D}), the robot should {S}."
    assert labelled_rules(text).split("\n") == ["", "", rule, f"- Otherwise, {T}."]
    assert steps(f"**Unless:** {D}\n**Do:** {S}") == [("the robot's gripper is not open", S)]
    joined = labelled_rules(f"If: {C} or {D}; and if: it is closed; why: to open it; do: {S}")
    assert joined == f"- When ({C} or {D}) and it is closed, the robot should {S}."


@pytest.mark.parametrize("label", ["Important rules:", "Notes:"])
def test_a_label_above_the_only_rules_does_not_remove_them(label):
    assert without_asides(f"{label}\n{RULES}", []) == f"{label}\n{RULES}"


@pytest.mark.parametrize("text", ["if: a\nthen: b\n" * 4_000, "a: " * 20_000, "**a " * 15_000, "Note:\n" * 10_000])
def test_labels_are_found_in_linear_time(text):
    with within(12):
        without_asides(labelled_rules(text), [])


# ---- what is not read

MUG_RULES = (
    "- When the gripper is not near the mug, move the gripper to the mug.\n"
    "- When the gripper is near the mug, push the mug to the target location.\n"
)
MOVE = ("the robot's gripper is not near the mug", "move the gripper to the mug")
PUSH = ("the robot's gripper is near the mug", "push the mug to the target location")


def notes(text):
    found = lw.decode_plan(text, "coffee-push")
    return " ".join([found.reason, *(note.text for note in found.notes)])


@pytest.mark.parametrize(
    "rule",
    [
        "When the coffee is cold, the robot should microwave it.",
        "- **Pause:** If a person waves, the robot should greet them.",
        "Salute whenever somebody applauds.",
        "Should the lamp flicker, the robot must unplug it.",
    ],
)
@pytest.mark.parametrize("place", ["above", "below"])
def test_a_rule_that_no_step_has_is_noted(rule, place):
    text = f"{rule}\n{MUG_RULES}" if place == "above" else f"{MUG_RULES}{rule}\n"
    assert steps(text, "coffee-push") == [MOVE, PUSH]
    assert any(word in notes(text) for word in ("cold", "waves", "applauds", "flicker"))


def test_a_rule_below_code_is_noted():
    code = (
        "```python\nif check('the gripper is near the mug'):\n    robot.push('the mug to the target location')\n```\n"
    )
    assert "cable" in notes(f"{code}Also, if the cable is loose, somebody should fix the cable.\n")
    assert "lift" in notes(f"{code}The robot must never lift the mug.\n")


def test_notes_of_a_text():
    clauses = [Clause(1, "the gripper is open", "push the mug")]
    assert unread("If the gripper is open, push the mug.\nIf it rains, sing.", clauses, [], True) == [
        Note(2, "the rule is not read: 'If it rains, sing.'")
    ]
