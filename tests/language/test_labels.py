"""Rules of prose that stand side by side: with labels, titles or numbers, in one line, and above notes."""

import pytest
from speed import within

import lw_torchrl as lw
from lw_torchrl.language.formats.labels import labelled_rules, without_asides

C, S = "the gripper is left of the drawer handle", "pull the drawer handle"
D, T = "the gripper is open", "close the gripper"
PLAN = [("the robot's gripper is left of the drawer handle", S), ("the robot's gripper is open", T)]
LABELLED = {
    "trigger": f"*Trigger:* {C}\n*Response action:* {S}\n\n*Trigger:* {D}\n*Response action:* {T}",
    "bare": f"Given: {C}\nThen: {S}\n\nGiven: {D}\nThen: {T}",
    "titles": f"## Rule 1: Open the drawer\n- If: {C}\n- Do: {S}\n\n## Rule 2: Grasp the handle\n- If: {D}\n- Do: {T}",
    "numbers": f"1. When: {C}\n   Command: {S}\n2. When: {D}\n   Command: {T}",
    "numbered titles": f"1. Open the drawer\n   When: {C}\n   Do: {S}\n2. Grasp\n   When: {D}\n   Do: {T}",
    "action first": f"Skill: {S}\nCondition: {C}\n\nSkill: {T}\nCondition: {D}",
    "one line": f"If: {C}; then: {S}\nIf: {D}; then: {T}",
    "next line": f"IF:\n  {C}\nTHEN:\n  {S}\n\nIF:\n  {D}\nTHEN:\n  {T}",
    "reasons": f"**Check:** {C}\n**Why:** to open it\n**Do:** {S}\n\n**Check:** {D}\n**Why:** to hold it\n**Do:** {T}",
    "scenarios": f"Given {C}\nThen {S}\n\nGiven {D}\nThen {T}",
}
YAML = {
    "objects": f"- condition: {C}\n  action: {S}\n- condition: {D}\n  action: {T}",
    "tree": f"selector:\n- sequence:\n  - condition: {C}\n  - action: {S}",
    "documents": f"when: {C}\nact: {S}\n---\nwhen: {D}\nact: {T}",
}
SIDE_BY_SIDE = {
    "bold titles": f"1. **Open** - once {C}, {S}.\n2. **Grasp** - whenever {D}, {T}.",
    "titles with objects": f"### Step 1: Pull the drawer\nWhen {C}, {S}.\n### Step 2: Grasp it\nWhen {D}, {T}.",
    "rules": f"Rule 1: when {C}, {S}.\nRule 2: when {D}, {T}.",
    "conditions last": f"Step 1: {S} if {C}.\nStep 2: {T} if {D}.",
    "actions below": f"1. If {C}:\n{S}\n2. If {D}:\n{T}",
    "numbers in a line": f"(1) If {C}, {S} (2) If {D}, {T}",
    "words in a line": f"Case 1: if {C}, {S} Case 2: if {D}, {T}",
    "whereas": f"If {C}, {S}, whereas if {D}, {T}.",
    "then": f"If {C} then {S}, if {D} then {T}.",
    "colons": f"If {C}: {S}, if {D}: {T}",
    "slash": f"When {C}, {S} / When {D}, {T}",
    "arrows": f"{C} => {S}\n{D} => {T}",
    "code spans": f"- Once `{C}`, the robot should `{S}`.\n- Once `{D}`, the robot should `{T}`.",
    "column of the gripper": f"| When | Gripper | Do |\n|---|---|---|\n| {C} | | {S} |\n| {D} | | {T} |",
    "column of warnings": f"| If | Do not | Do |\n|---|---|---|\n| {C} | lift it | {S} |\n| {D} | push it | {T} |",
}
RULES = f"1. If {C}, {S}.\n2. If {D}, {T}.\n\n"
ASIDES = {
    "Safety constraints:\n- Open the gripper if the handle is stuck.\n- Never push.": [
        "Open the gripper",
        "Never push",
    ],
    "**Notes**\n\n1. Keep the gripper above the table.": ["Keep the gripper above"],
    "Requirements:\n- Move slowly.\n- Push the drawer gently.": ["Move slowly", "Push the drawer"],
    "Warning: open the gripper only when it is near the handle.": ["open the gripper"],
}


