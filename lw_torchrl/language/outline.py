"""Outlines: a plan's conditions as a tree of ``if``, ``else if`` and ``else``, for human readers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any, TypeAlias

from lw_torchrl.language.expressions import Expression, all_of, as_expression, leaves, negate, write
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import TOUCHING

MOST_DEPTH = 12  # maximum depth at which several steps share a branch
_Parts: TypeAlias = dict[Expression, None]  # the parts of a conjunction, in order


@dataclass(frozen=True)
class Line:
    """A line of an outline: the head of a branch, or a step."""

    depth: int  # nesting, from 0
    steps: tuple[int, ...]  # indices (from 0) of the steps in the branch, or of the step itself
    head: str = ""  # "if", "else if" or "else"; "" for a step
    condition: Expression | None = None  # of "if" and "else if"

    def __str__(self) -> str:
        """Return a branch's head with its condition in short form, or a step's number (from 1)."""
        if not self.head:
            return str(self.steps[0] + 1)
        if self.condition is None:
            return self.head
        has_clauses = all(isinstance(leaf, Clause) for leaf in leaves(self.condition))
        return f"{self.head} {short_condition(Query(self.condition) if has_clauses else self.condition)}"


def outline(guards: Sequence[Any]) -> list[Line]:
    """Arrange the steps of a plan as an outline, by the conditions that consecutive steps share.

    A step's condition is the conjunction of the branch heads above the step. "else" negates the preceding branches at
    the same depth.

    Args:
        guards: the steps' conditions, as queries, expressions or texts.

    Example:
        >>> from lw_torchrl.language.queries import parse_query
        >>> texts = ["gripper near puck and closed", "gripper near puck and not closed", "gripper not near puck"]
        >>> for line in outline([parse_query(text, "push") for text in texts]):
        ...     print("  " * line.depth + str(line))
        if gripper near puck
          if gripper closed
            1
          else
            2
        else
          3
    """
    parts = [_parts(guard.expression if isinstance(guard, Query) else as_expression(guard)) for guard in guards]
    lines = list[Line]()
    _arrange([(number, dict.fromkeys(each)) for number, each in enumerate(parts)], 0, lines)
    return lines


def _parts(expression: Expression) -> tuple[Expression, ...]:
    """Return the parts of a conjunction; for any other expression, only the expression itself."""
    return expression.parts if expression.kind == "all" else (expression,)


def _implies(parts: _Parts, other: Expression, levels: int = 2) -> bool:
    """Return whether a conjunction implies another expression, comparing only the first ``levels`` levels."""
    if other in parts or not levels or other.kind == "leaf":
        return other in parts
    return (all if other.kind == "all" else any)(_implies(parts, part, levels - 1) for part in other.parts)


def _arrange(steps: Sequence[tuple[int, _Parts]], depth: int, lines: list[Line]) -> None:
    """Append the outline of steps. Each step is an index and those parts of its guard that no line above states."""
    excluded = list[Expression]()  # the negations of the preceding branches, as long as "else" can follow
    at = 0
    while at < len(steps):
        number, parts = steps[at]
        if not parts:
            lines.append(Line(depth, (number,)))
            excluded, at = [], at + 1
            continue
        follows = bool(excluded) and all(_implies(parts, negation) for negation in excluded)
        if not follows:
            excluded = []
        run = _run(steps[at:] if depth < MOST_DEPTH else steps[at : at + 1], excluded)
        shared = [part for part in run[0][1] if all(part in other for _, other in run)]
        head = "if" if not follows else "else if" if shared else "else"
        branch = all_of(shared)
        lines.append(Line(depth, tuple(number for number, _ in run), head, branch if shared else None))
        _arrange([(number, _without(parts, shared)) for number, parts in run], depth + 1, lines)
        excluded = [*excluded, negate(branch)] if shared else []
        at += len(run)


def _run(steps: Sequence[tuple[int, _Parts]], excluded: Sequence[Expression]) -> list[tuple[int, _Parts]]:
    """Return the steps of the next branch, without the parts of their guards that "else" already implies.

    The branch contains the longest run of steps that share a part of the first step's guard.
    """
    stated = {part for negation in excluded for part in _parts(negation)}
    run = list[tuple[int, _Parts]]()
    shared: set[Expression] | None = None
    for number, parts in steps:
        rest = _without(parts, stated)
        if not all(_implies(parts, negation) for negation in excluded):
            break
        both = set(rest) if shared is None else shared.intersection(rest)
        if run and (bool(both) != bool(shared) or (not shared and rest)):
            break
        shared = both
        run.append((number, rest))
    return run


def _without(parts: _Parts, stated: Any) -> _Parts:
    return {part: None for part in parts if part not in stated}


def short_condition(condition: Any) -> str:
    """Shorten a condition, for example to "gripper above and not left or right of puck"; only queries are shortened."""
    if not isinstance(condition, Query):
        return str(condition)
    if condition.is_conjunction:
        return _short_conjunction(condition.clauses) or str(condition)
    return write(condition.expression, lambda clause, negated: _short_conjunction([replace(clause, negated=negated)]))


def _short_conjunction(listed: Sequence[Clause]) -> str:
    parts, last_subject = [], ""
    # Consecutive clauses about the same two objects form one part; a clause without an object forms its own part.
    numbered = [(c.subject, c.object, i if c.object is None else -1) for i, c in enumerate(listed)]
    for (subject, target, _), pairs in groupby(zip(numbered, listed, strict=True), lambda pair: pair[0]):
        clauses = [clause for _, clause in pairs]
        words = ["" if subject == last_subject else subject.removeprefix("robot's ")]
        last_subject, negated = subject, False
        for i, clause in enumerate(clauses):
            joint = ("or" if negated else "and not") if clause.negated else "but" if negated else "and"
            first, *rest = clause.predicate.split()
            keeps_preposition = clause is clauses[-1] or not rest or rest[-1] not in ("of", "with", "to")
            if clause.predicate == TOUCHING:
                words.append("off table" if clause.negated else "on table")
            else:
                words += [joint if i else "not" if clause.negated else "", first]
                words += rest if keeps_preposition else rest[:-1]
            negated = clause.negated
        parts.append(" ".join(filter(None, [*words, target])))
    return " and ".join(parts)
