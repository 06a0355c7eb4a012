"""Search for the query or the scripted skill that is nearest to a free-form text."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

from rapidfuzz import fuzz, process

from lw_torchrl._util.checks import check_choice, typed
from lw_torchrl.language.connectives import parse_words
from lw_torchrl.language.expressions import Expression
from lw_torchrl.language.objects import GRIPPER, WORDS
from lw_torchrl.language.queries import (
    Clause,
    Query,
    QueryError,
    base_clauses,
    read_query,
    split_words,
)
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.skills import ScriptedSkill, SkillError, Skills, load_skills, skills_for
from lw_torchrl.language.tasks import Task, get_task
from lw_torchrl.language.text import sentence_vectors

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_NEGATIONS = frozenset(("not", "no", "never", "without", "cannot"))
# Words that do not affect the choice of a query.
_EMPTY = frozenset(("the", "a", "an", "is", "are", "be", "does", "do", "did", "has", "have", "robot's", "robot"))
_JOINS = frozenset(("or", "nor", "unless", "either", "neither", "both", "("))
_LONGEST = 400  # maximum length (characters) of a text to map
_MOST_CLAUSES = 8  # maximum number of clauses of a condition to map
_MOST_COMPARED = 64  # maximum number of texts to map per answer, which bounds the decoding time
LIMIT, SKILL_LIMIT = 0.4, 0.7  # maximum distance of a condition and of a skill; see docs/language-models.md
_TARGETS = ("target location", "reach target")
_TARGET = re.compile(
    r"\b(?:the\s)?(?:reach\s)?(?:goal|target)(?:\s(?:location|position|area|place|point|destination))?\b"
)


class QueryPart(NamedTuple):
    """A clause of a text, the nearest query, and the similarity of the two in [0, 1]."""

    text: str
    query: Query
    score: float


@dataclass(frozen=True)
class QueryMatch:
    """The query that is nearest to a text."""

    query: Query
    score: float  # mean score of the parts, in [0, 1]; 1 if the text is a query
    parts: tuple[QueryPart, ...]  # the match of each clause of the text

    @property
    def least_score(self) -> float:
        """The smallest score of a part."""
        return min(part.score for part in self.parts)


@typed
def nearest_query(text: str, task: str | Task, by: Literal["edit", "embedding"] = "edit") -> QueryMatch:
    """Find the query of a task that is nearest to a text.

    A query matches itself. Any other text is split at "and", "or" and the other words that :func:`parse_query` reads,
    and at "but", and each part matches the nearest base query. A part without a subject inherits the subject of the
    previous part. A part with "not", "doesn't" or "never" matches the negation of the base query nearest to the
    remaining words, so that a match never inverts the meaning.

    Args:
        text: any text with at most 256 parts.
        by: "edit" compares spelling; "embedding" compares meaning and needs the extra ``[text]``.

    Raises:
        QueryError: the text has more than 256 parts or parentheses.
        ImportError: the extra ``[text]`` is not installed.

    Example:
        >>> str(nearest_query("gripper open and over the target locaton", "push").query)
        "the robot's gripper is open and the robot's gripper is above the target location"

    Source: paper section 'Query Answering Function' (nearest query by sentence embedding or edit distance).
    """
    owner = get_task(task)
    if (query := read_query(text, owner)) is not None:
        parts = [QueryPart(str(clause), Query((clause,)), 1.0) for clause in query.clauses]
        return QueryMatch(query, 1.0, tuple(parts or [QueryPart(text, query, 1.0)]))
    pieces = [" ".join(piece.split()) for piece in re.split(r"\b(?:and|but)\b", text, flags=re.IGNORECASE)]
    pieces = [piece for piece in pieces if _content(_affirmed(piece)[0])]
    if not pieces:
        part = _nearest_part(" ".join(text.split()), owner, by)
        return QueryMatch(part.query, part.score, (part,))
    words = split_words(" and ".join(pieces))
    # Spaces hide other words such as "or" from the parser.
    conjunction = _nearest_match([word for piece in pieces for word in ("and", f" {piece}")][1:], owner, by)
    assert conjunction is not None  # each piece is an operand
    if not _JOINS.intersection(map(str.casefold, words)):
        return conjunction
    try:
        match = _nearest_match(words, owner, by)
    except QueryError:  # a stray parenthesis
        match = _nearest_match([word for word in words if word not in "()"], owner, by)
    # "at or near the puck" does not consist of two conditions.
    return conjunction if match is None or match.least_score < conjunction.least_score else match


def _nearest_match(words: list[str], task: Task, by: str) -> QueryMatch | None:
    """Match each operand among words that :func:`parse_words` accepts; return None without any operand."""
    known: dict[tuple[str, str], QueryPart] = {}  # a cache, since parts often repeat
    parts: list[QueryPart] = []
    subject = ""

    def nearest(operand: list[str]) -> Expression | None:
        nonlocal subject
        part = " ".join(operand).strip()
        if not _content(_affirmed(part)[0]):
            return None
        if (part, subject) not in known:
            match = _nearest_part(part, task, by)
            if subject and match.score < 1.0:
                joined = _nearest_part(f"the {subject} {part}", task, by)
                match = joined._replace(text=part) if joined.score > match.score else match
            known[part, subject] = match
        parts.append(known[part, subject])
        subject = next((clause.subject for clause in parts[-1].query.clauses), subject)
        return parts[-1].query.expression

    expression = parse_words(words, nearest, lambda *_: QueryError("stray parenthesis"))
    if expression is None:
        return None
    query = Query(expression)
    if all(part.query.is_conjunction for part in parts) and not _JOINS.intersection(map(str.casefold, words)):
        query = Query(tuple(clause for part in parts for clause in part.query.clauses))  # spelled as it was given
    return QueryMatch(query, sum(part.score for part in parts) / len(parts), tuple(parts))


def _nearest_part(part: str, task: Task, by: str) -> QueryPart:
    """Match one part of a text to the nearest base query or negated base query."""
    if (query := read_query(part, task)) is not None:
        return QueryPart(part, query, 1.0)
    words, negated = _affirmed(part)
    clauses, contents = _choices(task, tuple(PREDICATES))
    if by == "edit":
        _, similarity, at = process.extractOne(_content(words), contents, scorer=fuzz.ratio)
        score = similarity / 100
    else:
        text = " ".join(words).encode("utf-8", "replace").decode()  # an encoder cannot read a lone surrogate
        similarities = _vectors(tuple(map(str, clauses))) @ sentence_vectors([text])[0]
        at, score = int(similarities.argmax()), float(similarities.max().clip(0.0, 1.0))
    return QueryPart(part, Query((replace(clauses[at], negated=negated),)), score)


def _affirmed(text: str) -> tuple[list[str], bool]:
    """Return the words of a text without negations, and whether the number of negations is odd."""
    plain = re.sub(r"(\w)n't\b", r"\1 not", text.replace("’", "'").casefold())
    words = re.sub(r"[^\w\s'-]", " ", plain).split()
    kept = [word for word in words if word not in _NEGATIONS]
    return kept, (len(words) - len(kept)) % 2 == 1


def _content(words: list[str]) -> str:
    """Join the words that affect the choice of a query."""
    return " ".join(word for word in words if word not in _EMPTY)


@lru_cache(maxsize=256)
def _choices(task: Task, predicates: tuple[str, ...]) -> tuple[tuple[Clause, ...], tuple[str, ...]]:
    """Return the affirmative base clauses of a task, and the content words of each clause."""
    clauses = tuple(clause for clause in base_clauses(task, predicates) if not clause.negated)
    return clauses, tuple(_content(str(clause).split()) for clause in clauses)


@lru_cache(maxsize=256)
def _vectors(texts: tuple[str, ...]) -> NDArray[np.float32]:
    return sentence_vectors(texts)


@typed
def nearest_skill(
    text: str, task: str | Task | None = None, skills: Skills | Iterable[str] | None = None
) -> tuple[ScriptedSkill, float]:
    """Return the scripted skill whose text is nearest by edit distance, and the similarity in [0, 1].

    Args:
        task: consider only skills whose objects this task has; None for all skills.
        skills: the skills to choose from; None for the shipped skills.

    Raises:
        SkillError: every skill needs an object that the task lacks.

    Example:
        >>> nearest_skill("put gripper above puck", task="push")[0].text
        'place the gripper above the puck'

    Source: paper section 'Conditional Plan Generation', which uses the nearest description.
    """
    shipped = load_skills()
    table = shipped if skills is None else skills
    if not isinstance(table, Mapping):
        table = {check_choice("skills", name, shipped): shipped[name] for name in table}
    allowed = tuple(name for name, skill in table.items() if task is None or skill.suits(task))
    if not allowed:
        raise SkillError(f"every scripted skill needs an object that task {task!r} lacks; pass other skills=")
    words = " ".join(text.lower().replace("_", " ").split())
    name, similarity, _ = process.extractOne(words, allowed, scorer=fuzz.ratio)
    return table[name], similarity / 100


class MappedQuery(NamedTuple):
    """The query that a text was mapped to, with the distance between text and query."""

    query: Query | None  # None if no query is within the limit
    distance: float  # largest distance of a clause, in [0, 1]
    exact: bool = False  # whether the text is a query itself


class StepMapper:
    """A mapper from text generated by a language model to the nearest queries and scripted skills. The distance between
    two texts is 1 minus their similarity.

    The phrases in data/words.toml are replaced before the search.

    Source: paper section 'LLM Experiments', which uses the nearest text by edit distance.
    """

    def __init__(self, task: Task, skills: Skills | None) -> None:
        self.task, self.skills = task, skills_for(task, skills)
        self.compared = 0
        self.mapped: dict[str, MappedQuery] = {}

    def query(self, text: str) -> MappedQuery:
        """Map a text to the nearest query within the limit."""
        if text not in self.mapped:
            self.mapped[text] = self._query(text)
        return self.mapped[text]

    def _query(self, text: str) -> MappedQuery:
        if (query := read_query(text, self.task)) is not None:
            return MappedQuery(query, 0.0, exact=True)
        self.compared += 1
        if self.compared > _MOST_COMPARED or len(text) > _LONGEST:
            return MappedQuery(None, 1.0)
        query, distance = _nearest_condition(text, self.task)
        return MappedQuery(query if distance <= LIMIT else None, distance)

    def skill(self, text: str) -> tuple[str | None, float]:
        """Return the nearest scripted skill's text (None if beyond the limit) and distance."""
        if text in self.skills:
            return text, 0.0
        if not self.skills or len(text) > _LONGEST:
            return None, 1.0
        words = _with_target(text, self.task)
        if match := _phrases("skills").match(words):
            words = WORDS["skills"][match[0]] + words[match.end() :]
        skill, score = nearest_skill(words, None, self.skills)
        return (skill.text if 1.0 - score <= SKILL_LIMIT else None), 1.0 - score