def steps(text):
    plan = lw.decode_plan(text, "drawer-open").plan
    return [] if plan is None else [(str(step.condition), step.skill) for step in plan.steps]


def test_a_block_below_an_if_with_not_is_its_branch():
    text = f"If the gripper is not open:\n    {S}\nElse:\n    {T}"
    assert steps(text) == [("the robot's gripper is not open", S), ("the robot's gripper is open", T)]


def test_a_column_of_a_table_may_state_what_the_gripper_is():
    text = f"| When | Gripper | Do |\n|---|---|---|\n| {C} | closed | {S} |"
    assert steps(text) == [(f"{PLAN[0][0]} and the robot's gripper is closed", S)]


def test_forbidden_rules_in_yaml_are_left_out_by_name():
    text = f"rules:\n- when: {C}\n  do: {S}\nnever:\n- when: {D}\n  do: {T}"
    assert steps(text) == PLAN[:1]
    assert any("never:" in note.text and "left out" in note.text for note in lw.decode_plan(text, "drawer-open").notes)


def test_a_rule_in_json_may_have_a_goal_instead_of_an_action():
    text = '{"rules": [{"when": "gripper open", "goal": "gripper near drawer handle"}]}'
    assert steps(text) == [("the robot's gripper is open", "move the gripper near the drawer handle")]


@pytest.mark.parametrize("name", LABELLED)
def test_each_pair_of_labels_is_a_rule(name):
    assert steps(LABELLED[name]) == PLAN


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


def test_a_rule_with_an_unknown_condition_is_left_out_by_name():
    found = lw.decode_plan(f"**If:** somebody waves\n**Then:** {S}\n\n**If:** {D}\n**Then:** {T}", "drawer-open")
    assert [step.skill for step in found.plan.steps] == [T]
    assert "somebody waves" in " ".join(map(str, found.notes))


@pytest.mark.parametrize("name", SIDE_BY_SIDE)
def test_rules_with_conditions_of_their_own_do_not_wait_for_each_other(name):
    assert steps(SIDE_BY_SIDE[name]) == PLAN


def test_numbered_actions_run_in_turn():
    first, second = steps(f"1. Open the gripper.\n2. When {C}, {S}.")
    assert first == ("the robot's gripper is not open", "Open the gripper")
    assert second == (f"the robot's gripper is open and {PLAN[0][0]}", S)


@pytest.mark.parametrize("end", ["and juggle", "then juggle twice, and then lift it", "juggle, and lift it"])
def test_an_unknown_action_in_a_list_is_named(end):
    found = lw.decode_plan(f"When {D}, {T}, {end}.", "drawer-open")
    assert found.plan.steps[0].skill == T
    assert any("juggle" in note.text for note in found.notes)


@pytest.mark.parametrize("aside", ASIDES)
def test_notes_and_constraints_do_not_change_the_plan(aside):
    found = lw.decode_plan(RULES + aside, "drawer-open")
    assert [(str(step.condition), step.skill) for step in found.plan.steps] == PLAN
    notes = " ".join(map(str, found.notes))
    assert all(text in notes for text in ASIDES[aside])


@pytest.mark.parametrize("label", ["Important rules:", "Notes:"])
def test_a_label_above_the_only_rules_does_not_remove_them(label):
    assert without_asides(f"{label}\n{RULES}", []) == f"{label}\n{RULES}"


@pytest.mark.parametrize("text", ["if: a\nthen: b\n" * 4_000, "a: " * 20_000, "**a " * 15_000, "Note:\n" * 10_000])
def test_labels_are_found_in_linear_time(text):
    with within(12):
        without_asides(labelled_rules(text), [])
