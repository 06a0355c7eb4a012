"""The query language: English conditions on a state, such as "the robot's gripper is not above the puck"."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import permutations

from rapidfuzz import fuzz, process

from lw_torchrl._util.checks import typed
from lw_torchrl.language.connectives import CONNECTIVES, OPENERS, parse_words, repeat_predicate
from lw_torchrl.language.expressions import (
    FALSE,
    TRUE,
    Expression,
    Once,
    all_of,
    as_expression,
    count_mentions,
    has_latch,
    implied,
    leaves,
    literals,
    map_leaves,
    negate,
    once,
    replace_leaves,
    write,
)
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.relations import PREDICATES, PUBLISHED, RELATIONS, STATES, TOUCHING, UNARY
from lw_torchrl.language.tasks import Task, get_task

_BEGINNINGS = {"is", "are", "isn't", "aren't", "not", *(name.split()[0] for name in PREDICATES)}  # of predicates
ARTICLES = ("the", "a", "an")
_ALIASES = {"gripper": GRIPPER, "robot gripper": GRIPPER}
_OTHERS = frozenset(("(", *CONNECTIVES)) - {"and"}
MOST_CLAUSES = 256  # maximum number of clauses in the text of a query
_PERFECT = re.compile(
    r"\b(?:(?:has|have|had)|(?:was|were)(?= (?:not |never )?(?:once|ever)\b))(n't\b| not\b| never\b)?"
    r"(?: (?:once|ever|already|yet|just|before)\b)*(?: been\b)?"
)


@dataclass(frozen=True)
class Clause:
    """A statement about one or two objects."""

    subject: str
    predicate: str  # a relation, "touching the table", or a state such as "open"
    object: str | None = None  # the second object of a relation
    negated: bool = False

    def __str__(self) -> str:
        words = f"the {self.subject} is {'not ' if self.negated else ''}{self.predicate}"
        return words if self.object is None else f"{words} the {self.object}"


@dataclass(frozen=True, init=False)
class Query:
    """A condition: a boolean expression over clauses. ``str(query)`` is the canonical spelling.

    Queries are equal if their expressions have the same normal form. The text of a conjunction keeps the clauses as
    given, including repetitions.

    Args:
        expression: an expression over clauses (:mod:`lw_torchrl.language.expressions`), or a tuple of clauses that must
            all be true.

    Example:
        >>> str(parse_query("Is the gripper open and not above the puck?", task="pick-place"))
        "the robot's gripper is open and the robot's gripper is not above the puck"
        >>> print(parse_query("either the gripper is open or the puck is not near the target location", task="push"))
        the robot's gripper is open or the puck is not near the target location
        >>> print(parse_query("the gripper has been near the puck", task="push"))  # a latch: true from then on
        the robot's gripper has been near the puck
    """

    expression: Expression
    _given: tuple[Clause, ...] = field(default=(), init=False, compare=False, repr=False)

    def __init__(self, expression: Expression | tuple[Clause, ...]) -> None:
        if not isinstance(expression, Expression):
            object.__setattr__(self, "_given", tuple(expression))
            expression = all_of(map(_without_negation, expression))
        elif any(clause.negated for clause in leaves(expression)):
            expression = replace_leaves(expression, _without_negation)
        object.__setattr__(self, "expression", expression)

    def __str__(self) -> str:
        if self._given:
            return " and ".join(map(str, self._given))
        return write(self.expression, _write_literal)

    @property
    def is_conjunction(self) -> bool:
        """True for a clause or a conjunction of clauses: a query without "or" and without latches."""
        if self._given:
            return True
        parts = self.expression.parts
        return self.expression.kind != "any" and not self.has_latch and all(part.kind == "leaf" for part in parts)

    @cached_property
    def has_latch(self) -> bool:
        """Whether the query depends on earlier steps of the episode ("has been", "once (...)")."""
        return has_latch(self.expression)

    @property
    def present(self) -> Query:
        """The query without memory: each latch is replaced by its condition."""
        return Query(_present(self.expression)) if self.has_latch else self

    @cached_property
    def clauses(self) -> tuple[Clause, ...]:
        """The clauses that the query mentions, in order; for a conjunction, the clauses that must all be true."""
        return self._given or tuple(map(_as_clause, literals(self.expression)))

    @cached_property
    def implied(self) -> tuple[Clause, ...]:
        """Clauses that are true wherever the query is true; see :func:`~lw_torchrl.language.expressions.implied`."""
        found = [literal for literal in implied(self.expression) if not isinstance(literal.leaf, Once)]
        return self._given or tuple(map(_as_clause, found))


def _without_negation(clause: Clause) -> Expression:
    return negate(replace(clause, negated=False)) if clause.negated else as_expression(clause)


def _present(expression: Expression) -> Expression:
    return map_leaves(expression, lambda leaf: _present(leaf.condition) if isinstance(leaf, Once) else leaf)


def _write_literal(leaf: Clause | Once, negated: bool) -> str:
    """Write a clause or a latch: "the puck has been near the goal" for a clause, otherwise "once (...)"."""
    if isinstance(leaf, Clause):
        return str(replace(leaf, negated=negated))
    condition = leaf.condition
    if condition.kind == "leaf" and not condition.negated and isinstance(condition.leaf, Clause):
        clause = condition.leaf
        words = f"the {clause.subject} has {'not ' if negated else ''}been {clause.predicate}"
        return words if clause.object is None else f"{words} the {clause.object}"
    return f"{'not ' if negated else ''}once ({write(condition, _write_literal)})"


def split_perfect(text: str) -> tuple[str, bool, bool]:
    """Return a clause in the present tense, whether it was in the perfect tense, and whether the perfect was negated.

    Example:
        >>> split_perfect("the gripper has not been near the puck")
        ('the gripper is near the puck', True, True)
    """
    match = _PERFECT.search(text)
    if match is None or not match[0].endswith(("been", "once", "ever")):
        return text, False, False
    before = re.sub(r"^(?:once|after|since) ", "", text[: match.start()])
    return f"{before}is{text[match.end() :]}", True, match[1] is not None


def _as_clause(literal: Expression) -> Clause:
    return replace(literal.leaf, negated=True) if literal.negated else literal.leaf


class QueryError(ValueError):
    """The error for a text that is not a query about the objects of its task."""


def split_words(text: str) -> list[str]:
    """Split a text into words and parentheses. "not above or near the puck" becomes "not (above the puck or near the
    puck)".

    Raises:
        QueryError: the text has more clauses or groups than a query may have.
    """
    words = re.findall(r"[()]|[^\s()]+", text)
    joins = Counter(map(str.casefold, words))
    clauses = 1 + sum(joins[word] for word in ("and", "or", "nor", "unless"))
    groups = sum(joins[word] for word in OPENERS)
    for number, counted in ((clauses, "clauses"), (groups, "parentheses")):
        if number > MOST_CLAUSES:
            raise QueryError(f"query {_cut(text)!r} must have at most {MOST_CLAUSES} {counted}, got {number}")
    spaced, pattern = " ".join(words), _two_relations(tuple(RELATIONS))
    if pattern.search(spaced) is None:
        return words
    return re.findall(r"[()]|[^\s()]+", pattern.sub(r"(\1 \4 \2 \3 \4)", spaced))


@lru_cache(maxsize=16)
def _two_relations(names: tuple[str, ...]) -> re.Pattern[str]:
    """Compile a regex for phrases with two relations and a shared object, such as "above and near the puck"."""
    relation = "|".join(map(re.escape, sorted(names, key=len, reverse=True)))
    word = r"(?!(?:and|or|nor|unless|is|isn't)\b)[^\s()]+"
    return re.compile(rf"\b({relation}) (and|or) ({relation}) ({word}(?: {word})*)", re.IGNORECASE)


@lru_cache(maxsize=256)
def base_clauses(task: Task, predicates: tuple[str, ...]) -> tuple[Clause, ...]:
    """Return the clauses of :func:`supported_queries` that use the given relations and states."""
    relations, states = ([name for name in predicates if name in table] for table in (RELATIONS, STATES))
    clauses = []
    for first, second in permutations(task.object_names, 2):
        for relation in relations:
            if relation != "around" or first == GRIPPER:
                clauses += [Clause(first, relation, second, negated) for negated in (False, True)]
    movable = [places(part) for part in task.layout.positions[1:-1]]
    for named in task.objects:
        if not named.ours and named.position in movable:
            clauses += [Clause(named.name, TOUCHING), Clause(named.name, TOUCHING, negated=True)]
    clauses += [Clause(named.name, state) for named in task.objects if named.opening is not None for state in states]
    return (*clauses, Clause(GRIPPER, "open"), Clause(GRIPPER, "closed"))


@typed
def supported_queries(task: str | Task, published_only: bool = False) -> tuple[str, ...]:
    """Return the supported queries of a task that consist of a single clause, in canonical spelling.

    These base queries are a selection: :func:`parse_query` also accepts "around" for any two objects, "touching the
    table" for any object, negated states, and any combination of clauses.

    Args:
        published_only: return only the paper's queries, without our added points and without custom relations.

    Example:
        >>> len(supported_queries("reach")), supported_queries("reach")[0]
        (52, "the robot's gripper is near the reach target")
    """
    owner = get_task(task)
    clauses = base_clauses(owner.published, PUBLISHED) if published_only else base_clauses(owner, tuple(PREDICATES))
    return tuple(map(str, clauses))


def _cut(text: str, most: int = 80) -> str:
    """Shorten a text to at most ``most`` characters by removing its middle."""
    return text if len(text) <= most else f"{text[: most - 25]} ... {text[-20:]}"


class _ClauseParser:
    """A left-to-right parser for one clause. Its errors point at a word of the text."""

    def __init__(self, words: Sequence[str], task: Task, text: str, explain: bool) -> None:
        self.words, self.task, self.text, self.explain, self.at = words, task, text, explain, 0
        self.inferred = ""  # "the puck is", if the clause leaves out its subject
        self.names = {name: name for name in task.object_names}
        self.names.update({alias: name for alias, name in _ALIASES.items() if alias not in self.names})

    def error(self, expected: str) -> QueryError:
        if not self.explain:  # building the full error is slow, because of the search for the nearest query
            return QueryError("not a query")
        word = f"{_cut(self.words[self.at], 40)!r} (word {self.at + 1})" if self.at < len(self.words) else "the end"
        context = " ".join(self.words[max(0, self.at - 8) : self.at + 8])
        close = process.extractOne((self.inferred + context)[:300], supported_queries(self.task), scorer=fuzz.ratio)
        return QueryError(
            f"query {_cut(self.text)!r} of task {self.task.name!r}: at {word} in {_cut(context, 60)!r}, "
            f"expected {expected}. The nearest query is {close[0]!r}; supported_queries({self.task.name!r}) lists all."
        )

    def take(self, phrase: str) -> bool:
        """Consume a phrase if it comes next in the text; return whether it did."""
        words = phrase.split()
        if list(self.words[self.at : self.at + len(words)]) != words:
            return False
        self.at += len(words)
        return True

    def name(self) -> str | None:
        """Consume and return an object's name; return None if no name comes next."""
        start = self.at
        self.at += self.at_article()
        for name in sorted(self.names, key=len, reverse=True):
            if self.take(name):
                return self.names[name]
        self.at = start
        return None

    def name_error(self, expected: str = "") -> QueryError:
        self.at += self.at_article()  # point at the noun, not at the article
        return self.error(expected or "one of " + ", ".join(repr(f"the {name}") for name in self.task.object_names))

    def at_article(self) -> bool:
        return self.at < len(self.words) and self.words[self.at] in ARTICLES

    def parse(self, previous: str | None) -> Clause:
        if not self.words:
            raise self.error("a condition")
        negated = self.take("isn't")
        denied = not negated and self.take("not")  # "not the gripper is open"
        if not negated and not denied:
            self.take("is")
        subject = self.name()
        if subject is None and denied:
            self.at, denied = 0, False
        if subject is None:
            if previous is None or self.at_article():
                raise self.name_error()
            subject = previous
            self.inferred = f"the {subject} is "
        if not negated:
            negated = self.take("isn't") or (self.take("is") and self.take("not")) or self.take("not")
        predicate = next((name for name in sorted(PREDICATES, key=len, reverse=True) if self.take(name)), None)
        if predicate is None:
            raise self.error("one of " + ", ".join(map(repr, PREDICATES)))
        if predicate in STATES and subject not in self.task.openings:
            self.at -= len(predicate.split())
            openable = " and ".join(f"the {name}" for name in self.task.openings).replace(GRIPPER, "gripper")
            raise self.error(f"a predicate that fits the {subject} (only {openable} can be {' or '.join(STATES)})")
        start, other = self.at, None if predicate in UNARY else self.name()
        if other is None and predicate not in UNARY:
            raise self.name_error()
        if other == subject:
            self.at = start
            raise self.name_error(f"an object other than {subject!r}")
        if self.at < len(self.words):
            raise self.error("the end of the clause, 'and' or 'or'")
        return Clause(subject, predicate, other, negated != denied)


