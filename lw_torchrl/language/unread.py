"""Notes on the parts of a text that are in no step of the decoded plan."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence

from lw_torchrl._util.checks import shown
from lw_torchrl.language.formats.base import Clause, Note, is_verb
from lw_torchrl.language.formats.clauses import PATTERNS, base_verb
from lw_torchrl.language.formats.clauses import clauses as cut
from lw_torchrl.language.formats.sentences import usual_words
from lw_torchrl.language.polarity import forbids

_CLAUSES = re.compile(
    r"[^.;:,!?]*:|[^\w' -]+|\s-+\s|\b(?:and|or|then|but|otherwise|else|if|when|whenever|while|until|unless|once|because"
    r"|so that [^.,;]*|\w+ (?:phase|stage)|keep \w+ing(?= (?:until|while))|in case|provided"
    r"|(?:for )?as (?:long|soon) as|instead|finally|should|must|could|may|might|will|would|do\b.*|step\b.*|keep doing"
    r"|(?:go|start)\b.* (?:step|again).*)\b",
    re.IGNORECASE,
)
_RULE = re.compile(r"\b(?:when|whenever|if|once|unless|as soon as|should the|every time|in case)\b", re.IGNORECASE)
_HEAD = r"(?!.*\b(?:condition|when|if|state|action|skill|do|then|step)s?\b *\|)"
_ROW = re.compile(rf"\s*\|{_HEAD}(?=.*\w).*\|\s*$|\s*<tr>.*<td>", re.IGNORECASE)
_SENTENCE = re.compile(r"(?<=[.!?;])\s+")
_WORD = re.compile(r"[^\W\d_]{2}")
_COMMON = {"the", "a", "an", "it", "there", "first", "only", "is", "are", "and", "to", "of", "then", "robot", "should"}
_MOST = 50  # maximum number of notes


def unread(text: str, clauses: Sequence[Clause], notes: Sequence[Note], is_prose: bool) -> list[Note]:
    """Return a note for each prohibition, rule, action and item of a list that is in neither a step nor another note.

    Args:
        clauses: the clauses of the steps.
        notes: the notes so far.
        is_prose: whether the text is prose; in other texts, only prohibitions and rules are noted.
    """
    said = [*(clause.skill for clause in clauses), *(note.text for note in notes)]
    is_noted, is_said = _within(said), _within([*said, *(clause.reason for clause in clauses)])
    noted = {note.line for note in notes}
    known = {clause.line for clause in clauses} | noted
    words_of_skills = [(clause.line, _words(clause.skill)) for clause in clauses if clause.skill]
    found = list[Note]()
    for number, line in enumerate(text.splitlines(), 1):
        line, before = line[:8_000], len(found)
        if not _WORD.search(line):
            continue
        found += (Note(number, reason) for reason in _prohibitions(line, is_noted))
        if is_prose and known:
            found += (Note(number, reason) for reason in _actions(line, is_said))
        if len(found) > before or not known:
            continue
        sentences = _SENTENCE.split(line)
        for sentence in sentences if len(sentences) > 1 or number not in noted else ():
            if not (_RULE.search(sentence) or _ROW.match(sentence)):
                continue
            near = [words for place, words in words_of_skills if abs(place - number) < 4 or not is_prose]
            if not _is_used(sentence, near, is_noted):
                found.append(Note(number, f"the rule is not read: {shown(sentence.strip())}"))
        item = PATTERNS["item"].match(line)
        if is_prose and len(found) == before and item and number not in known and _is_remark(item[3]):
            found.append(Note(number, f"the line is not read: {shown(line.strip())}"))
    return found[:_MOST]


def _prohibitions(line: str, is_said: Callable[[str], bool]) -> Iterator[str]:
    """Yield the text of a note for each clause of a line that forbids an action."""
    line = re.sub(r"^[\W\d]+|\*", "", line)
    for clause in cut(usual_words(line)) if forbids(line, is_whole=False) else ():
        words = {*re.findall(r"\w+", clause.text.lower())} - {"do", "does"}
        is_act = any(is_verb([word]) or base_verb(word) for word in words)
        if clause.kind in ("say", "act") and is_act and forbids(clause.text) and not is_said(clause.text):
            yield f"{shown(clause.text)} is left out: it forbids an action"


def _actions(line: str, is_said: Callable[[str], bool]) -> Iterator[str]:
    """Yield the text of a note for each action of a line that no step or note contains."""
    for phrase in (part.strip(" -'") for part in _CLAUSES.split(line)):
        if 1 < len(phrase.split()) <= 40 and is_verb(phrase.split()) and not is_said(phrase):
            yield f"no step has the action {shown(phrase)}"


def _is_remark(item: str) -> bool:
    """Return whether an item of a list is short, and is neither an action nor a condition."""
    is_short = 1 < len(item.split()) <= 40
    return is_short and not PATTERNS["restarts"].match(item) and {clause.kind for clause in cut(item)} == {"say"}


def _is_used(sentence: str, near: Sequence[set[str]], is_said: Callable[[str], bool]) -> bool:
    """Return whether a nearby step or a note already covers a sentence."""
    words = _words(sentence)
    parts = [part.strip(" -'") for part in _CLAUSES.split(sentence)]
    return any(2 * len(step & words) >= len(step) for step in near) or any(
        len(_words(part)) > 1 and is_said(part) for part in parts
    )


def _words(text: str) -> set[str]:
    return {*re.findall(r"[\w']+", text.lower())} - _COMMON


def _within(said: Sequence[str]) -> Callable[[str], bool]:
    """Return a function that checks whether one of the texts contains all words of a phrase."""
    words_said = [{*re.findall(r"[\w']+", each.lower())} for each in dict.fromkeys(said)]

    def is_said(phrase: str) -> bool:
        words = {*re.findall(r"[\w']+", phrase.lower())} - {"the", "a", "it", "there", "first", "only"}
        return any(words <= each for each in words_said)

    return is_said
