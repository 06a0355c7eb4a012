"""nearest_query: any text to the nearest query of a task, conjunction by conjunction."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Literal, NamedTuple

from rapidfuzz import fuzz, process
from torch import Tensor

from lw_torchrl._checks import check_choice
from lw_torchrl.language.queries import Query, QueryError, parse_query, supported_queries
from lw_torchrl.language.tasks import Task, get_task

_ALSO = tuple(f"the robot's gripper is not {state}" for state in ("open", "closed"))


class QueryPart(NamedTuple):
    """One clause of a text, the base query it was taken for, and how alike they are, in [0, 1]."""

    text: str
    query: str
    score: float


class QueryMatch(NamedTuple):
    """The nearest query to a text.

    Attributes:
        query: the query.
        score: the mean of its parts' scores; 1 for a text that is a query itself.
        parts: what each clause of the text was taken for.
    """

    query: Query
    score: float
    parts: tuple[QueryPart, ...]


def _plain(text: str) -> str:
    """Without what the query language may leave out: articles, the gripper's owner, "is", the question mark."""
    words = re.sub(r"isn't", "is not", re.sub(r"[?.!,]", " ", text.replace("’", "'").casefold())).split()
    return " ".join(word for word in words if word not in ("the", "a", "an", "is", "are", "robot's", "robot"))


@lru_cache(maxsize=256)
def _choices(task: Task, published_only: bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    listed = (*supported_queries(task, published_only), *_ALSO)
    return listed, tuple(_plain(query) for query in listed)


@lru_cache(maxsize=64)
def _vectors(task: Task, published_only: bool) -> Tensor:
    from lw_torchrl.language.text import sentence_encoder

    return sentence_encoder(_choices(task, published_only)[0])


def _nearest(part: str, task: Task, by: str, published_only: bool) -> QueryPart:
    listed, plain = _choices(task, published_only)
    try:
        own = str(parse_query(part, task))
        if not published_only or parse_query(own, task.published):
            return QueryPart(part, own, 1.0)
    except QueryError:
        pass
    if by == "edit":
        _, score, at = process.extractOne(_plain(part), plain, scorer=fuzz.ratio)
        return QueryPart(part, listed[at], score / 100)
    from lw_torchrl.language.text import sentence_encoder

    alike = _vectors(task, published_only) @ sentence_encoder([part])[0]
    return QueryPart(part, listed[int(alike.argmax())], float(alike.max().clamp(0.0, 1.0)))


def nearest_query(
    text: str,
    task: str | Task,
    by: Literal["edit", "embedding"] = "edit",
    *,
    published_only: bool = False,
) -> QueryMatch:
    """The query of a task that is nearest to a text.

    A text that is a query is found as it is. Otherwise each of its parts between "and" is taken for the nearest
    base query; one that leaves its subject out takes that of the part before.

    Args:
        text: any words.
        task: the task whose objects the query may name.
        by: "edit", closest in spelling; "embedding", closest in meaning, by the sentence encoder.
        published_only: leave out the points that we named.

    Raises:
        TypeError: ``text`` is no string.
        ValueError: an unknown task, or another value for ``by``.
        ImportError: by="embedding" without the extra ``[text]``.

    Example:
        >>> match = nearest_query("the gripper touches the puck", "push")
        >>> str(match.query), match.score > 0.5
        ("the robot's gripper is near the puck", True)

    Source: paper section 'Conditional Plan Generation', which maps conditions to the nearest query.
    """
    if not isinstance(text, str):
        raise TypeError(f"text must be a string, got {text!r} ({type(text).__name__})")
    check_choice("by", by, ("edit", "embedding"))
    owner = get_task(task)
    try:
        query = parse_query(text, owner.published if published_only else owner)
        return QueryMatch(query, 1.0, tuple(QueryPart(str(clause), str(clause), 1.0) for clause in query.clauses))
    except QueryError:
        pass
    parts: list[QueryPart] = []
    for said in re.split(r"\band\b", text, flags=re.IGNORECASE):
        part = " ".join(said.split())
        alone = _nearest(part, owner, by, published_only)
        if parts and alone.score < 1.0:
            subject = parse_query(parts[-1].query, owner).clauses[0].subject
            joined = _nearest(f"the {subject} {part}", owner, by, published_only)
            alone = joined if joined.score > alone.score else alone
        parts.append(alone)
    query = parse_query(" and ".join(part.query for part in parts), owner)
    return QueryMatch(query, sum(part.score for part in parts) / len(parts), tuple(parts))
