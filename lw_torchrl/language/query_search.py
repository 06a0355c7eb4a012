"""nearest_query: any text to the nearest query of a task, conjunction by conjunction."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

from rapidfuzz import fuzz, process

from lw_torchrl._checks import check_choice, checked
from lw_torchrl.language.queries import Clause, Query, base_clauses, check_length, parse_query, read_query
from lw_torchrl.language.relations import PUBLISHED, RELATIONS, UNARY
from lw_torchrl.language.tasks import Task, get_task

if TYPE_CHECKING:
    from torch import Tensor

_NEGATIONS = frozenset(("not", "no", "never", "without", "cannot"))
# What says nothing about which query is meant: articles, the gripper's owner, the verb of a question.
_EMPTY = frozenset(("the", "a", "an", "is", "are", "be", "does", "do", "did", "has", "have", "robot's", "robot"))


class QueryPart(NamedTuple):
    """One clause of a text, the query it was taken for, and how alike they are, in [0, 1]."""

    text: str
    query: str
    score: float


@dataclass(frozen=True)
class QueryMatch:
    """The nearest query to a text.

    Attributes:
        query: the query.
        score: the mean of its parts' scores, in [0, 1]; 1 for a text that is a query itself.
        parts: what each clause of the text was taken for.
    """

    query: Query
    score: float
    parts: tuple[QueryPart, ...]


def _affirmed(text: str) -> tuple[list[str], bool]:
    """The words of a text but its negations, and whether it is a negation."""
    plain = re.sub(r"(\w)n't\b", r"\1 not", text.replace("’", "'").casefold())
    words = re.sub(r"[^\w\s'-]", " ", plain).split()
    kept = [word for word in words if word not in _NEGATIONS]
    return kept, (len(words) - len(kept)) % 2 == 1


def _told(words: list[str]) -> str:
    return " ".join(word for word in words if word not in _EMPTY)


@lru_cache(maxsize=256)
def _choices(task: Task, relations: tuple[str, ...]) -> tuple[tuple[Clause, ...], tuple[str, ...]]:
    """The clauses that base queries affirm, and what each says; a negation is compared without its "not"."""
    affirmed = tuple(clause for clause in base_clauses(task, relations) if not clause.negated)
    return affirmed, tuple(_told(str(clause).split()) for clause in affirmed)


@lru_cache(maxsize=256)
def _vectors(task: Task, relations: tuple[str, ...]) -> Tensor:
    from lw_torchrl.language.text import sentence_encoder

    return sentence_encoder(tuple(map(str, _choices(task, relations)[0])))


def _parse(text: str, task: Task, relations: tuple[str, ...]) -> Query | None:
    """The query that a text is, if it is one that has no other relations."""
    query = read_query(text, task)
    return query if query and all(clause.predicate in (*relations, *UNARY) for clause in query.clauses) else None


def _nearest(part: str, task: Task, relations: tuple[str, ...], by: str) -> QueryPart:
    if (query := _parse(part, task, relations)) is not None:
        return QueryPart(part, str(query), 1.0)
    words, negated = _affirmed(part)
    clauses, told = _choices(task, relations)
    if by == "edit":
        _, similarity, at = process.extractOne(_told(words), told, scorer=fuzz.ratio)
        score = similarity / 100
    else:
        from lw_torchrl.language.text import sentence_encoder

        # A surrogate alone is no text that an encoder could read.
        alike = _vectors(task, relations) @ sentence_encoder([" ".join(words).encode("utf-8", "replace").decode()])[0]
        at, score = int(alike.argmax()), float(alike.max().clamp(0.0, 1.0))
    return QueryPart(part, str(replace(clauses[at], negated=negated)), score)


@checked
def nearest_query(
    text: str,
    task: str | Task,
    by: Literal["edit", "embedding"] = "edit",
    published_only: bool = False,
) -> QueryMatch:
    """The query of a task that is nearest to a text.

    A text that is a query is found as it is. Otherwise each of its parts between "and" or "but" is taken for the
    nearest base query; one that leaves its subject out takes that of the part before. A part with "not", "doesn't" or
    "never" is taken for the negation of the base query nearest to the rest of it, so truth is never turned round.

    Args:
        text: any words.
        task: a task or its name, whose objects the query may name.
        by: "edit", closest in spelling; "embedding", closest in meaning, by the sentence encoder.
        published_only: leave out the points that we named, and relations that were added.

    Raises:
        TypeError: ``text`` is no string.
        ValueError: an unknown task, another value for ``by``, or a text of more than 64 parts.
        ImportError: by="embedding" without the extra ``[text]``.

    Example:
        >>> match = nearest_query("the gripper isn't touching the puck", "push")
        >>> str(match.query), match.score > 0.5
        ("the robot's gripper is not around the puck", True)
        >>> str(nearest_query("gripper open and over the target locaton", "push").query)
        "the robot's gripper is open and the robot's gripper is above the target location"

    Source: paper section 'Query Answering Function', which maps other queries to the nearest supported one by a
    sentence embedding or by string edit distance.
    """
    if not isinstance(text, str):
        raise TypeError(f"text must be a string, got {text!r} ({type(text).__name__})")
    check_choice("by", by, ("edit", "embedding"))
    owner = get_task(task).published if published_only else get_task(task)
    relations = PUBLISHED if published_only else tuple(RELATIONS)
    if (query := _parse(text, owner, relations)) is not None:
        return QueryMatch(query, 1.0, tuple(QueryPart(str(clause), str(clause), 1.0) for clause in query.clauses))
    said = [" ".join(part.split()) for part in re.split(r"\b(?:and|but)\b", text, flags=re.IGNORECASE)]
    known: dict[tuple[str, str], QueryPart] = {}  # a text may say the same again and again
    parts: list[QueryPart] = []
    subject = ""
    told = [part for part in said if _told(_affirmed(part)[0])] or [" ".join(text.split())]
    check_length(text, told)
    for part in told:
        if (part, subject) not in known:
            found = _nearest(part, owner, relations, by)
            if subject and found.score < 1.0:
                joined = _nearest(f"the {subject} {part}", owner, relations, by)
                found = joined._replace(text=part) if joined.score > found.score else found
            known[part, subject] = found
        parts.append(known[part, subject])
        subject = parse_query(parts[-1].query, owner).clauses[0].subject
    query = Query(tuple(clause for part in parts for clause in parse_query(part.query, owner).clauses))
    return QueryMatch(query, sum(part.score for part in parts) / len(parts), tuple(parts))
