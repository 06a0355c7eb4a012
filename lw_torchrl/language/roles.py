"""StepRole: what a step does to which object, as policies see it."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any, Literal, get_args

from lw_torchrl._util.checks import Probability, shown, typed_fields
from lw_torchrl.language.objects import GOAL, GRIPPER, WORDS
from lw_torchrl.language.tasks import Task, whole_objects

_WORDS = WORDS["canonical"]
_HANDS: dict[str, str] = dict.fromkeys([GRIPPER, *_WORDS["hands"]], GRIPPER)  # other names of the gripper
_NO_NAME = {"location", "target", "reach", "other", "side", "top", "edge"}  # words that name nothing on their own
_GOAL = r"(?:the )?(?:reach |reacher )?(?:goal|target|destination)(?: (?:location|position|area|place|point|bin|spot))?"
_LONGEST = 500  # characters; a step is never longer, and rewriting takes time that grows with their square


def _any(words: Iterable[str]) -> str:
    return "(?:" + "|".join(map(re.escape, sorted(words, key=len, reverse=True))) + r")(?![\w'-])"


_PATTERNS = {
    "GOES": _any(_WORDS["goes"]),
    "WAY": rf"(?: {_any([*_WORDS['place'], *_WORDS['way']])})*",
    "PLACE": _any(_WORDS["place"]),
    "THING": r"(?:<[^>]*>|it|them|there|its \w+)(?![\w'-])",
    "HAND": f"<{GRIPPER}>",
}


def _compiled(text: str) -> re.Pattern[str]:
    """Compile a rewriting of the table, whose words in capitals stand for patterns."""
    for name, pattern in _PATTERNS.items():
        text = text.replace(name, pattern)
    return re.compile(text)


_REWRITINGS = [
    (_compiled(text), simple.replace("HAND", f"<{GRIPPER}>"))
    for group in _WORDS["rewritings"].values()
    for text, simple in group
]
_SYNONYMS = {word: verb for verb, words in _WORDS["synonyms"].items() for word in words}


def simplify(text: str) -> str:
    """Rewrite a text whose objects are marked: "carefully hover over <mug>" is "move <robot's gripper> over <mug>"."""
    if len(text) > _LONGEST:
        return text
    for pattern, simple in _REWRITINGS:
        text = pattern.sub(simple, text)
    verb, _, rest = text.partition(" ")
    return f"{_SYNONYMS.get(verb, verb)} {rest}".strip()


@lru_cache(maxsize=256)
def _names(task: Task) -> dict[str, str]:
    """Map regular expressions to the name of the object that they match, the longest first."""
    names = _HANDS | {name: name for name in task.object_names}
    words: dict[str, str] = {}
    for name in whole_objects(task):
        for word in re.findall(r"[a-z]+", name.replace("'s", "")):
            if word not in _NO_NAME:
                words.setdefault(word, name)
    longest = sorted(names, key=len, reverse=True)
    return (
        {re.escape(name): names[name] for name in longest}
        | {_GOAL: GOAL}
        | {f"{word}(?:'s)?": words[word] for word in words}
    )


def mark_objects(text: str, task: Task) -> str:
    """Put each object that a text names in <>: "put the gripper above <mug>"."""
    text = text.lower()
    for pattern, name in _names(task).items():
        text = re.sub(rf"(?<![\w<'-])(?:the )?(?:{pattern})(?![\w-])(?![^<]*>)", f"<{name}>", text)
    text = re.sub(r"(<[^>]*>) ?(?:handle|side|top|edge)\b", r"\1", text)
    return re.sub(r"(<[^>]*>)(?: \1)+", r"\1", text)


Verb = Literal["approach", "beside", "descend", "close", "open", "push", "pull", "carry", "move", "reach", "hold"]
"""What is done: "carry" goes through the air, "move" straight."""
Manner = Literal["grasp", "push", "press", "pull", "reach"]
"""The purpose of a step, which says how the hand comes: to grasp from above, to push from the side."""
Direction = Literal["left", "right", "away", "toward", "up", "down", "goal"]
VECTORS: dict[str, tuple[float, float, float]] = {way: tuple(xyz) for way, xyz in WORDS["roles"]["vectors"].items()}
"""Directions as unit vectors in the suites' frame; "left" and "right" are those of the query language."""
BY_HAND = ("approach", "descend", "beside", "open")
"""The verbs of a step that only brings the gripper to its place."""
_OWN_MOTIONS: list[list[str]] = WORDS["canonical"]["own"]
_SAME_MOTION: dict[str, Verb] = {"carry": "move", "open": "descend", "hold": "reach"}
_VERBS = [verb for verb in get_args(Verb) if verb not in _SAME_MOTION]
_SKILLS, _WAYS = WORDS["roles"]["skills"], WORDS["roles"]["ways"]


