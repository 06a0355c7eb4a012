"""Texts of steps: objects are marked, and many ways to say something become the few that the parser knows."""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache

from lw_torchrl.language.named_objects import GOAL, GRIPPER
from lw_torchrl.language.task_objects import whole_objects
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.words import WORDS

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
