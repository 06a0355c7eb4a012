"""Argument checks (types and ranges with beartype, names by lookup) and helpers for error messages."""

import re
from collections.abc import Callable, Collection, Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from functools import cache, wraps
from math import inf
from numbers import Integral, Real
from os import PathLike, fspath
from os.path import expanduser
from reprlib import Repr
from types import SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from beartype import BeartypeConf, FrozenDict
from beartype.door import is_bearable
from beartype.vale import Is, IsInstance

_NOT_BOOL = ~IsInstance[bool]
_MOST = float(np.finfo(float).max)
# Reject bools as numbers, NaN, and integers that are too large for a float.
_FLOAT = Annotated[Real, _NOT_BOOL & Is[lambda x: abs(x) <= _MOST or abs(x) == inf]]
_CONF = BeartypeConf(hint_overrides=FrozenDict({int: Annotated[Integral, _NOT_BOOL], float: _FLOAT}))
Count = Annotated[int, Is[lambda n: n >= 1]]
Natural = Annotated[int, Is[lambda n: n >= 0]]
Finite = Annotated[float, Is[lambda x: abs(x) <= _MOST]]
Scale = Annotated[float, Is[lambda x: 0 <= x <= _MOST]]
Positive = Annotated[float, Is[lambda x: 0 < x <= _MOST]]
Probability = Annotated[float, Is[lambda p: 0 <= p <= 1]]

_WORDS: dict[Any, str] = {
    bool: "True or False",
    int: "an integer",
    float: "a number",
    str: "a string",
    type(None): "None",
    Callable: "a function",
    Count: "an integer of at least 1",
    Natural: "an integer of at least 0",
    Finite: "a finite number",
    Scale: "a finite number of at least 0",
    Positive: "a finite number above 0",
    Probability: "a number from 0 to 1",
}

Class = TypeVar("Class", bound=type)
Function = TypeVar("Function", bound=Callable[..., Any])


class ArgumentError(TypeError, ValueError):
    """An error for an argument that has the wrong type or is out of range."""


def typed(function: Function) -> Function:
    """Decorate a function to check each argument against its annotation with :func:`check_value`, except ``*args``,
    ``**kwargs`` and arguments whose types are imported only for type checkers (:func:`as_plans` checks ``plans``)."""

    def read_hints() -> dict[str, Any]:
        hints: dict[str, Any] = {}
        for name in function.__annotations__.keys() - {"return"}:  # the return type may be from a missing package
            argument = SimpleNamespace(__annotations__={name: function.__annotations__[name]})
            with suppress(NameError):
                hints |= get_type_hints(argument, function.__globals__, include_extras=True)
        return hints

    return _checked(function, read_hints)


def typed_fields(kind: Class) -> Class:
    """Decorate a dataclass to check fields against their annotations on construction, as :func:`typed` does."""
    kind.__init__ = _checked(kind.__init__, lambda: get_type_hints(kind, include_extras=True))  # type: ignore[misc]
    return kind


def _checked(function: Any, read_hints: Callable[[], dict[str, Any]]) -> Any:
    code = function.__code__
    positional = code.co_varnames[: code.co_argcount]
    named = {*code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]}
    hints: dict[str, Any] = {}  # evaluated at the first call

    def check(name: str, value: Any) -> Any:
        return check_value(name, value, hints[name]) if name in hints else value

    @wraps(function)
    def run(*args: Any, **kwargs: Any) -> Any:
        if not hints:
            hints.update({name: hint for name, hint in read_hints().items() if name in named and hint is not Any})
        args = (*map(check, positional, args), *args[len(positional) :])
        return function(*args, **{name: check(name, value) for name, value in kwargs.items()})

    return run


def check_value(argument: str, value: Any, hint: Any) -> Any:
    """Return ``value`` if it matches a type hint, otherwise raise an :class:`ArgumentError`. NumPy scalars become
    Python numbers, and "~/" is expanded in paths."""
    if not checker(hint)(value):
        close = did_you_mean(value, re.findall("'(.+?)'", _words(hint)))  # the choices of a Literal
        raise ArgumentError(f"{argument} must be {_words(hint)}, got {shown(value)}{close}")
    return _expanded(value) if "PathLike" in str(hint) else _plain(value)


