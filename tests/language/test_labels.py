"""Rules of prose that stand side by side: with labels, titles or numbers, in one line, and above notes."""

import pytest
from speed import within

import lw_torchrl as lw
from lw_torchrl.language.formats.labels import labelled_rules, without_asides

C, S = "the gripper is left of the drawer handle", "pull the drawer handle"
D, T = "the gripper is open", "close the gripper"
PLAN = [("the robot's gripper is left of the drawer handle", S), ("the robot's gripper is open", T)]
YAML = {
    "objects": f"- condition: {C}\n  action: {S}\n- condition: {D}\n  action: {T}",
    "tree": f"selector:\n- sequence:\n  - condition: {C}\n  - action: {S}",
    "documents": f"when: {C}\nact: {S}\n---\nwhen: {D}\nact: {T}",
}
RULES = f"1. If {C}, {S}.\n2. If {D}, {T}.\n\n"


def steps(text):
    plan = lw.decode_plan(text, "drawer-open").plan
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
