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