@typed
def parse_query(text: str, task: str | Task) -> Query:
    """Parse an English condition on a state of ``task``.

    The text may be a question, use capitals, omit articles, and contain "the gripper" or "isn't". A clause may omit its
    subject if the previous clause has the same subject ("... is open and not above the puck").

    Clauses are joined by "and", "or", "unless", "either ... or", "both ... and", "neither ... nor", "not (...)" and
    parentheses to any depth. "and" binds tighter than "or", and "unless" binds loosest. The condition "always" is
    always true, and "never" is never true.

    A latch is true from the first step of an episode in which a condition was true: "the gripper has been near the
    puck", "once (the gripper is near the puck and closed)". Its condition may contain latches.

    Args:
        text: a condition of at most 256 clauses, such as "Is the gripper open and not above the puck?".

    Raises:
        QueryError: the text is not a query; the message points at the wrong word and suggests the nearest query.

    Example:
        >>> str(parse_query("the gripper above the puck", task="push"))
        "the robot's gripper is above the puck"

    Source: paper section 'Query Answering Function'.
    """
    return _parse(text, get_task(task), explain=True)


def read_query(text: str, task: Task) -> Query | None:
    """Parse a condition like :func:`parse_query`, but return None (quickly) if the text is not a query."""
    with suppress(QueryError):
        return _parse(text, task, explain=False)
    return None


