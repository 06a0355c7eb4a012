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
from lw_torchrl.language.mentions import mentions
from lw_torchrl.language.objects import GRIPPER, WORDS
from lw_torchrl.language.polarity import affirmed, agree, instruction, plain_negations, poles, rests, source_of
from lw_torchrl.language.queries import Clause, Query, QueryError, base_clauses, read_query, split_words
from lw_torchrl.language.relations import PREDICATES, RELATIONS, STATES, TOUCHING
from lw_torchrl.language.roles import has_certain_target
from lw_torchrl.language.skills import ScriptedSkill, SkillError, Skills, load_skills, skills_for
from lw_torchrl.language.tasks import Task, get_task
from lw_torchrl.language.text import sentence_vectors

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

# Words that do not affect the choice of a query.
_EMPTY = frozenset(("the", "a", "an", "is", "are", "be", "does", "do", "did", "has", "have", "robot's", "robot"))
_JOINS = frozenset(("or", "nor", "unless", "either", "neither", "both", "("))
_LONGEST = 400  # maximum length (characters) of a text to map
_MOST_CLAUSES = 8  # maximum number of clauses of a condition to map
_MOST_COMPARED = 64  # maximum number of texts to map per answer, which bounds the decoding time
_LEAST_RATIOS = (60, 80)  # minimum similarity (percent) of a written word to a state (60) or any other predicate (80)
LIMIT, SKILL_LIMIT = 0.4, 0.7  # maximum distance of a condition and of a skill; see docs/language-models.md
_PLACES = f"(?:{'|'.join(WORDS['canonical']['place'])})"
_HANDS = frozenset(WORDS["canonical"]["hands"]) - {"gripper"}
_A_HAND = re.compile(rf"\b(?:{'|'.join(sorted(map(re.escape, _HANDS), key=len, reverse=True))})\b")
_TARGETS = ("target location", "reach target")
_TARGET = re.compile(
    r"\b(?:the\s)?(?:reach\s)?(?:goal|target)(?:\s(?:location|position|area|place|point|destination))?\b"
)


class QueryPart(NamedTuple):
    """A clause of a text, the nearest query, and the similarity of the two in [0, 1]."""

    text: str
    query: Query
    score: float
    is_certain: bool = True  # whether the query has the relation and the objects that the text names


@dataclass(frozen=True)
class QueryMatch:
    """The query that is nearest to a text."""

    query: Query
    score: float  # mean score of the parts, in [0, 1]; 1 if the text is a query
    parts: tuple[QueryPart, ...]  # the match of each clause of the text

    @property
    def least_score(self) -> float:
        """The lowest score of any part."""
        return min(part.score for part in self.parts)


