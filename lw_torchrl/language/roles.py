"""Parse the roles of a plan step (verb, objects and direction), and rewrite free-form steps."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import groupby, pairwise
from typing import Any, Literal, get_args

from rapidfuzz.distance import OSA

from lw_torchrl._util.checks import Probability, check_keys, typed_fields
from lw_torchrl.language.objects import GOAL, GRIPPER, WORDS
from lw_torchrl.language.polarity import MOTIONS, command_form, instruction
from lw_torchrl.language.tasks import TASKS, Task, whole_objects

_WORDS = WORDS["canonical"]
_HANDS: dict[str, str] = dict.fromkeys([GRIPPER, *_WORDS["hands"]], GRIPPER)  # names of the gripper
_NO_NAME = {"location", "target", "reach", "other", "side", "top", "edge"}  # words that do not identify an object
_NOUN_PHRASE = {"the", "a", "an", "its", "your", "both", "it", "they", "nice", "and", *_WORDS["place"]}
_BESIDE = re.compile(
    rf"\b({'|'.join(_WORDS['places']['beside'])}|front|behind|below|under)(?: of| to)? <(?:target|reach) "
)
_LATER = re.compile(r"(?:[,;]|\bthen\b) (?:and |then )*((\w+)\b.*)")  # a second action: "then push it back"
_GOAL = r"(?:the )?(?:reach |reacher )?(?:goal|target|destination)(?: (?:location|position|area|place|point|bin|spot))?"
_LONGEST = 500  # characters; no real step is longer, and the rewriting time grows quadratically


def _any(words: Iterable[str]) -> str:
    """Return a regular expression for any of the words, the longest first."""
    return "(?:" + "|".join(map(re.escape, sorted(words, key=len, reverse=True))) + r")(?![\w'-])"


_PATTERNS = {
    "GOES": _any(_WORDS["goes"]),
    "WAY": rf"(?: {_any([*_WORDS['place'], *_WORDS['way']])})*",
    "PLACE": _any(_WORDS["place"]),
    "THING": r"(?:<[^>]*>|it|them|there|its \w+)(?![\w'-])",
    "HAND": f"<{GRIPPER}>",
    "ATTACHED": f"<{_any(_WORDS['attached'])}>",
}


def _compiled(text: str) -> re.Pattern[str]:
    """Compile a regular expression from words.toml, in which words in capitals stand for patterns."""
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
    """Rewrite a step with marked objects: "hover over <mug>" becomes "move <robot's gripper> over <mug>"."""
    if len(text) > _LONGEST:
        return text
    for pattern, simple in _REWRITINGS:
        text = pattern.sub(simple, text)
    verb, _, rest = text.partition(" ")
    return f"{_SYNONYMS.get(verb, verb)} {rest}".strip()


@lru_cache(maxsize=256)
def _names(task: Task) -> dict[str, str]:
    """Map regular expressions to the name of the object that each matches, the longest first."""
    names = _HANDS | {name: name for name in task.object_names}
    words: dict[str, str] = {}
    for name in whole_objects(task):
        for word in re.findall(r"[a-z]+", name.replace("'s", "")):
            if word not in _NO_NAME:
                words.setdefault(word, name)
    attached = [name for name in whole_objects(task) if name in _WORDS["attached"]]
    if len(attached) == 1:  # "the lever" is the handle
        words = dict.fromkeys(_WORDS["attached"], attached[0]) | words
    longest = sorted(names, key=len, reverse=True)
    return (
        {re.escape(name): names[name] for name in longest}
        | {_GOAL: GOAL}
        | {f"{word}(?:'s)?": words[word] for word in words}
    )


@lru_cache(maxsize=1)
def vocabulary() -> frozenset[str]:
    """Return the words of the tables and of the 50 tasks. These words are never corrected as misspelled."""
    texts = [text for task in TASKS.values() for text in (task.description, *task.object_names)]
    return frozenset(re.findall(r"[a-z]+", f"{WORDS} {' '.join(texts)}".lower()))


def respell(text: str, task: Task) -> str:
    """Correct misspelled words for actions, places and a task's objects: "cloze teh pukc" becomes "close the puck".

    A word is treated as a misspelling if it begins with the right letter and differs by one or two letters, or by two
    letters that are swapped. If the text spells a name correctly elsewhere, no word is corrected to that name.
    """
    words = re.findall(r"[a-z]+", text)
    objects = {"target", "location", *re.findall(r"[a-z]{3,}", " ".join(task.object_names))}
    names = {"the", *objects, *re.findall(r"[a-z]{4,}", " ".join((*_WORDS["hands"], *_WORDS["place"])))}
    missing = [name for name in sorted(names) if name not in words or name == "the"]

    def corrected(match: re.Match[str]) -> str:
        word = match[0]
        if word in vocabulary() or len(word) < 2:
            return word
        for name in missing:
            most = 2 if len(name) >= 7 and name not in _WORDS["place"] else 1
            if name[0] != word[0] or OSA.distance(word, name, score_cutoff=most) > most or f"{word}s" == name:
                continue
            # In a short word, a wrong letter may give a different word ("hard", "hand"), but swapped letters do not.
            if (
                len(name) >= 6
                or (name in objects and len(name) > 3)
                or sorted(word) == sorted(name)
                or (name != "the" and len(word) != len(name))
            ):
                return name
        return word

    verb = text.partition(" ")[0]
    if verb not in vocabulary() and len(verb) > 3:
        near = [each for each in MOTIONS if each[0] == verb[0] and OSA.distance(each, verb, score_cutoff=1) <= 1]
        text = near[0] + text.removeprefix(verb) if len(near) == 1 else text
    return re.sub(r"(?<![\w'-])[a-z]+(?![\w'-])", corrected, text)


@lru_cache(maxsize=256)
def _used_words(task: Task) -> frozenset[str]:
    """Return the words that the parser of steps uses for a task."""
    names = [name for other in (task, *TASKS.values()) for name in other.object_names]
    tables = str((_WORDS, WORDS["negation"]["affirms"], WORDS["negation"]["manner"]))
    text = " ".join((re.sub(r"\\+[a-z]", " ", tables), task.description, *names))
    return (frozenset(re.findall(r"[a-z]+", text.lower())) | MOTIONS) - {*_WORDS["unexpressed"]}


@lru_cache(maxsize=4096)
def ignored_words(skill: str, task: Task) -> str:
    """Return the words of a skill that the parser ignores because no step can express them; "" if there are none.

    Example:
        >>> ignored_words("push the puck three times, but do not touch the wall", TASKS["push"])
        'three times; but do not touch the wall'
    """
    text, aside, _ = instruction(skill)
    marked = mark_objects(text, task)
    runs = groupby(_tokens(marked), lambda word: _is_used(word, task))
    ignored = [" ".join(run) for is_used, run in runs if not is_used] + _BESIDE.findall(marked)
    if (later := _LATER.search(text)) and (later[2] in MOTIONS or command_form(later[2])):
        ignored.append(later[1])
    return "; ".join([*ignored, *([aside] if aside else [])])


def _tokens(marked: str) -> list[str]:
    """Split a text with marked objects into words, with "<>" for each object."""
    return re.findall(r"<>|[\w'-]+", re.sub(r"<[^>]*>(?:'s)?", "<>", marked))


def _is_used(word: str, task: Task) -> bool:
    """Return whether the step parser uses a word."""
    form = re.sub(r"(?:ed|es|s)$", "ing", word)  # "aligned", "touches"
    return _used_words(task).issuperset(re.findall(r"\w+", word)) or command_form(form) is not None


def has_certain_target(skill: str, task: Task) -> bool:
    """Return whether a skill's target is certain, unlike in "opposite of the puck" or "outside the puck".

    Before the last object, an unknown word may only stand inside a noun phrase: "to the standoff pose above the puck".
    """
    *before, _ = re.split("(?=<)", mark_objects(skill, task))
    words = _tokens(before[-1]) if before else []
    used = [_is_used(word, task) for word in words]
    return all(
        is_used or not is_first_used or first in _NOUN_PHRASE
        for (is_first_used, is_used), first in zip(pairwise(used), words, strict=False)
    )


def mark_objects(text: str, task: Task) -> str:
    """Put each object that a text mentions in <>: "put <robot's gripper> above <mug>"."""
    text = respell(text.lower(), task)
    for pattern, name in _names(task).items():
        text = re.sub(rf"(?<![\w<'-])(?:the )?(?:{pattern})(?![\w-])(?![^<]*>)", f"<{name}>", text)
    text = re.sub(r"(<[^>]*>) ?(?:handle|side|top|edge)\b", r"\1", text)
    return re.sub(r"(<[^>]*>)(?: \1)+", r"\1", text)


Verb = Literal["approach", "beside", "descend", "close", "open", "push", "pull", "carry", "move", "reach", "hold"]
"""The action of a step. "carry" lifts an object through the air; "move" moves an object in a straight line."""
Manner = Literal["grasp", "push", "press", "pull", "reach"]
"""The purpose of a step, which determines how the hand approaches: from above to grasp, from the side to push."""
Direction = Literal["left", "right", "away", "toward", "up", "down", "goal"]
VECTORS: dict[str, tuple[float, float, float]] = {way: tuple(xyz) for way, xyz in WORDS["roles"]["vectors"].items()}
"""Unit vectors of the directions in the suites' frame; "left" and "right" are as in the query language."""
BY_HAND = ("approach", "descend", "beside", "open")
"""The verbs of steps that only position the gripper."""
_OWN_MOTIONS: list[list[str]] = WORDS["canonical"]["own"]
_SAME_MOTION: dict[str, Verb] = {"carry": "move", "open": "descend", "hold": "reach"}
_VERBS = [verb for verb in get_args(Verb) if verb not in _SAME_MOTION]
_SKILLS, _WAYS = WORDS["roles"]["skills"], WORDS["roles"]["ways"]


