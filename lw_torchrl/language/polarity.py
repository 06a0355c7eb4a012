"""Detection of negations and opposites, so that a parsed text never means the opposite of the written text.

The words are in the table ``negation`` of data/words.toml.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from itertools import groupby
from typing import NamedTuple

from lw_torchrl.language.objects import WORDS

_WORDS = WORDS["negation"]
_REWRITINGS = [
    (re.compile(text.replace("<small>", _WORDS["small"]), re.IGNORECASE), plain) for text, plain in _WORDS["conditions"]
]
_NOT = frozenset(_WORDS["not"])
_APOSTROPHE = re.compile("[’‘ʼ´`ʹ′＇]")
_HUMP = re.compile("(?<=[a-z])(?=[A-Z][a-z])")  # where "isNotNear" lacks a space
_UNREAD = re.compile(rf"(?:{'|'.join(_WORDS['unread'])})", re.IGNORECASE)
_POLES: dict[str, tuple[int, int]] = {  # word -> (index of its pair of opposites, 0 or 1 for its side)
    word: (number, side) for number, pair in enumerate(_WORDS["opposites"]) for side in (0, 1) for word in pair[side]
}


def _any(name: str) -> str:
    return f"(?:{'|'.join(_WORDS[name])})"


_FORBIDS = re.compile(rf"(?<![\w'-]){_any('forbids')}(?![\w'-])", re.IGNORECASE)
_CLAUSE = re.compile(rf"(?:^|,?\s+|(?=[,;.:])){_any('clauses')}", re.IGNORECASE)
_CAUTION = re.compile(rf"(?:please )?{_any('cautions')}", re.IGNORECASE)
_RESTS = re.compile(rf"(?:please |then |now |just )*{_any('rests')}", re.IGNORECASE)
_ENDED = re.compile(rf"(?:please |then |now |just )*{_any('ended')}", re.IGNORECASE)
_EXCEPTION = re.compile(rf",?\s+{_any('exceptions')}\s+(.+)", re.IGNORECASE)
_AFFIRMS = re.compile(rf"(?:(?:{_any('affirms')}|{_any('manner')})\s+)*", re.IGNORECASE)
_CANONICAL = WORDS["canonical"]
MOTIONS: frozenset[str] = frozenset().union(
    *(words for name in ("verbs", "synonyms") for words in (*_CANONICAL[name].values(), _CANONICAL[name])),
    _CANONICAL["goes"],
    _CANONICAL["other"],
)
"""The verbs of motion, in the form of a command."""
_END_OF_CLAUSE = re.compile(rf"[,;:.]| {_any('clauses')}| (?:by|before|after)\b", re.IGNORECASE)
_NOUN = re.compile(r"(?:the|an?|any|your|every) \w+(?: (?:of|on|to|from)\b|$)")
_RELATIONS = frozenset(("touching", *_CANONICAL["place"])) - {"to", "of", "for", "with"}
_DIRECTIONS = "|".join(word for words in _CANONICAL["directions"].values() for word in words)
_NOT_YET = re.compile(rf"(?:not|no|never)(?: (?!(?:{_DIRECTIONS})\b)\w+)?", re.IGNORECASE)  # but "not left" is a place
_IS = re.compile(r"\b(?:is|are|was|were|would|will|can|should|must|may|might)\b|n't\b", re.IGNORECASE)
_SOURCE = re.compile(
    rf"\b{_any('sources')} (?:the )?+(?!<?{_any('no_sources')}\b)((?:(?! (?:and|then|to|into|onto|over)\b)[\w' <-])*)",
    re.IGNORECASE,
)


class Affirmed(NamedTuple):
    """A part of a condition without its negations."""

    words: list[str]
    negated: bool  # whether the number of negations is odd
    is_read: bool  # False if the part has a negation whose meaning is unknown


@lru_cache(maxsize=512)
def plain_negations(text: str) -> str:
    """Rewrite the negations of a condition with "not", "and not" and "unless".

    Example:
        >>> plain_negations("the gripper isn't far from the puck without touching it")
        'the gripper is not not near the puck and not touching it'
    """
    text = _APOSTROPHE.sub("'", text)
    text = _HUMP.sub(" ", text).replace("_", " ")
    for pattern, plain in _REWRITINGS:
        text = pattern.sub(plain, text)
    return text


def affirmed(text: str) -> Affirmed:
    """Remove the negations from a part of a condition.

    Example:
        >>> affirmed("the gripper is not near the puck"), affirmed("the gripper misses the puck").is_read
        (Affirmed(words=['the', 'gripper', 'is', 'near', 'the', 'puck'], negated=True, is_read=True), False)
    """
    words = re.sub(r"[^\w\s'-]", " ", plain_negations(text.casefold())).split()
    kept = [word for word in words if word not in _NOT]
    unread = _UNREAD.findall(" ".join(kept))
    runs = [{*run} for is_not, run in groupby(words, _NOT.__contains__) if not is_not]
    # "not touching the table not near the table" does not negate twice.
    is_one = len(words) - len(kept) < 2 or sum(not _RELATIONS.isdisjoint(run) for run in runs) < 2
    return Affirmed(kept, (len(words) - len(kept) + len(unread)) % 2 == 1, is_one and not unread)


def poles(words: Iterable[str]) -> frozenset[tuple[int, int]]:
    """Return (pair of opposites, side) for each word that belongs to a pair, such as "above" and "below"."""
    return frozenset(_POLES[word] for word in words if word in _POLES)


def agree(written: Iterable[tuple[int, int]], read: Iterable[tuple[int, int]]) -> bool:
    """Return False if a parsed word is not written but its opposite is, and True otherwise."""
    return not any((pair, 1 - side) in written and (pair, side) not in written for pair, side in read)


class Instruction(NamedTuple):
    """The parts of a skill text."""

    text: str  # the action; "" if the text only says what not to do
    aside: str = ""  # a qualification that no step can express: "without touching it", "almost"
    exception: str = ""  # the condition that prevents the action: "the gripper is closed" after "unless"


def instruction(skill: str) -> Instruction:
    """Split a skill into the action, a qualification such as "without touching it", and the exception after "unless".

    Example:
        >>> instruction("place the gripper above the mug, but do not touch it")
        Instruction(text='place the gripper above the mug', aside='but do not touch it', exception='')
        >>> instruction("never touch the mug").text, instruction("open the gripper unless it is open").exception
        ('', 'it is open')
    """
    text, exception, aside = " ".join(_APOSTROPHE.sub("'", skill).replace("_", " ").split()), "", ""
    if match := _EXCEPTION.search(text):
        text, exception = text[: match.start()], match[1]
    if match := _FORBIDS.search(text):
        starts = [each.start() for each in _CLAUSE.finditer(text, 0, match.end()) if each.start() <= match.start()]
        text, aside = (text[: starts[-1]], text[starts[-1] :].strip(" ,;.:")) if starts else ("", text)
        is_inside = re.match(r"not \w+, ", aside)  # "push the peg past, not into, the hole"
        if not text.strip() or is_inside or _CAUTION.fullmatch(text.strip()):
            return Instruction("", aside, exception)
    is_ended = _ENDED.match(text) is not None or (not rests(text) and _is_only_mentioned(text))
    if _NOT_YET.fullmatch(aside) or is_ended:
        return Instruction("", aside or text, exception)
    return Instruction(text, aside, exception)


def forbids(text: str, is_whole: bool = True) -> bool:
    """Return whether a whole clause is a prohibition; with ``is_whole=False``, return whether a text contains one.

    Example:
        >>> forbids("the robot shouldn't close the gripper"), forbids("push the mug, but do not lift it")
        (True, False)
    """
    has_word = _FORBIDS.search(_APOSTROPHE.sub("'", text)) is not None
    return has_word and not (is_whole and instruction(text).text)


def command_form(word: str) -> str | None:
    """Return the base form of a verb of motion that ends in "-ing"; None for any other word.

    Example:
        >>> command_form("gripping"), command_form("moving"), command_form("ring")
        ('grip', 'move', None)
    """
    stem = word.removesuffix("ing")
    forms = (stem, f"{stem}e", stem[:-1] if stem[-2:-1] == stem[-1:] else stem)
    return next((form for form in forms if form in MOTIONS), None) if word != stem else None


def _is_only_mentioned(text: str) -> bool:
    """Return whether a text mentions an action without commanding it: "postpone closing the gripper".

    Known words such as "start by" may precede a commanded action; after any other words, it counts as only mentioned.
    """
    rest = _AFFIRMS.sub("", text.lower(), count=1)
    clause = rest[: match.start()] if (match := _END_OF_CLAUSE.search(rest, 1)) else rest
    head, *later = re.findall(r"[\w'-]+", clause) or [""]
    if command_form(head):
        return _IS.search(clause) is not None  # "moving the puck is forbidden"
    pairs = list(zip((head, *later), later, strict=False))
    if any(before in _WORDS["detach"] and (after == "being" or command_form(after)) for before, after in pairs):
        return True  # "keep the puck from moving"
    if head in MOTIONS:
        return bool(later) and command_form(later[0]) is not None
    if any(command_form(after) or (before == "to" and after in MOTIONS) for before, after in pairs):
        return True
    return _NOUN.match(" ".join(later)) is not None and any(word in MOTIONS for word in later[1:2])  # "skip the push"


def rests(text: str) -> bool:
    """Return whether an action ends a motion or keeps away from an object: "stop pushing", "stay clear of the mug"."""
    return _RESTS.match(text) is not None


def source_of(text: str) -> str | None:
    """Return the object from which an action moves the gripper away, or None.

    Example:
        >>> source_of("move the gripper away from the puck")
        'puck'
    """
    match = _SOURCE.search(text)
    return None if match is None else match[1]


def without_source(text: str) -> str:
    """Remove the object to move away from, and the preposition before it, from a text."""
    return _SOURCE.sub("", text)