@typed
def nearest_query(text: str, task: str | Task, by: Literal["edit", "embedding"] = "edit") -> QueryMatch:
    """Find the query of a task that is nearest to a text.

    A query matches itself. Any other text is split at "and", "or", the other connectives of :func:`parse_query`, and
    "but". Each part matches the nearest base query, that is, the nearest of :func:`supported_queries` that is
    not negated. A part without a subject inherits the subject of the previous part.

    A part with a negation such as "doesn't", "never", "far from" or "without" matches the negation of the base query
    nearest to the remaining words. A part with another negation, such as "fails to", matches with score 0. No part
    matches a query that states the opposite ("above" and "below"), so a match never inverts the meaning.

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
    text = _with_target(plain_negations(text), owner)
    plain = re.split(r"\b(?:and|but)\b|[:;](?=.*\bnot\b)", text, flags=re.IGNORECASE)
    pieces = [" ".join(piece.split()) for piece in plain]
    pieces = [piece for piece in pieces if _content(affirmed(piece).words)]
    if not pieces:
        part = _nearest_part(" ".join(text.split()), owner, by)
        return QueryMatch(part.query, part.score, (part,))
    words = split_words(" and ".join(pieces))
    # A leading space hides connectives other than "and" from the parser, since a piece may begin with "or".
    conjunction = _nearest_match([word for piece in pieces for word in ("and", f" {piece}")][1:], owner, by)
    assert conjunction is not None  # each piece is an operand
    if not _JOINS.intersection(map(str.casefold, words)):
        return conjunction
    try:
        match = _nearest_match(words, owner, by)
    except QueryError:  # a stray parenthesis
        match = _nearest_match([word for word in words if word not in "()"], owner, by)
    # Splitting at "or" is wrong for a text like "at or near the puck"; the split then has a lower score.
    return conjunction if match is None or match.least_score < conjunction.least_score else match


def _nearest_match(words: list[str], task: Task, by: str) -> QueryMatch | None:
    """Match each operand to its nearest query, and combine the matches; return None if no operand has words."""
    known: dict[tuple[str, str], QueryPart] = {}  # a cache, since parts often repeat
    parts: list[QueryPart] = []
    subject = ""

    def nearest(operand: list[str]) -> Expression | None:
        nonlocal subject
        part = " ".join(operand).strip()
        if not _content(affirmed(part).words):
            return None
        if (part, subject) not in known:
            match = _nearest_part(part, task, by)
            if subject and match.score < 1.0:
                joined = _nearest_part(f"the {subject} {part}", task, by)
                match = joined._replace(text=part) if joined[2:] > match[2:] else match
            known[part, subject] = match
        parts.append(known[part, subject])
        subject = next((clause.subject for clause in parts[-1].query.clauses), subject)
        return parts[-1].query.expression

    expression = parse_words(words, nearest, lambda *_: QueryError("stray parenthesis"))
    if expression is None:
        return None
    query = Query(expression)
    if all(part.query.is_conjunction for part in parts) and not _JOINS.intersection(map(str.casefold, words)):
        query = Query(tuple(clause for part in parts for clause in part.query.clauses))  # keep the given spelling
    return QueryMatch(query, sum(part.score for part in parts) / len(parts), tuple(parts))


def _nearest_part(part: str, task: Task, by: str) -> QueryPart:
    """Match one part of a text to the nearest base query or negated base query."""
    if (query := read_query(part, task)) is not None:
        return QueryPart(part, query, 1.0)
    words, negated, is_read = affirmed(part)
    clauses, contents = _choices(task, tuple(PREDICATES))
    written = poles(words)
    nouns = mentions(" ".join(words[:_LONGEST]), task)
    if not any(name in _HANDS for name in task.object_names):
        words = _A_HAND.sub("gripper", " ".join(words)).split()
    stated = _stated(words) if by == "edit" else {*PREDICATES} - ({TOUCHING} - _stated(words))
    opposed = [
        (bool(written) and not agree(written, poles(clause.predicate.split())))
        or (clause.predicate in (*STATES, TOUCHING) and clause.predicate not in stated)
        for clause in clauses
    ]
    is_certain = by == "embedding" or not nouns.unknown
    if by == "edit":
        named = [
            out
            or clause.predicate not in stated
            or clause.object not in nouns.objects
            or (nouns.subjects is not None and clause.subject not in nouns.subjects)
            for clause, out in zip(clauses, opposed, strict=True)
        ]
        is_certain, opposed = (is_certain, named) if not all(named) else (False, opposed)
    if by == "edit":
        choices = [None if out else content for out, content in zip(opposed, contents, strict=True)]
        _, similarity, at = process.extractOne(_content(words), choices, scorer=fuzz.ratio)
        score = similarity / 100
    else:
        text = " ".join(words).encode("utf-8", "replace").decode()  # an encoder cannot read a lone surrogate
        similarities = _vectors(tuple(map(str, clauses))) @ sentence_vectors([text])[0]
        similarities[opposed] = -1.0
        at, score = int(similarities.argmax()), float(similarities.max().clip(0.0, 1.0))
    keys = {_key(predicate) for predicate in (*RELATIONS, *STATES)} - {*clauses[at].predicate.split()}
    is_certain = is_certain and (by == "embedding" or keys.isdisjoint({*words} - {*str(clauses[at]).split()}))
    return QueryPart(part, Query((replace(clauses[at], negated=negated),)), score if is_read else 0.0, is_certain)


def _stated(written: list[str]) -> set[str]:
    """Return the predicates that a text mentions, even misspelt; "o'clock" does not count as "closed"."""
    words = [word for word in dict.fromkeys(written[:_LONGEST]) if word not in _EMPTY]

    def is_stated(predicate: str) -> bool:
        if predicate in STATES or predicate == TOUCHING:
            texts = WORDS["contact"] if predicate == TOUCHING else [predicate.split()[-1]]
            least = _LEAST_RATIOS[predicate == TOUCHING]
            return any(process.extractOne(text, words, scorer=fuzz.ratio, score_cutoff=least) for text in texts)
        word = _key(predicate)
        close = [each for each in words if each[0] == word[0]]  # "tight" is not a misspelling of "right"
        return process.extractOne(word, close, scorer=fuzz.ratio, score_cutoff=_LEAST_RATIOS[1]) is not None

    return {name for name in PREDICATES if is_stated(name)}


def _key(predicate: str) -> str:
    """Return the word that a text must have in order to state a predicate: "left" for "left of"."""
    return next(word for word in reversed(predicate.split()) if word not in ("of", "with", "to"))


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
    kept = [name for name in allowed if not _is_opposite(words, name)]
    name, similarity, _ = process.extractOne(words, kept or allowed, scorer=fuzz.ratio)
    is_action = instruction(words).text and not rests(words)
    return table[name], similarity / 100 if kept and is_action else 0.0


def _is_opposite(text: str, skill: str) -> bool:
    """Return whether a skill does the opposite of a text, such as moving to an object that the text moves away from."""
    words = text.split()
    if not agree(poles(words), poles(skill.split())):
        return True
    source = source_of(text)
    if source is None or source_of(skill) is not None:
        return False
    moves_hand = re.match(r"\w+ (?:the )?(?:robot's )?gripper\b", text) is not None
    return moves_hand or bool({*source.split()} & {*skill.split()})


class MappedQuery(NamedTuple):
    """The query that a text was mapped to, and the distance between them."""

    query: Query | None  # None if no query is within the limit
    distance: float  # largest distance of a clause, in [0, 1]
    exact: bool = False  # whether the text is a query itself


class StepMapper:
    """A mapper from text generated by a language model to the nearest queries and scripted skills.

    The phrases in data/words.toml are replaced before the search. The distance between two texts is 1 minus their
    similarity.

    Source: paper section 'LLM Experiments', which uses the nearest text by edit distance.
    """

    def __init__(self, task: Task, skills: Skills | None) -> None:
        self.task, self.skills = task, skills_for(task, skills)
        self.compared = 0
        self.mapped: dict[str, MappedQuery] = {}

    def query(self, text: str) -> MappedQuery:
        """Map a text to the nearest query, using a cache."""
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
        """Return the text of the nearest scripted skill (None if it is too far), and its distance."""
        if text in self.skills:
            return text, 0.0
        if not self.skills or len(text) > _LONGEST:
            return None, 1.0
        words = _with_target(text, self.task)
        text, aside, _ = instruction(words)
        # In "beside rather than above the puck", "beside" has no object.
        is_cut = aside and re.search(rf"\b{_PLACES}(?: \w+){{0,2}}$", text) and not poles(text.split())
        if not text or is_cut or rests(text) or not has_certain_target(text, self.task):
            return None, 1.0
        if match := _phrases("skills").match(text):
            text = WORDS["skills"][match[0]] + text[match.end() :]
        skill, score = nearest_skill(text, None, self.skills)
        return (skill.text if 1.0 - score <= SKILL_LIMIT else None), 1.0 - score


@lru_cache(maxsize=4096)
def _nearest_condition(text: str, task: Task) -> tuple[Query | None, float]:
    """Return the query nearest to a condition (None if the condition has too many clauses) and the distance."""
    words = _with_relation(_with_object(_with_target(plain_negations(text), task), task), task)
    words = _phrases("conditions").sub(lambda match: WORDS["conditions"][match[0]], words)
    with suppress(QueryError):
        match = nearest_query(words, task)
        if len(match.parts) <= _MOST_CLAUSES and all(part.is_certain for part in match.parts):
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


def _with_relation(text: str, task: Task) -> str:
    """Repeat a relation for its second object: "near the mug and the goal" gives "near the mug and near the goal"."""
    names = "|".join(map(re.escape, sorted(task.object_names, key=len, reverse=True)))
    relations = "|".join(map(re.escape, sorted(RELATIONS, key=len, reverse=True)))
    return re.sub(
        rf"^((?:(?!\bnot\b|\bor\b).)*\b({relations}) (?:the )?(?:{names}) and )((?:the )?(?:{names}))(?=$| and )",
        r"\1\2 \3",
        text,
    )


@cache
def _phrases(kind: str) -> re.Pattern[str]:
    """Compile a pattern that matches the phrases in a table of words.toml, the longest first."""
    longest = sorted(WORDS[kind], key=len, reverse=True)
    return re.compile(rf"\b(?:{'|'.join(map(re.escape, longest))})\b")