@lru_cache(maxsize=4096)
def _nearest_condition(text: str, task: Task) -> tuple[Query | None, float]:
    """Return the query nearest to a condition (None if the condition has too many clauses) and the distance."""
    words = _with_object(_with_target(text, task), task)
    words = _phrases("conditions").sub(lambda match: WORDS["conditions"][match[0]], words)
    with suppress(QueryError):
        match = nearest_query(words, task)
        if len(match.parts) <= _MOST_CLAUSES:
            return match.query, 1.0 - match.least_score
    return None, 1.0


def _with_target(text: str, task: Task) -> str:
    """Lower-case a text and replace "goal", "target position", etc. with the task's name for the goal."""
    name = next((name for name in _TARGETS if name in task.object_names), None)

    def named(goal: re.Match[str]) -> str:
        return goal[0] if name is None or goal[0] in task.object_names else f"the {name}"

    return _TARGET.sub(named, text.casefold())


def _with_object(text: str, task: Task) -> str:
    """Replace "it" with the last object before it: "above the mug and near it" gives "... and near the mug"."""
    longest = sorted((name for name in task.object_names if name != GRIPPER), key=len, reverse=True)
    names = re.compile("|".join(rf"\b{re.escape(name)}\b" for name in longest) or r"(?!)")

    def named(it: re.Match[str]) -> str:
        before = names.findall(text[: it.start()])
        return f"the {before[-1]}" if before else it[0]

    return re.sub(r"(?<=\w )it\b", named, text)


@cache
def _phrases(kind: str) -> re.Pattern[str]:
    """Compile a pattern that matches the phrases in a table of words.toml, the longest first."""
    longest = sorted(WORDS[kind], key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, longest))})\b")
