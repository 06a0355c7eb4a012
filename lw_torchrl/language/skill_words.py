"""How a plan words its skills, and what these words say about the motion."""

from __future__ import annotations

import re

from lw_torchrl.language.tasks import Task

# fmt: off
_BEFORE_NOUN = {
    "above", "across", "against", "along", "and", "around", "at", "away", "back", "behind", "below", "beside",
    "between", "by", "down", "from", "in", "inside", "into", "near", "of", "off", "on", "onto", "or", "out", "over",
    "past", "through", "to", "toward", "towards", "under", "up", "with",
}

# fmt: on
_LONGEST_BEFORE = max(map(len, _BEFORE_NOUN))


def canonical_skill(skill: str, task: Task) -> str:
    """The skill in plain English: articles go before the nouns that lack one, as in the paper.

    A noun lacks one at the beginning and after a word like "above"; else ("the coffee mug") it is left alone.
    """
    first, _, details = " ".join(skill.split()).partition(" ")
    verb, *rest = first.replace("_", " ").split() or [""]
    if not re.fullmatch(r"[A-Za-z]\w*", verb):
        raise ValueError(f"skill must begin with a plain word like 'place', got {skill!r}")
    details = " ".join([*rest, _with_articles(details, task)]).strip()
    return f"{verb} {_with_articles(details, task)}".strip()


def _with_articles(details: str, task: Task) -> str:
    def article(match: re.Match[str]) -> str:
        end = match.start() - (details[match.start() - 1 : match.start()] == " ")
        start = max(0, end - _LONGEST_BEFORE - 1)  # no further: a text may be all nouns
        before = details[start:end].rpartition(" ")[2]
        return f"the {match[0]}" if not before or before in _BEFORE_NOUN else match[0]

    nouns = sorted({*task.object_names, "gripper"}, key=len, reverse=True)
    pattern = "|".join(re.escape(noun) for noun in nouns)
    return re.sub(rf"(?<![\w'-])(?:{pattern})(?![\w'-])", article, details)


_PUSHES = frozenset({"push", "pull", "turn", "press", "slide", "drag"})
_CLOSES = frozenset({"close", "closes", "grab", "grasp", "grip"})
_DIRECTIONS = frozenset(
    {"left", "right", "front", "behind", "beside", "away", "back", "forward", "robot", "into", "in", "out", "through"}
)


def pushes(skill: str) -> bool:
    """Whether a skill pushes or pulls: "turn the dial to the right" does, "place the gripper above the dial" not."""
    return skill.split()[0] in _PUSHES


def presses(skill: str) -> bool:
    """Whether a skill pushes straight down: "push the button down"."""
    return pushes(skill) and "down" in skill.split()


def closes(skill: str) -> bool:
    """Whether a skill closes the gripper: "close the gripper around the puck"."""
    return not _CLOSES.isdisjoint(skill.split())


def has_direction(skill: str) -> bool:
    """Whether a skill says a direction in the plane, as seen by the robot or by the thing: "to the left", "toward the
    robot", "in front of the drawer handle", "into the hole"; "toward the reach target" and "above the puck" say none.
    """
    return not _DIRECTIONS.isdisjoint(skill.split())