@typed_fields
@dataclass(frozen=True)
class StepRole:
    """What one step of a plan does, as :func:`~lw_torchrl.canonical_plan` reads it.

    What is moved, and its target, are names of the task's objects, or "target location", the goal.
    """

    verb: Verb
    moved: str
    target: str
    manner: Manner
    direction: Direction | None = None  # where an object is moved to, also of a hand that comes to do so
    toward: str | None = None  # the object that the direction "goal" leads to; None for the task's goal
    written: str = ""  # the skill in the plan's own words; "" for a step that the plan lacked
    confidence: Probability = 1.0  # from 0, a guess, to 1, stated in the plan's words
    fallback: bool = False  # whether the step is of the fallback plan, which is tried when the plan makes no progress

    @property
    def skill(self) -> str:
        """The step in the wording that all plans share: "carry the mug to the target location"."""
        said = _SKILLS[self.verb].format(moved=self.moved, target=self.target)
        way = "" if self.direction is None else _WAYS.get(self.direction, self.direction)
        way = f"toward the {self.toward or GOAL}" if way == "goal" else way
        if self.verb == "move" and way:
            return f"slide the {self.moved} {way}"
        if self.verb in ("push", "pull"):
            return f"{said} {way}"
        if self.verb in BY_HAND and self.manner != "grasp":
            return f"{said} to {self.manner} it {way}".rstrip()
        return said

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects that the step is about, "target location" for the goal."""
        led = (self.toward or GOAL,) if self.direction == "goal" else ()
        return tuple(dict.fromkeys((self.moved, self.target, *led)))

    def to_json(self) -> dict[str, Any]:
        """The fields that differ from their defaults; :meth:`from_json` reads them back."""
        return {each.name: value for each in fields(self) if (value := getattr(self, each.name)) != each.default}

    @classmethod
    def from_json(cls, row: Any) -> StepRole:
        """Rebuild a role from :meth:`to_json`; raise :class:`ValueError` for any other value."""
        names = [each.name for each in fields(cls)]
        if not isinstance(row, dict) or set(row) - {*names} or not {*names[:4]} <= set(row):
            raise ValueError(f"role must be a table of {', '.join(names)}, got {shown(row)}")
        try:
            return cls(**row)
        except TypeError as error:
            raise ValueError(f"role: {error}") from error


def motion_of(roles: Sequence[StepRole]) -> StepRole | None:
    """The last step that moves an object; in a plan without one, the last that brings the gripper to its place."""
    moving = [role for role in roles if role.verb in ("carry", "move", "push", "pull")]
    return next(reversed(moving or [role for role in roles if role.verb == "reach"]), None)


def role_vectors(roles: Sequence[StepRole]) -> list[list[float]]:
    """One vector for each step of a plan: what is done, without the objects.

    It holds ones for the step's verb, its manner and, if MT10 demonstrates the plan's motion in a way of its own, for
    that. Verbs of the same motion share theirs. The fallback plan's steps have a motion of their own.
    """
    vectors = []
    motions = {fallback: motion_of([role for role in roles if role.fallback is fallback]) for fallback in (False, True)}
    for role in roles:
        last, verb = motions[role.fallback], _SAME_MOTION.get(role.verb, role.verb)
        ones = [verb == name for name in _VERBS] + [role.manner == name for name in get_args(Manner)]
        ones += [last is not None and [last.moved, last.target] == pair for pair in _OWN_MOTIONS]
        vectors.append(list(map(float, ones)))
    return vectors