@typed_fields
@dataclass(frozen=True)
class StepRole:
    """The meaning of one plan step, as parsed by :func:`~lw_torchrl.canonical_plan`.

    Objects are named as in the task, and the goal is named "target location".
    """

    verb: Verb
    moved: str  # the object that moves
    target: str  # the object or point to move to
    manner: Manner
    direction: Direction | None = None  # direction of the object's motion; also set for steps that approach
    toward: str | None = None  # the object in the direction "goal"; None for the task's goal
    written: str = ""  # the skill as written in the plan; "" for an added step
    confidence: Probability = 1.0  # from 0 (a guess) to 1 (stated in the plan)
    fallback: bool = False  # whether this is a fallback step, tried when the plan makes no progress

    @property
    def skill(self) -> str:
        """The step in standard wording: "carry the mug to the target location"."""
        skill = _SKILLS[self.verb].format(moved=self.moved, target=self.target)
        way = "" if self.direction is None else _WAYS.get(self.direction, self.direction)
        way = f"toward the {self.toward or GOAL}" if way == "goal" else way
        if self.verb == "move" and way:
            return f"slide the {self.moved} {way}"
        if self.verb in ("push", "pull"):
            return f"{skill} {way}"
        if self.verb in BY_HAND and self.manner != "grasp":
            return f"{skill} to {self.manner} it {way}".rstrip()
        return skill

    @property
    def objects(self) -> tuple[str, ...]:
        """The names of the objects that the step mentions; the goal is "target location"."""
        goal = (self.toward or GOAL,) if self.direction == "goal" else ()
        return tuple(dict.fromkeys((self.moved, self.target, *goal)))

    def to_json(self) -> dict[str, Any]:
        """Convert the role to JSON: the fields that differ from their defaults."""
        return {each.name: value for each in fields(self) if (value := getattr(self, each.name)) != each.default}

    @classmethod
    def from_json(cls, row: Any) -> StepRole:
        """Rebuild a role from :meth:`to_json`; raise a ValueError if ``row`` is not such JSON."""
        names = [each.name for each in fields(cls)]
        check_keys("role", row, names, names[:4])
        return cls(**row)


def motion_of(roles: Sequence[StepRole]) -> StepRole | None:
    """Return the last role that moves an object; otherwise the last that reaches a place; otherwise None."""
    moving = [role for role in roles if role.verb in ("carry", "move", "push", "pull")]
    return next(reversed(moving or [role for role in roles if role.verb == "reach"]), None)


def role_vectors(roles: Sequence[StepRole]) -> list[list[float]]:
    """Return a vector for each step of a plan that encodes the step's action without its objects.

    The vector is a one-hot verb, a one-hot manner, and flags: one for each (object, target) pair that MT10's experts
    move in an unusual way, set if the plan's motion has this pair. Verbs with the same motion share an entry. The flags
    of fallback steps describe the fallback plan's motion.
    """
    vectors = []
    motions = {fallback: motion_of([role for role in roles if role.fallback is fallback]) for fallback in (False, True)}
    for role in roles:
        last, verb = motions[role.fallback], _SAME_MOTION.get(role.verb, role.verb)
        ones = [verb == name for name in _VERBS] + [role.manner == name for name in get_args(Manner)]
        ones += [last is not None and [last.moved, last.target] == pair for pair in _OWN_MOTIONS]
        vectors.append(list(map(float, ones)))
    return vectors
