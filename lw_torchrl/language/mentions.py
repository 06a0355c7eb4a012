"""Find the objects that the nouns of a condition refer to."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import NamedTuple

from lw_torchrl.language.objects import GRIPPER, WORDS
from lw_torchrl.language.polarity import MOTIONS
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.roles import respell
from lw_torchrl.language.tasks import TASKS, Task, is_goal, whole_objects

_NOUNS = WORDS["nouns"]
_SYNONYMS = {name: frozenset(words) for name, words in _NOUNS["synonyms"].items()}
_PARTS, _OTHER, _EMPTY, _VERBS = (frozenset(_NOUNS[name]) for name in ("parts", "other", "empty", "verbs"))
_ARTICLES = frozenset(("the", "a", "an"))
_HANDS = frozenset(" ".join((GRIPPER, *WORDS["canonical"]["hands"], *_NOUNS["hands"])).replace("'s", "").split())
_PLACES = frozenset(" ".join((*PREDICATES, *WORDS["canonical"]["place"], *_NOUNS["places"])).split()) - {"the", "table"}
_GOALS = ("target", "location", "goal", "destination")
_TOUCHES = re.compile(rf"\b(?:{'|'.join(WORDS['contact'])})\b.*?\btable\b")
_LENGTH = re.compile(r"\d[\d.]* ?(?:mm|cm|m|(?:milli|centi)?met(?:re|er)s?|inch(?:es)?|feet|foot|ft)\b", re.IGNORECASE)
_MOST_WORDS = 40  # maximum number of words of a part of a condition


class Mentions(NamedTuple):
    """The objects that the nouns of a part of a condition can refer to."""

    subjects: frozenset[str] | None  # None if the subject is not written
    objects: frozenset[str | None]  # {None} without an object
    unknown: str = ""  # a noun that refers to none of the task's objects; "" if there is none


@lru_cache(maxsize=4096)
def mentions(text: str, task: Task) -> Mentions:
    """Find the objects that a part of a condition mentions.

    Example:
        >>> mentions("the griper is near the hockey puck", TASKS["push"]).objects
        frozenset({'puck'})
        >>> mentions("the camera is near the puck", TASKS["push"]).unknown
        'camera'
    """
    text = _TOUCHES.sub("touching", text.replace(" -", " ").strip("-"))
    if length := _LENGTH.search(text):  # "30 cm above the dial"; a query has its own thresholds
        return Mentions(None, frozenset((None,)), length[0])
    if len(text.split()) > _MOST_WORDS:
        return Mentions(None, frozenset((None,)), text)
    as_written = _mentions(text, task)
    return _mentions(respell(text, task), task) if as_written.unknown else as_written


def _mentions(text: str, task: Task) -> Mentions:
    subject, others = _noun_phrases(text.split(), task)
    subjects, objects = _referents(subject, task), [_referents(phrase, task) for phrase in others]
    pairs = zip(others, objects, strict=True)
    unknown = [subject] if subject and not subjects else []
    unknown += [phrase for phrase, found in pairs if not found and not _PARTS.issuperset(phrase)]
    if others and not any(objects):
        unknown += others  # "near the edge", without the object
    joined = frozenset[str | None]().union(*objects) or frozenset((None,))
    return Mentions(subjects if subject else None, joined, " ".join(unknown[0]) if unknown else "")


def _noun_phrases(words: list[str], task: Task) -> tuple[list[str], list[list[str]]]:
    """Return the noun phrase of the subject, without its article, and the other noun phrases."""
    subject, others = list[str](), list[list[str]]()
    phrase, has_article, after = list[str](), False, ""
    for word in (*(word for word in words if not _is_empty(word, task)), "is"):
        kind = _kind(word, task)
        if kind == "article":
            has_article = True
        elif kind == "noun" or (kind == "form" and has_article and not phrase):  # "the colored puck"
            phrase.append(word)
        else:
            if phrase and not subject and not others and (not after or (after == "verb" and has_article)):
                subject = phrase
            elif phrase and (has_article or after == "place"):
                others.append(phrase)
            phrase, has_article, after = [], False, "place" if "place" in (kind, after) else "verb"
    return subject, others


def _is_empty(word: str, task: Task) -> bool:
    is_adverb = word.endswith("ly") and word not in _PLACES and word not in _names(task)
    return word in _EMPTY or word.isdigit() or is_adverb


def _kind(word: str, task: Task) -> str:
    if word in _ARTICLES:
        return "article"
    if word in _names(task) or word in _HANDS:
        return "noun"
    if word in _PLACES:
        return "place"
    is_form = re.fullmatch(r"\w{2,}(?:ing|ed)", word) or (word[-1:] == "s" and word[:-1] in MOTIONS)
    return "verb" if word in _VERBS else "form" if is_form else "noun"


@lru_cache(maxsize=256)
def _names(task: Task) -> dict[str, frozenset[str]]:
    """Return the objects of a task that each word can refer to."""
    names: dict[str, set[str]] = {}
    for name in task.object_names[1:]:
        for word in (*_words(name), *(_GOALS if is_goal(task, name) else ())):
            names.setdefault(word, set()).add(name)
    solid = {name for name in whole_objects(task) if not is_goal(task, name)}
    for word in _NOUNS["any"] if len(solid) == 1 else ():
        names.setdefault(word, solid)
    return {word: frozenset(found) for word, found in names.items()}


@lru_cache(maxsize=1)
def _object_words() -> frozenset[str]:
    """Return the words in the names of the objects of the 50 tasks."""
    names = (name for task in TASKS.values() for name in task.object_names)
    return frozenset(word for name in names for word in _words(name)) - _PARTS - {*_GOALS} - _HANDS


def _words(name: str) -> list[str]:
    return name.replace("'s", "").split()


def _referents(phrase: list[str], task: Task) -> frozenset[str]:
    """Return the objects of a task that a noun phrase can refer to."""
    if any(word.endswith("'s") and not _named(word[:-2], task) and word[:-2] not in _HANDS for word in phrase):
        return frozenset()  # "the human's hand"
    words = [word.removesuffix("'s") for word in phrase]
    if words[-1:] and not _named(words[-1], task) and _HANDS.issuperset(words):
        return frozenset((GRIPPER,))
    for end in range(len(words), 0, -1):
        names = frozenset(name for name in _named(words[end - 1], task) if not _is_another(words[:end], name, task))
        if names or words[end - 1] not in _PARTS:
            return names
    return frozenset()


def _named(word: str, task: Task) -> frozenset[str]:
    """Return the objects of a task that a noun can refer to, as a word of an object's name or as a synonym."""
    names = _names(task)
    for form in (word, word.removesuffix("s")):
        if form in names:
            return names[form]
    return frozenset[str]().union(*(names.get(name, ()) for name, words in _SYNONYMS.items() if word in words))


def _is_another(words: list[str], name: str, task: Task) -> bool:
    """Return whether the words before a noun name an object other than ``name``: "the drawer handle" of a window."""
    own = _words(name)
    return any(
        word not in own
        and (word in _OTHER or (word in _object_words() and name not in _named(word, task) and not {*own} <= {*words}))
        for word in words[:-1]
    )