def _expanded(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [*map(_expanded, value)]
    is_home = isinstance(value, str | PathLike) and fspath(value).startswith("~/")
    return type(value)(expanduser(value)) if is_home else value


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


@cache
def checker(hint: Any) -> Callable[[Any], bool]:
    """Return a function that checks whether a value matches a type hint. Containers are checked item by item: beartype
    checks only one random item, which misses wrong items and advances Python's random generator."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType):
        alternatives = [checker(part) for part in parts]
        return lambda value: any(check(value) for check in alternatives)
    is_container = getattr(kind, "__module__", "") in ("builtins", "collections.abc") and issubclass(kind, Iterable)
    if not is_container or not (parts or kind is tuple):
        return lambda value: is_bearable(_plain(value), hint, conf=_CONF)
    items = [checker(part) for part in parts if part is not ...]

    def check(value: Any) -> bool:
        if not isinstance(value, kind) or isinstance(value, (str, bytes)):  # a string is not a list of strings
            return False
        if issubclass(kind, Mapping):
            return all(items[0](key) and items[1](entry) for key, entry in value.items())
        if kind is tuple and ... not in parts:
            return len(value) == len(items) and all(matches(item) for matches, item in zip(items, value, strict=True))
        return not isinstance(value, Collection) or all(map(items[0], value))  # an iterator is not consumed

    return check


def _words(hint: Any) -> str:
    """Describe a type hint in words, such as "an integer of at least 1"."""
    kind, parts = get_origin(hint), get_args(hint)
    if kind in (Union, UnionType, Literal):
        return " or ".join(map(repr if kind is Literal else _words, parts))
    if words := _WORDS.get(hint) or _WORDS.get(kind):
        return words
    if kind is Annotated:
        return _words(parts[0])
    if kind is None:
        return f"a {hint.__name__}" if isinstance(hint, type) else str(hint)
    items = [re.sub("^an? ", "", _words(part)) for part in parts if part is not ...]
    return f"{kind.__name__}[{', '.join(items)}]"


def check_choice(argument: str, value: Any, allowed: Iterable[str]) -> Any:
    """Return ``value`` if it is in ``allowed``; otherwise raise :func:`unknown_name`."""
    if value not in (names := list(allowed)):
        raise unknown_name(argument, value, names)
    return value


def check_keys(argument: str, row: Any, allowed: Iterable[str], required: Iterable[str] = ()) -> None:
    """Raise a :class:`ValueError` unless ``row`` is a mapping with all ``required`` keys and only ``allowed`` keys."""
    if not isinstance(row, Mapping):
        raise ValueError(f"{argument} must be a table, got {shown(row)}")
    for key in row:
        check_choice("key", key, allowed)
    if missing := [key for key in required if key not in row]:
        raise ValueError(f"{argument} must have {' and '.join(missing)}, got {shown(dict(row))}")


def unknown_name(argument: str, value: object, allowed: Iterable[str]) -> ValueError:
    """Return the error for a name that is not in ``allowed``; the message suggests names with a similar spelling."""
    listed = ", ".join(map(repr, (names := list(allowed))[:12])) + (", ..." if len(names) > 12 else "")
    return ValueError(f"{argument} must be one of {listed}, got {shown(value)}{did_you_mean(value, names, n=3)}")


def nearest(value: str, allowed: Iterable[str], *, n: int = 3) -> list[str]:
    """Return up to ``n`` allowed names with the most similar spelling, most similar first."""
    return get_close_matches(value, list(allowed), n=n, cutoff=0.4)


def did_you_mean(value: object, allowed: Iterable[str], *, n: int = 1) -> str:
    """Return the end of an error message that suggests up to ``n`` similar names, or "" if no name is similar."""
    close = nearest(value, allowed, n=n) if isinstance(value, str) else ()
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def missing_keys(present: Iterable[Any], *needed: str) -> ValueError:
    """Return the error for a tensordict with the keys ``present`` that lacks some of the ``needed`` keys."""
    names = [*map(str, present)]
    absent = [key for key in needed if key not in names]
    hint = "; add QAFTransform(plans), which writes qaf, to the environment or buffer" if "qaf" in absent else ""
    return ValueError(f"the tensordict must have {' and '.join(absent)}, got {', '.join(names)}{hint}")


_SHORT = Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother, _SHORT.maxlist, _SHORT.maxtuple, _SHORT.maxdict = 3, 80, 80, 8, 8, 8


def shown(value: object) -> str:
    """Return a short ``repr`` of any value for an error message, without errors for huge integers or deep nesting."""
    try:
        return _SHORT.repr(value)
    except (ValueError, RecursionError):  # Python refuses to print integers of more than 4,300 digits
        return f"a {type(value).__name__}"
