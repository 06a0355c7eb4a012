"""What people say in many words, in the few that the rules for canonical plans know."""

from __future__ import annotations

import re
from collections.abc import Iterable

from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.skills import WORDS

_WORDS = WORDS["canonical"]
HANDS: dict[str, str] = dict.fromkeys([GRIPPER, *_WORDS["hands"]], GRIPPER)
"""What the gripper is called."""


def _any(words: Iterable[str]) -> str:
    return "(?:" + "|".join(re.escape(one) for one in sorted(words, key=len, reverse=True)) + r")(?![\w'-])"


def _compiled(said: str) -> re.Pattern[str]:
    """A rewriting of the table, whose words in capitals stand for others."""
    for name, pattern in _MEANT.items():
        said = said.replace(name, pattern)
    return re.compile(said)


_MEANT = {
    "GOES": _any(_WORDS["goes"]),
    "WAY": rf"(?: {_any([*_WORDS['place'], *_WORDS['way']])})*",
    "PLACE": _any(_WORDS["place"]),
    "THING": r"(?:<[^>]*>|it|them|there|its \w+)(?![\w'-])",
    "HAND": f"<{GRIPPER}>",
}
_REWRITINGS = [
    (_compiled(said), plain.replace("HAND", f"<{GRIPPER}>"))
    for group in _WORDS["rewritings"].values()
    for said, plain in group
]
_SYNONYMS = {word: verb for verb, words in _WORDS["synonyms"].items() for word in words}
_LONGEST = 500  # characters; nobody says a step in more, and rewritings take their square in time


def plain(text: str) -> str:
    """A text whose things are in <>, in words that the rules know: "carefully hover over <mug>" is "move <robot's
    gripper> over <mug>"."""
    if len(text) > _LONGEST:
        return text
    for said, instead in _REWRITINGS:
        text = said.sub(instead, text)
    verb, _, rest = text.partition(" ")
    return f"{_SYNONYMS.get(verb, verb)} {rest}".strip()
