"""From anyone's words to ours: the nearest query, the nearest scripted skill, and both for the steps of an answer."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

from rapidfuzz import fuzz, process

from lw_torchrl._util.checks import check_choice, shown, typed
from lw_torchrl.language.embeddings import sentence_vectors
from lw_torchrl.language.objects import WORDS
from lw_torchrl.language.queries import Clause, Query, QueryError, base_clauses, check_length, read_query
from lw_torchrl.language.relations import PREDICATES
from lw_torchrl.language.skills import ScriptedSkill, SkillError, Skills, load_skills, skills_for
from lw_torchrl.language.tasks import Task, get_task

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

_NEGATIONS = frozenset(("not", "no", "never", "without", "cannot"))
# Words that do not tell which query is meant.
_EMPTY = frozenset(("the", "a", "an", "is", "are", "be", "does", "do", "did", "has", "have", "robot's", "robot"))
_LONGEST = 400  # characters of a text that is compared
_MOST_CLAUSES = 8  # of a condition outside the language
_MOST_COMPARED = 64  # conditions and goals of an answer outside the language, a limit to its time
LIMIT, SKILL_LIMIT = 0.4, 0.7  # distances beyond which no condition and no skill is near; see docs/planners.md
_TARGETS = ("target location", "reach target")
_TARGET = re.compile(
    r"\b(?:the\s)?(?:reach\s)?(?:goal|target)(?:\s(?:location|position|area|place|point|destination))?\b"
)


class QueryPart(NamedTuple):
    """One clause of a text, the query it was taken for, and how alike they are, in [0, 1]."""

    text: str
    query: Query
    score: float


@dataclass(frozen=True)
class QueryMatch:
    """The nearest query to a text."""

    query: Query
    score: float  # the mean of its parts' scores, in [0, 1]; 1 for a text that is a query itself
    parts: tuple[QueryPart, ...]  # what each clause of the text was taken for


@typed
def nearest_query(text: str, task: str | Task, by: Literal["edit", "embedding"] = "edit") -> QueryMatch:
    """The query of a task that is nearest to a text.

    A text that is a query is found as it is. Otherwise it is split at "and" and "but", and each part is taken for the
    nearest base query. A part without a subject takes that of the part before. A part with "not", "doesn't" or "never"
    is taken for the negation of the base query nearest to the rest of it, so that truth is never inverted.

    Args:
        text: any words, of at most 64 parts.
        by: "edit", closest in spelling; "embedding", closest in meaning (an ImportError without the extra ``[text]``).

    Example:
        >>> str(nearest_query("gripper open and over the target locaton", "push").query)
        "the robot's gripper is open and the robot's gripper is above the target location"

    Source: paper section 'Query Answering Function': the nearest by sentence embedding or by edit distance.
    """
    owner = get_task(task)
    if (query := read_query(text, owner)) is not None:
        return QueryMatch(query, 1.0, tuple(QueryPart(str(clause), Query((clause,)), 1.0) for clause in query.clauses))
    split = [" ".join(part.split()) for part in re.split(r"\b(?:and|but)\b", text, flags=re.IGNORECASE)]
    split = [part for part in split if _content(_affirmed(part)[0])] or [" ".join(text.split())]
    check_length(text, split)
    known: dict[tuple[str, str], QueryPart] = {}  # a text may repeat itself
    parts: list[QueryPart] = []
    subject = ""
    for part in split:
        if (part, subject) not in known:
            found = _nearest_part(part, owner, by)
            if subject and found.score < 1.0:
                joined = _nearest_part(f"the {subject} {part}", owner, by)
                found = joined._replace(text=part) if joined.score > found.score else found
            known[part, subject] = found
        parts.append(known[part, subject])
        subject = parts[-1].query.clauses[0].subject
    query = Query(tuple(clause for part in parts for clause in part.query.clauses))
    return QueryMatch(query, sum(part.score for part in parts) / len(parts), tuple(parts))


def _nearest_part(part: str, task: Task, by: str) -> QueryPart:
    if (query := read_query(part, task)) is not None:
        return QueryPart(part, query, 1.0)
    words, negated = _affirmed(part)
    clauses, contents = _choices(task, tuple(PREDICATES))
    if by == "edit":
        _, similarity, at = process.extractOne(_content(words), contents, scorer=fuzz.ratio)
        score = similarity / 100
    else:  # an encoder cannot read a lone surrogate
        vector = sentence_vectors([" ".join(words).encode("utf-8", "replace").decode()])[0]
        alike = _vectors(tuple(map(str, clauses))) @ vector
        at, score = int(alike.argmax()), float(alike.max().clip(0.0, 1.0))
    return QueryPart(part, Query((replace(clauses[at], negated=negated),)), score)


def _affirmed(text: str) -> tuple[list[str], bool]:
    """The words of a text but its negations, and whether it is a negation."""
    plain = re.sub(r"(\w)n't\b", r"\1 not", text.replace("’", "'").casefold())
    words = re.sub(r"[^\w\s'-]", " ", plain).split()
    kept = [word for word in words if word not in _NEGATIONS]
    return kept, (len(words) - len(kept)) % 2 == 1


def _content(words: list[str]) -> str:
    return " ".join(word for word in words if word not in _EMPTY)


@lru_cache(maxsize=256)
def _choices(task: Task, relations: tuple[str, ...]) -> tuple[tuple[Clause, ...], tuple[str, ...]]:
    affirmed = tuple(clause for clause in base_clauses(task, relations) if not clause.negated)
    return affirmed, tuple(_content(str(clause).split()) for clause in affirmed)


@lru_cache(maxsize=256)
def _vectors(texts: tuple[str, ...]) -> NDArray[np.float32]:
    return sentence_vectors(texts)


@typed
def nearest_skill(
    text: str, task: str | Task | None = None, skills: Skills | Iterable[str] | None = None
) -> tuple[ScriptedSkill, float]:
    """Return the scripted skill with the closest text, by edit distance, and how close it is, in [0, 1].

    Args:
        task: consider only skills whose objects this task has; with none it is a :class:`SkillError`.
        skills: to choose from; None for the shipped ones.

    Example:
        >>> nearest_skill("put gripper above puck", task="push")[0].text
        'place the gripper above the puck'

    Source: paper section 'Conditional Plan Generation', which takes the nearest description.
    """
    shipped = load_skills()
    table = shipped if skills is None else skills
    if not isinstance(table, Mapping):
        table = {check_choice("skills", name, shipped): shipped[name] for name in table}
    for name, skill in table.items():
        if not isinstance(skill, ScriptedSkill):
            raise TypeError(f"skills[{name!r}] must be a ScriptedSkill, got {shown(skill)} ({type(skill).__name__})")
    allowed = tuple(name for name, skill in table.items() if task is None or skill.suits(task))
    if not allowed:
        raise SkillError(f"no scripted skill suits task {task!r}")
    words = " ".join(text.lower().replace("_", " ").split())
    found = process.extractOne(words, allowed, scorer=fuzz.ratio)
    return table[found[0]], found[1] / 100


class MappedQuery(NamedTuple):
    """The query that a text was taken for."""

    query: Query | None
    distance: float  # of its furthest clause
    exact: bool = False  # whether the text is a query itself


class StepMapper:
    """Maps the words of an answer, by data/words.toml, to queries and skills; a distance is 1 minus a similarity.

    Source: paper section 'LLM Experiments', which takes the nearest by string edit distance.
    """

    def __init__(self, task: Task, skills: Skills | None) -> None:
        self.task, self.skills = task, skills_for(task, skills)
        self.compared = 0

    def query(self, text: str) -> MappedQuery:
        """Map a text to the nearest query; to none if that is beyond the limit."""
        if (query := read_query(text, self.task)) is not None:
            return MappedQuery(query, 0.0, exact=True)
        self.compared += 1
        if self.compared > _MOST_COMPARED or len(text) > _LONGEST:
            return MappedQuery(None, 1.0)
        query, distance = _nearest_condition(text, self.task)
        return MappedQuery(query if distance <= LIMIT else None, distance)

    def skill(self, text: str) -> tuple[str | None, float]:
        """The text of the nearest scripted skill and its distance; no text if that is beyond the limit."""
        if text in self.skills:
            return text, 0.0
        if not self.skills or len(text) > _LONGEST:
            return None, 1.0
        words = _with_target(text, self.task)
        if found := _phrases("skills").match(words):
            words = WORDS["skills"][found[0]] + words[found.end() :]
        skill, score = nearest_skill(words, None, self.skills)
        return (skill.text if 1.0 - score <= SKILL_LIMIT else None), 1.0 - score


@lru_cache(maxsize=4096)
def _nearest_condition(text: str, task: Task) -> tuple[Query | None, float]:
    words = _phrases("conditions").sub(lambda found: WORDS["conditions"][found[0]], _with_target(text, task))
    with suppress(QueryError):
        match = nearest_query(words, task)
        if len(match.parts) <= _MOST_CLAUSES:
            return match.query, 1.0 - min(part.score for part in match.parts)
    return None, 1.0


def _with_target(text: str, task: Task) -> str:
    """The text in lower case, with the task's own name for its goal, which models call "goal" or "target position"."""
    name = next((name for name in _TARGETS if name in task.object_names), None)

    def named(goal: re.Match[str]) -> str:
        return goal[0] if name is None or goal[0] in task.object_names else f"the {name}"

    return _TARGET.sub(named, text.casefold())


@cache
def _phrases(kind: str) -> re.Pattern[str]:
    """Any phrase of the table, the longest first."""
    longest = sorted(WORDS[kind], key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, longest))})\b")
