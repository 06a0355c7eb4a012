"""Values of expressions in code: conditions, distances, and texts that depend on conditions."""

from __future__ import annotations

import ast
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from lw_torchrl.language.expressions import FALSE, TRUE, Expression, as_expression
from lw_torchrl.language.programs import Action, Block, Branch, Node, ProgramError, choose

_MOST_TEXTS = 64  # maximum number of values of a text that depends on conditions
_LONGEST = 1_000  # maximum length of a text (characters)


@dataclass(frozen=True)
class Choice:
    """A string that depends on a condition."""

    condition: Expression
    then: Text
    otherwise: Text
    count: int = field(init=False)  # number of possible strings

    def __post_init__(self) -> None:
        count = sum(each.count if isinstance(each, Choice) else 1 for each in (self.then, self.otherwise))
        if count > _MOST_TEXTS:
            raise ProgramError(f"a string that depends on conditions must have at most {_MOST_TEXTS} possible values")
        object.__setattr__(self, "count", count)


class Name(str):
    """The words of a name that the program does not define, such as "puck" for ``env.puck``."""


@dataclass(frozen=True)
class Distance:
    """The distance between two objects (horizontal for ``hand[:2] - puck[:2]``), and the relation if it is small."""

    first: Text
    second: Text
    relation: str


Text: TypeAlias = str | Choice
Value: TypeAlias = "Expression | Text | Distance | ast.Lambda | list[Value] | dict[Any, Value] | None"


def joined(parts: Sequence[Text], gap: str = " ") -> Text:
    """Join texts. If one of them depends on a condition, so does the result."""
    for number, part in enumerate(parts):
        if isinstance(part, Choice):
            both = (joined([*parts[:number], each, *parts[number + 1 :]], gap) for each in (part.then, part.otherwise))
            return Choice(part.condition, *both)
    if sum(map(len, parts)) > _LONGEST:  # type: ignore[arg-type]
        raise ProgramError(f"a text must have at most {_LONGEST} characters")
    return gap.join(str(part) for part in parts if part != "")


def each_text(text: Text, function: Callable[[str], Any], join: Callable[[Expression, Any, Any], Any]) -> Any:
    """Apply a function to each possible string of a text; ``join`` combines the results of both cases."""
    if isinstance(text, Choice):
        return join(text.condition, *(each_text(part, function, join) for part in (text.then, text.otherwise)))
    return function(text)


def lookup(table: dict[Any, Value], key: Any, default: Value = None) -> Value:
    """Return the entry of a table at a key that may depend on conditions."""

    def join(condition: Expression, then: Value, otherwise: Value) -> Value:
        return chosen(condition, then or "", otherwise or "")

    return each_text(key, lambda each: table.get(each, default), join)


def leaf(text: Text) -> Expression:
    """Return the condition that a text states."""
    return each_text(text, lambda words: as_expression(" ".join(words.split())) if words else FALSE, choose)


def action(text: Text, line: int, goal: str = "", otherwise: Node = Block()) -> Node:  # noqa: B008
    """Return the action that a text states; ``otherwise`` where the text is empty."""

    def said(words: str) -> Node:
        return Action(" ".join(words.split()), line, goal) if words or goal else otherwise

    return each_text(text, said, Branch)


def truth(value: Value) -> Expression:
    """Convert a value to a condition."""
    return leaf(value) if isinstance(value, str | Choice) else value if isinstance(value, Expression) else FALSE


def constant(value: object) -> Expression | None:
    return None if not isinstance(value, int) else TRUE if value else FALSE


def chosen(condition: Expression, then: Value, otherwise: Value) -> Value:
    """Return the value that a variable has after an ``if`` statement."""
    # A function that returns a text only in one branch returns None, an empty text, in the other.
    then, otherwise = (
        "" if one == FALSE and isinstance(other, str | Choice) else one
        for one, other in ((then, otherwise), (otherwise, then))
    )
    if isinstance(then, Expression) or isinstance(otherwise, Expression):
        return then if otherwise is None else choose(condition, truth(then), truth(otherwise))
    if isinstance(then, str | Choice) and isinstance(otherwise, str | Choice) and then != otherwise:
        return Choice(condition, then, otherwise)
    return then
