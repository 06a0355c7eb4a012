"""What no step says is named in a note: rules, distances, prohibitions, headings of what not to do."""

import pytest

import lw_torchrl as lw
from lw_torchrl.language.formats.base import Clause, Note
from lw_torchrl.language.unread import unread

RULES = (
    "- When the gripper is not near the mug, move the gripper to the mug.\n"
    "- When the gripper is near the mug, push the mug to the target location.\n"
)
MOVE = ("the robot's gripper is not near the mug", "move the gripper to the mug")
PUSH = ("the robot's gripper is near the mug", "push the mug to the target location")


def steps(text: str) -> list[tuple[str, str]]:
    plan = lw.decode_plan(text, "coffee-push").plan
    return [] if plan is None else [(str(step.condition), step.skill) for step in plan.steps]


def notes(text: str) -> str:
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
    text = f"{rule}\n{RULES}" if place == "above" else f"{RULES}{rule}\n"
    assert steps(text) == [MOVE, PUSH]
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


@pytest.mark.parametrize(
    ("condition", "is_near"),
    [
        ("the gripper is within 3 cm of the mug", True),
        ("the gripper is closer than 35 mm to the mug", True),
        ("the gripper is at most 0.05 m from the mug", True),
        ("the gripper is less than an inch from the mug", True),
        ("the gripper is farther than 5 centimetres from the mug", False),
        ("the gripper is more than 40 mm away from the mug", False),
        ("the gripper is within 20 cm of the mug", None),
        ("the gripper is more than half a metre away from the mug", None),
        ("the gripper is 12 cm above the mug", None),
        ("the mug is less than 2 feet from the target location", None),
    ],
)
def test_only_a_small_distance_is_near(condition, is_near):
    text = f"- When {condition}, the robot should push the mug."
    expected = {True: "the robot's gripper is near the mug", False: "the robot's gripper is not near the mug"}
    assert steps(text) == ([] if is_near is None else [(expected[is_near], "push the mug")])
    assert is_near is not None or condition[:20] in notes(text)


@pytest.mark.parametrize(
    ("test", "condition"),
    [
        ("distance(gripper, mug) < 0.05", "the robot's gripper is near the mug"),
        ("np.linalg.norm(gripper_pos - mug_pos) >= 0.03", "the robot's gripper is not near the mug"),
        ("distance(gripper, mug) < 0.5", None),
        ("distance(gripper, mug) > FAR", None),
    ],
)
def test_only_a_small_threshold_in_code_is_near(test, condition):
    text = f"FAR = 0.3\ndef coffee_push():\n    if {test}:\n        robot.push(mug)\n"
    assert [each for each, _ in steps(text)] == ([] if condition is None else [condition])


def test_only_a_small_threshold_in_json_is_near():
    text = '[{"when": {"left": "distance(gripper, mug)", "op": "<", "right": %s}, "do": "push the mug"}]'
    assert steps(text % 0.04) == [("the robot's gripper is near the mug", "push the mug")]
    assert steps(text % 0.4) == []


@pytest.mark.parametrize(
    "above",
    [
        "Don'ts:\n- lift the mug\n- open the gripper\n\nDos:\n",
        "What **not** to do:\n\n1. Lift the mug.\n2. Open the gripper.\n\nWhat to do:\n\n",
        "The robot must not do this:\n- lift the mug\n\nIt should do this:\n",
        "Thinking aloud\n--------------\nIf the gripper is open, lift the mug. Silly.\n\nAnswer\n------\n",
        "# Thoughts (skip this)\n- If the gripper is open, lift the mug.\n\n# Plan\n",
        "> The task `hammer` is to hit the nail.\n> - When the gripper is open, lift the mug.\n\nMine:\n\n",
    ],
)
def test_what_a_heading_forbids_or_a_quotation_says_is_left_out(above):
    assert steps(above + RULES) == [MOVE, PUSH]
    assert "left out" in notes(above + RULES)


@pytest.mark.parametrize("key", ["avoid", "constraints", "rules_of_safety"])
def test_prohibitions_in_yaml_are_left_out_by_name(key):
    text = f"{key}:\n- never lift the mug\nsteps:\n- when: the gripper is near the mug\n  do: push the mug\n"
    assert steps(text) == [("the robot's gripper is near the mug", "push the mug")]
    assert "lift the mug" in notes(text)
    assert "lifting" in notes(text.replace(f"{key}:\n- never lift the mug", "avoid: lifting the mug"))


def test_an_arrow_guards_its_action_even_if_the_state_is_unknown():
    text = "* mug full -> push the mug to the target location\n* gripper near mug -> close the gripper around the mug\n"
    assert steps(text) == [("the robot's gripper is near the mug", "close the gripper around the mug")]
    assert "mug full" in notes(text)


def test_while_in_yaml_is_a_condition():
    text = "while the gripper is not near the mug:\n    move the gripper to the mug\nelse:\n    push the mug\n"
    assert steps(text)[0] == MOVE


def test_an_empty_branch_has_a_condition():
    text = "if the gripper is near the mug:\n    do not lift the mug\nelse:\n    move the gripper to the mug\n"
    assert steps(text) == [MOVE]


def test_rules_that_are_wrapped_after_any_word_are_whole():
    text = (
        "1. When the gripper is not near the mug, the robot should\nmove the gripper to the mug.\n"
        + RULES.partition("\n")[2]
    )
    assert steps(text) == [MOVE, PUSH]


@pytest.mark.parametrize("joint", ["and", "or"])
def test_two_adverbs_share_a_relation(joint):
    said = f"the gripper is not horizontally {joint} vertically aligned with the mug"
    text = f"- When {said}, the robot should push the mug."
    other = {"and": "or", "or": "and"}[joint]
    ((condition, _),) = steps(text)
    assert condition == (
        f"the robot's gripper is not horizontally aligned with the mug {other} "
        "the robot's gripper is not vertically aligned with the mug"
    )


def test_statements_without_a_function_are_code():
    text = "```python\nif not gripper_near_mug:\n    move_gripper_to_mug()\nelse:\n    push_mug()\n```"
    assert [condition for condition, _ in steps(text)] == [MOVE[0], PUSH[0]]


@pytest.mark.parametrize("test", ["is_far(gripper, mug)", "far(gripper, mug)", "not near(gripper, mug)"])
def test_far_is_not_near(test):
    assert steps(f"def coffee_push():\n    if {test}:\n        move_to(mug)\n")[0][0] == MOVE[0]


def test_never_if_forbids_its_action():
    rules = "- when: the gripper is near the mug\n  do: push the mug\n"
    rules += "- never_if: the mug is near the target location\n  do: lift it\n"
    assert [skill for _, skill in steps(rules)] == ["push the mug"]
    assert "'never_if' forbids it" in notes(rules)


def test_cases_of_a_switch_are_conditions():
    text = "switch:\n  case gripper is not near mug: move the gripper to the mug\n  case gripper is near mug: push it\n"
    assert [condition for condition, _ in steps(text)] == [MOVE[0], PUSH[0]]


def test_rows_of_a_table_that_no_step_has_are_noted():
    table = "| Condition | Skill |\n|---|---|\n| gripper near mug | push the mug |\n| a song plays | dance |\n"
    assert [skill for _, skill in steps(table)] == ["push the mug"]
    assert "song" in notes(table)
