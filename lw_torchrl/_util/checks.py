"""Checks of arguments: beartype checks types and ranges; these functions check names and word errors."""

import re
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from numbers import Integral, Real
from reprlib import Repr
from typing import Annotated, Any, TypeVar

import numpy as np
from beartype import BeartypeConf, BeartypeViolationVerbosity, FrozenDict, beartype
from beartype.door import is_bearable
from beartype.vale import Is, IsInstance


class ArgumentError(TypeError, ValueError):
    """An argument has the wrong type or is out of range."""

    def __init__(self, message: str) -> None:
        # beartype: "Function lw_torchrl.x.f() parameter n=0 violates type hint typing.Annotated[...]."
        message = re.sub(r"^\w+ (?:[\w<>]+\.)*?(\w+(?:\.__init__)?)\(\) parameter ", r"\1: ", message)
        message = message.replace(" violates type hint ", " must be ").replace(".__init__: ", ": ")
        super().__init__(
            re.sub(r"\b(?:typing|beartype\.vale|collections\.abc)\.|<class '(?=\w+'>)|(?<=\w)'>", "", message)
        )


_NOT_BOOL = ~IsInstance[bool, np.bool_]
_CONF = BeartypeConf(
    violation_param_type=ArgumentError,
    violation_verbosity=BeartypeViolationVerbosity.MINIMAL,
    # NumPy's numbers are numbers, True is not an integer, and NaN is not a number.
    hint_overrides=FrozenDict(
        {
            bool: Annotated[object, IsInstance[bool, np.bool_]],
            int: Annotated[Integral, _NOT_BOOL],
            float: Annotated[Real, _NOT_BOOL & Is[lambda x: x == x]],
        }
    ),
)
typed = beartype(conf=_CONF)
"""Check a function's arguments, or a dataclass's fields, by their annotations; raise :class:`ArgumentError`."""

Count = Annotated[int, Is[lambda n: n >= 1]]
Natural = Annotated[int, Is[lambda n: n >= 0]]
Scale = Annotated[float, Is[lambda x: 0 <= x < float("inf")]]
Positive = Annotated[float, Is[lambda x: 0 < x < float("inf")]]
Probability = Annotated[float, Is[lambda p: 0 <= p <= 1]]

Class = TypeVar("Class", bound=type)


def typed_fields(kind: Class) -> Class:
    """Check the fields of a dataclass by their annotations when an instance is made."""
    kind.__init__ = typed(kind.__init__)  # type: ignore[misc]
    return kind


def check_value(argument: str, value: Any, hint: Any) -> Any:
    """Return ``value``, a NumPy number as Python's, if it matches a type hint; else raise :class:`ArgumentError`."""
    if not is_bearable(value, hint, conf=_CONF):
        raise ArgumentError(f"{argument}={shown(value)} must be {hint}")
    return value.item() if isinstance(value, np.generic) else value


def check_choice(argument: str, given: Any, allowed: Iterable[str]) -> Any:
    """Return ``given`` if it is one of ``allowed``, else raise :class:`ValueError` with the nearest name."""
    names = list(allowed)
    if given not in names:
        raise unknown_name(argument, given, names)
    return given


def unknown_name(argument: str, given: object, allowed: Iterable[str]) -> ValueError:
    """The error for a name outside a fixed set, with those close in spelling; the caller raises it."""
    names = list(allowed)
    listed = ", ".join(repr(name) for name in names[:12]) + (", ..." if len(names) > 12 else "")
    message = f"{argument} must be one of {listed}, got {shown(given)}"
    if isinstance(given, str) and (close := nearest(given, names)):
        message += "; did you mean " + " or ".join(repr(name) for name in close) + "?"
    return ValueError(message)


def nearest(given: str, allowed: Iterable[str], *, n: int = 3) -> list[str]:
    """The ``n`` allowed names closest in spelling to ``given``, best first."""
    return get_close_matches(given, list(allowed), n=n, cutoff=0.4)


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """The end of an error's sentence: the allowed name closest in spelling, "" if none is close."""
    return "".join(f"; did you mean {name!r}?" for name in nearest(given, allowed, n=1))


def missing_keys(found: Iterable[Any], *needed: str) -> ValueError:
    """The error for a tensordict of the keys ``found`` that lacks one of two needed ones; the caller raises it."""
    names = [str(key) for key in found]
    absent = [key for key in needed if key not in names]
    hint = ": QAFTransform(plans) in the environment, and in the buffer, writes it" if "qaf" in absent else ""
    return ValueError(
        f"{' and '.join(needed)} are needed, got {', '.join(names)}; without {' and '.join(absent)}{hint}"
    )


def counted(number: int, noun: str) -> str:
    """A number and what it counts: "1 task", "50 tasks"."""
    return f"{number} {noun}" + "s" * (number != 1)


def differences(was: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """The names under which two nested tables differ, with both values where they are short: "steps (40, now 30)"."""
    found = []
    for key in sorted({**was, **now}):
        before, after = was.get(key), now.get(key)
        if before == after:
            continue
        if isinstance(before, Mapping) and isinstance(after, Mapping):
            found += differences(before, after, f"{inside}{key}.")
        else:
            values = f"{shown(before)}, now {shown(after)}"
            found.append(f"{inside}{key}" + (f" ({values})" if len(values) <= 60 else ""))
    return found


_SHOWN = Repr()
_SHOWN.maxlevel, _SHOWN.maxstring, _SHOWN.maxother, _SHOWN.maxlist, _SHOWN.maxtuple, _SHOWN.maxdict = 3, 80, 80, 8, 8, 8


def shown(value: object) -> str:
    """``repr`` for an error's text: short, and safe of any value, also of one nested deep or of a huge number."""
    try:
        return _SHOWN.repr(value)
    except (ValueError, RecursionError):  # a number of more digits than Python writes
        return f"a {type(value).__name__}"
