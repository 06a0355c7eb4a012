"""Boolean expressions over hashable leaves, in a normal form in which equal parts are the same object."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from threading import Lock
from typing import Any, Literal, NamedTuple, TypeVar
from weakref import WeakValueDictionary

Kind = Literal["leaf", "all", "any"]
Result = TypeVar("Result")
MOST_PARTS = 1_000  # maximum number of parts of a conjunction or disjunction; flattening n parts takes O(n²) time


class _Node:
    """A leaf (``parts`` is None), or the conjunction of ``parts``. Equal nodes are the same object."""

    __slots__ = ("__weakref__", "leaf", "parts")

    def __init__(self, leaf: Hashable, parts: tuple[Expression, ...] | None) -> None:
        self.leaf, self.parts = leaf, parts


class Expression(NamedTuple):
    """A boolean expression: a leaf, its negation, or a conjunction or disjunction of expressions.

    :func:`all_of`, :func:`any_of` and :func:`negate` return expressions in normal form. Only leaves are negated. A
    part of a conjunction is never a conjunction, a copy or the negation of another part, or a disjunction that contains
    another part. The same holds for disjunctions. Parts keep their order. Two expressions are equal if they have the
    same normal form.

    Equal parts are stored once, and the functions of this module visit each part once. Time and memory are therefore
    linear in the number of distinct parts, even if the written expression is exponentially long. The depth is not
    limited.

    Example:
        >>> expression = any_of([all_of(["near", negate("closed")]), "held"])
        >>> str(expression), [part.kind for part in expression.parts]
        ('near and not closed or held', ['all', 'leaf'])
        >>> negate(expression) == all_of([any_of([negate("near"), "closed"]), negate("held")])
        True
    """

    node: _Node  # a disjunction is stored as the negation of a conjunction
    negated: bool

    @property
    def kind(self) -> Kind:
        """The kind: a leaf (negated if :attr:`negated`), or a conjunction ("all") or disjunction ("any") of parts."""
        return "leaf" if self.node.parts is None else "any" if self.negated else "all"

    @property
    def leaf(self) -> Any:
        """The value of a leaf before its negation."""
        return self.node.leaf

    @property
    def parts(self) -> tuple[Expression, ...]:
        """The parts of a conjunction or disjunction; a leaf has none."""
        parts = self.node.parts or ()
        return tuple(map(negate, parts)) if self.negated else parts

    def __str__(self) -> str:
        """Write the expression with "and", "or", "not" and parentheses. This can take exponential time."""
        return write(self, lambda leaf, negated: f"not {leaf}" if negated else str(leaf))

    def __repr__(self) -> str:
        return f"<{self}>" if count_mentions(self) <= 100 else f"<{self.kind} of {len(self.parts)} expressions>"

    def __reduce__(self) -> tuple[Any, ...]:
        rows: list[tuple[Kind, bool, Any, list[int]]] = []  # a flat list, since pickle limits the depth

        def number(each: Expression, parts: list[int]) -> int:
            rows.append((each.kind, each.negated, each.leaf, parts))
            return len(rows) - 1

        fold(self, number)
        return _rebuild, (rows,)


def _rebuild(rows: Iterable[tuple[Kind, bool, Any, list[int]]]) -> Expression:
    made: list[Expression] = []
    for kind, negated, leaf, numbers in rows:
        parts = [made[number] for number in numbers]
        made.append(_literal(leaf, negated) if kind == "leaf" else all_of(parts) if kind == "all" else any_of(parts))
    return made[-1]


_nodes: WeakValueDictionary[Any, _Node] = WeakValueDictionary()
_lock = Lock()


def _shared(key: Any, leaf: Hashable, parts: tuple[Expression, ...] | None) -> _Node:
    with _lock:
        if (node := _nodes.get(key)) is None:
            node = _nodes[key] = _Node(leaf, parts)
        return node


def _literal(leaf: Any, negated: bool = False) -> Expression:
    return Expression(_shared((type(leaf), leaf), leaf, None), negated)


def as_expression(value: Any) -> Expression:
    """Return an expression unchanged; convert any other hashable value to a leaf."""
    return value if isinstance(value, Expression) else _literal(value)


def negate(value: Any) -> Expression:
    """Return the negation of an expression or leaf."""
    expression = as_expression(value)
    return Expression(expression.node, not expression.negated)


def all_of(parts: Iterable[Any]) -> Expression:
    """Return the conjunction of expressions or leaves; :data:`TRUE` if there are none.

    Raises:
        ValueError: the conjunction has more than 1,000 parts.
    """
    distinct: dict[Expression, None] = {}
    for part in map(as_expression, parts):
        if part.node.parts is not None and not part.negated:
            distinct.update(dict.fromkeys(part.parts))
        else:
            distinct[part] = None
        if len(distinct) > MOST_PARTS:
            raise ValueError(f"a condition must join at most {MOST_PARTS} parts by 'and' or 'or'; split the condition")
    either = [part for part in distinct if part.node.parts is not None]
    if len({part.node for part in distinct}) < len(distinct):
        return FALSE  # an expression and its negation have the same node
    if any(all(other in distinct for other in part.node.parts or ()) for part in either):
        return FALSE  # "a and b and not (a and b)"
    if either:
        negations = {negate(part) for part in distinct}
        for part in either:
            if not negations.isdisjoint(part.node.parts or ()):  # "a and (a or b)" is "a"
                del distinct[part]
    if len(distinct) == 1:
        return next(iter(distinct))
    # The key holds the parts' ids instead of the parts, so that only the node keeps the parts in memory.
    key = tuple((id(part.node), part.negated) for part in distinct)
    return Expression(_shared(key, None, tuple(distinct)), False)


def any_of(parts: Iterable[Any]) -> Expression:
    """Return the disjunction of expressions or leaves; :data:`FALSE` if there are none. See :func:`all_of`."""
    return negate(all_of(map(negate, parts)))


TRUE = Expression(_shared((), None, ()), False)
"""The expression that is always true."""
FALSE = negate(TRUE)
"""The expression that is never true."""


@dataclass(frozen=True)
class Once:
    """A latch: a leaf that is true from the first time step of an episode at which ``condition`` is true.

    The condition may contain other latches. :func:`once` makes latches in normal form.
    """

    condition: Expression

    def __str__(self) -> str:
        return f"once ({self.condition})"

    @cached_property  # avoids repeated visits to a latch that several others mention
    def literals(self) -> tuple[Expression, ...]:
        """The distinct leaves and negated leaves of the condition, without latches."""
        return literals(self.condition)

    @cached_property
    def mentions(self) -> int:
        """The number of leaves in the written condition, counting repetitions."""
        return count_mentions(self.condition)


def once(condition: Any) -> Expression:
    """Return a latch of an expression or leaf (:class:`Once`).

    Example:
        >>> print(once(all_of(["near", once("held")])))
        once (near and once (held))
    """
    expression = as_expression(condition)
    is_latch = expression.kind == "leaf" and not expression.negated and isinstance(expression.leaf, Once)
    return expression if is_latch or expression in (TRUE, FALSE) else as_expression(Once(expression))


def has_latch(expression: Expression) -> bool:
    """Return whether an expression contains a latch."""
    return fold(expression, lambda each, parts: isinstance(each.leaf, Once) if each.kind == "leaf" else any(parts))


def fold(expression: Expression, visit: Callable[[Expression, list[Result]], Result]) -> Result:
    """Compute a result bottom-up: call ``visit(part, results of its parts)`` once for each distinct part."""
    results: dict[Expression, Result] = {}
    stack = [expression]
    while stack:
        parts = stack[-1].parts
        if missing := [part for part in parts if part not in results]:
            stack += reversed(missing)
            continue
        each = stack.pop()
        if each not in results:
            results[each] = visit(each, [results[part] for part in parts])
    return results[expression]


def evaluate(expression: Expression, truth: Mapping[Any, bool]) -> bool:
    """Return the truth of an expression, given the truth of its leaves.

    A latch has the truth of its condition, as in the first step of an episode.
    """

    def visit(each: Expression, parts: list[bool]) -> bool:
        if each.kind == "leaf":
            leaf = each.leaf
            return bool(fold(leaf.condition, visit) if isinstance(leaf, Once) else truth[leaf]) != each.negated
        return all(parts) if each.kind == "all" else any(parts)

    return fold(expression, visit)


def map_leaves(expression: Expression, function: Callable[[Any], Any]) -> Expression:
    """Replace each leaf and each latch with ``function(leaf)``, an expression or a leaf."""

    def visit(each: Expression, parts: list[Expression]) -> Expression:
        if each.kind == "leaf":
            return negate(function(each.leaf)) if each.negated else as_expression(function(each.leaf))
        return all_of(parts) if each.kind == "all" else any_of(parts)

    return fold(expression, visit)


def replace_leaves(expression: Expression, function: Callable[[Any], Any]) -> Expression:
    """Replace each leaf like :func:`map_leaves`, but in a latch replace the leaves of the condition."""

    @cache  # several latches may mention the same latch
    def replaced(leaf: Any) -> Any:
        return once(map_leaves(leaf.condition, replaced)) if isinstance(leaf, Once) else function(leaf)

    return map_leaves(expression, replaced)


def literals(expression: Expression) -> tuple[Expression, ...]:
    """Return the distinct leaves and negated leaves, in the order of their first mention.

    Latches are left out, but the leaves of their conditions are included.
    """
    found: dict[Expression, None] = {}

    def visit(each: Expression, _: list[None]) -> None:
        if each.kind == "leaf":
            found.update(dict.fromkeys(each.leaf.literals if isinstance(each.leaf, Once) else (each,)))

    fold(expression, visit)
    return tuple(found)


def leaves(expression: Expression) -> tuple[Any, ...]:
    """Return the distinct leaves, in the order of their first mention."""
    return tuple(dict.fromkeys(literal.leaf for literal in literals(expression)))


def implied(expression: Expression) -> tuple[Expression, ...]:
    """Return leaves and negated leaves that are true wherever the expression is true.

    The result has only leaves that follow from the form of the expression; truth values are not searched.

    Example:
        >>> implied(all_of(["a", any_of([all_of([negate("b"), "c"]), negate("b")])]))
        (<a>, <not b>)
    """

    def visit(each: Expression, parts: list[dict[Expression, None]]) -> dict[Expression, None]:
        if each.kind == "leaf":
            return {each: None}
        if each.kind == "all":
            return {literal: None for part in parts for literal in part}
        return {literal: None for literal in (parts or [{}])[0] if all(literal in part for part in parts)}

    literals: dict[Expression, None] = fold(expression, visit)
    return tuple(literals)


def count_mentions(expression: Expression) -> int:
    """Return the number of leaves in the written expression, counting repetitions, without writing the expression."""

    def visit(each: Expression, parts: list[int]) -> int:
        if each.kind != "leaf":
            return sum(parts)
        return each.leaf.mentions if isinstance(each.leaf, Once) else 1

    return fold(expression, visit)


def write(expression: Expression, literal: Callable[[Any, bool], str]) -> str:
    """Write an expression with "and", "or" and parentheses: "and" binds tighter. ``literal(leaf, negated)`` writes a
    leaf. :data:`TRUE` is "always", :data:`FALSE` is "never".
    """

    texts: list[str] = []
    stack: list[Expression | str] = [expression]
    while stack:
        each = stack.pop()
        if isinstance(each, str):
            texts.append(each)
        elif each.kind == "leaf":
            texts.append(literal(each.leaf, each.negated))
        elif not each.parts:
            texts.append("never" if each.negated else "always")
        else:
            joined: list[Expression | str] = []
            for part in each.parts:
                bracketed = each.kind == "all" and part.kind == "any"
                joined += [" and " if each.kind == "all" else " or ", *(("(", part, ")") if bracketed else (part,))]
            stack += joined[:0:-1]
    return "".join(texts)