def _parse(text: str, task: Task, explain: bool) -> Query:
    words = repeat_predicate(split_words(text.replace("’", "'").casefold().strip().rstrip(" ?.!")), _BEGINNINGS)
    clauses: list[Clause] = []

    def operand_of(operand: list[str]) -> Expression:
        if operand in (["always"], ["never"]):
            return TRUE if operand == ["always"] else FALSE
        present, is_latch, is_negated = split_perfect(" ".join(operand))
        words = present.split() if is_latch else operand
        clause = _ClauseParser(words, task, text, explain).parse(clauses[-1].subject if clauses else None)
        clauses.append(clause)
        if not is_latch:
            return _without_negation(clause)
        latch = once(replace(clause, negated=False))
        return negate(latch) if clause.negated != is_negated else latch

    def fail(number: int, expected: str) -> QueryError:
        parser = _ClauseParser(words, task, text, explain)
        parser.at = number
        return parser.error(expected)

    expression = parse_words(words, operand_of, fail)
    assert expression is not None  # every operand is a clause or an error
    is_plain = len(clauses) == 1 + words.count("and") and not _OTHERS.intersection(words) and not has_latch(expression)
    return Query(tuple(clauses) if is_plain else expression)


def check_query(query: str | Query, task: str | Task) -> Query:
    """Parse a text, or check that a :class:`Query` is valid for ``task``; return the Query."""
    if not isinstance(query, Query):
        return parse_query(query, task)
    owner = get_task(task)
    clauses = len(query.clauses) if query.is_conjunction else count_mentions(query.expression)
    if clauses > MOST_CLAUSES:
        raise QueryError(f"a query's text must have at most {MOST_CLAUSES} clauses, got {clauses}")
    if all(_is_of(clause, owner) for clause in query.clauses):
        return query
    return parse_query(str(query), owner)  # resolves aliases, or raises an error that explains the fault


def _is_of(clause: Clause, task: Task) -> bool:
    if clause.predicate in UNARY:
        fits = clause.object is None and (clause.predicate not in STATES or clause.subject in task.openings)
    else:
        fits = clause.predicate in RELATIONS and clause.object in task.object_names and clause.object != clause.subject
    return fits and clause.subject in task.object_names and type(clause.negated) is bool
