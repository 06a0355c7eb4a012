"""Checks of arguments, shared by every room: the error names the argument, what was given and what is allowed."""

from __future__ import annotations

import ast
import functools
import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from fractions import Fraction
from numbers import Integral, Real
from reprlib import Repr
from types import NoneType, UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin

Function = TypeVar("Function", bound=Callable[..., Any])


def nearest(given: str, allowed: Iterable[str], *, n: int = 3) -> list[str]:
    """The ``n`` allowed names closest in spelling to ``given``, best first."""
    return get_close_matches(given, list(allowed), n=n, cutoff=0.4)


def unknown_name(argument: str, given: object, allowed: Iterable[str]) -> ValueError:
    """The error for a name outside a fixed set; the caller raises it.

    Example:
        >>> str(unknown_name("mix", "latent", ["latents", "actions"]))
        "mix must be one of 'latents', 'actions', got 'latent'; did you mean 'latents' or 'actions'?"
    """
    names = list(allowed)
    listed = ", ".join(repr(name) for name in names[:12]) + (", ..." if len(names) > 12 else "")
    message = f"{argument} must be one of {listed}, got {shown(given)}"
    if isinstance(given, str) and (close := nearest(given, names)):
        message += "; did you mean " + " or ".join(repr(name) for name in close) + "?"
    return ValueError(message)


def counted(number: int, noun: str) -> str:
    """A number and what it counts.

    Example:
        >>> counted(1, "task"), counted(50, "task")
        ('1 task', '50 tasks')
    """
    return f"{number} {noun}" + "s" * (number != 1)


def differences(was: Mapping[str, Any], now: Mapping[str, Any], inside: str = "") -> list[str]:
    """The names under which two nested tables differ, with both values where they are short.

    Example:
        >>> differences({"steps": 40, "options": {"width": 8}}, {"steps": 30, "options": {"width": 8}, "seed": 1})
        ['seed (None, now 1)', 'steps (40, now 30)']
    """
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


def missing_keys(found: Iterable[Any], *needed: str) -> ValueError:
    """The error for a tensordict of the keys ``found`` that lacks one of two needed ones; the caller raises it."""
    names = [str(key) for key in found]
    absent = [key for key in needed if key not in names]
    hint = ": QAFTransform(plans) in the environment, and in the buffer, writes it" if "qaf" in absent else ""
    if "qaf_held_logits" in absent:
        hint = ": HeldEvaluator.transform() writes it in an environment; rows without steps train what it holds"
    return ValueError(
        f"{' and '.join(needed)} are needed, got {', '.join(names)}; without {' and '.join(absent)}{hint}"
    )


def check_choice(argument: str, given: Any, allowed: Iterable[str]) -> Any:
    """Return ``given`` if it is one of ``allowed``, else raise :class:`ValueError` with the nearest name."""
    names = list(allowed)
    if given not in names:
        raise unknown_name(argument, given, names)
    return given


def check_int(argument: str, given: Any, *, minimum: int | None = None) -> int:
    """Return ``given`` as an int of at least ``minimum``; :class:`TypeError` for another type."""
    if isinstance(given, bool) or not hasattr(given, "__index__"):
        raise TypeError(f"{argument} must be an integer, got {given!r} ({type(given).__name__})")
    value = int(given.__index__())
    if minimum is not None and value < minimum:
        raise ValueError(f"{argument} must be at least {minimum}, got {value}")
    return value


def check_flag(argument: str, given: Any) -> bool:
    """Return ``given`` if it is True or False, NumPy's included; :class:`TypeError` otherwise."""
    if type(given).__name__ not in ("bool", "bool_"):
        raise TypeError(f"{argument} must be True or False, got {shown(given)} ({type(given).__name__})")
    return bool(given)


def _check_real(argument: str, given: Any) -> None:
    if isinstance(given, bool) or not isinstance(given, Real):
        raise TypeError(f"{argument} must be a number, got {shown(given)} ({type(given).__name__})")
    if given != given:
        raise ValueError(f"{argument} must be finite, got nan")


def check_text(argument: str, given: Any) -> None:
    """Raise :class:`TypeError` unless ``given`` is a string."""
    if not isinstance(given, str):
        raise TypeError(f"{argument} must be a string, got {shown(given)} ({type(given).__name__})")


def check_path(argument: str, given: Any) -> None:
    """Raise :class:`TypeError` unless ``given`` is a path."""
    if not isinstance(given, (str, os.PathLike)):
        raise TypeError(f"{argument} must be a path, got {shown(given)} ({type(given).__name__})")


_LITERAL = re.compile(r"Literal\[([^\[\]]*)\]")
_KINDS: dict[str, Callable[[str, Any], object]] = {
    "bool": check_flag,
    "int": check_int,
    "float": _check_real,
    "str": check_text,
    "str | os.PathLike[str]": check_path,
}


Check = Callable[[str, Any], object]


def _plain_rule(annotation: object) -> Check | None:
    """What checks a value of a plain annotation: a kind of :data:`_KINDS` or a Literal, or one of them or None."""
    return _plain_rule_of(annotation if isinstance(annotation, str) else getattr(annotation, "__name__", ""))


@functools.cache
def _plain_rule_of(plain: str) -> Check | None:
    optional, plain = plain.endswith(" | None"), plain.removesuffix(" | None")
    check = _KINDS.get(plain)
    if choices := _LITERAL.fullmatch(plain):
        check = functools.partial(_check_literal, ast.literal_eval(f"({choices[1]},)"))
    return _or_none(check) if optional else check


def _rule(annotation: object, names: dict[str, Any]) -> Check | None:
    """What checks a value of an annotation, whose names stand in ``names``; None for what its function checks."""
    if (plain := _plain_rule(annotation)) is not None:
        return plain
    try:
        found = eval(annotation, names) if isinstance(annotation, str) else annotation
    except NameError:  # imported for type checkers alone
        return None
    return _rule_of(found)


def _rule_of(found: Any) -> Check | None:
    """What checks a value of a type: of a class, a Literal, a function, or a collection of these."""
    origin, inside = get_origin(found) or found, get_args(found)
    if origin in (Union, UnionType):
        others = [one for one in inside if one is not NoneType]
        origins = [get_origin(one) for one in others]
        if str not in others and Callable in origins and Literal not in origins:
            others = [Callable]  # a module is called too
        if len(others) == 1:
            check = _rule_of(others[0])
        else:
            kinds = {_SEVERAL.get(get_origin(one) or one): None for one in others}
            check = None if None in kinds else functools.partial(_check_kinds, kinds)
        return _or_none(check) if NoneType in inside else check
    if origin is Literal:
        return functools.partial(_check_literal, inside)
    protocol = getattr(origin, "_is_protocol", False)
    if origin is Callable or (protocol and "__call__" in vars(origin)):
        return _check_function
    if origin in (Mapping, Sequence, Iterable):
        held = _rule_of(inside[-1]) if isinstance(inside[-1], type) else None
        return held and functools.partial(_check_collection, origin, held)  # of the others the function tells more
    if not isinstance(origin, type) or origin in (tuple, object, Any) or protocol or origin.__name__ == "NestedKey":
        return None
    return _KINDS.get(found.__name__) or functools.partial(_check_class, origin)


_SEVERAL: dict[Any, tuple[type, str]] = {
    int: (Integral, "an integer"),
    float: (Real, "a number"),
    str: (str, "a string"),
    os.PathLike: (os.PathLike, "a path"),
    Fraction: (Fraction, "a fraction"),
    Mapping: (Mapping, "a mapping"),
    **dict.fromkeys((Sequence, Iterable, list, tuple), (Iterable, "a list")),
}


def _check_kinds(kinds: Iterable[Any], argument: str, given: Any) -> None:
    """Check that a value is of one of several kinds; what it holds, its function checks."""
    taken = tuple(kind for kind, _ in kinds)
    text = isinstance(given, (str, bytes)) and not (str in taken and isinstance(given, str))
    if text or not isinstance(given, taken):
        allowed = " or ".join(word for _, word in kinds)
        raise TypeError(f"{argument} must be {allowed}, got {shown(given)} ({type(given).__name__})")


def _or_none(check: Check | None) -> Check | None:
    return check and (lambda argument, given: None if given is None else check(argument, given))


def _check_literal(allowed: tuple[str, ...], argument: str, given: Any) -> None:
    check_choice(argument, given, allowed)


def _check_function(argument: str, given: Any) -> None:
    if not callable(given):
        raise TypeError(f"{argument} must be a function, got {shown(given)} ({type(given).__name__})")


def _check_class(wanted: type, argument: str, given: Any) -> None:
    if not isinstance(given, wanted):
        what = f"the class {given.__name__}" if isinstance(given, type) else f"{shown(given)} ({type(given).__name__})"
        article = "an" if wanted.__name__[0] in "AEIOU" else "a"
        raise TypeError(f"{argument} must be {article} {wanted.__name__}, got {what}")


def _check_collection(wanted: Any, check: Check, argument: str, given: Any) -> None:
    """Check a collection, and what it holds unless it can be gone through once only."""
    of_texts = isinstance(given, (str, bytes))
    right = isinstance(given, Mapping) if wanted is Mapping else hasattr(given, "__iter__") and not of_texts
    if not right or isinstance(given, type):
        kind = "mapping" if wanted is Mapping else "list"
        raise TypeError(f"{argument} must be a {kind}, got {shown(given)} ({type(given).__name__})")
    if isinstance(given, (Mapping, Sequence)):
        for place, one in given.items() if isinstance(given, Mapping) else enumerate(given):
            check(f"{argument}[{shown(place)}]", one)


def checked(function: Function) -> Function:
    """Check a function's arguments by their annotations, see :func:`checked_but`."""
    return checked_but()(function)


def checked_but(*arguments: str) -> Callable[[Function], Function]:
    """Check a function's arguments by their annotations: flags, numbers, texts, paths, choices, classes, functions, and
    collections of these. What may be of several kinds, a name or a :class:`Task` say, the function checks itself.

    Args:
        *arguments: names of those of which the function itself says more.

    Raises:
        TypeError, ValueError: when the function is called; it names the argument, what was given and what is allowed.

    Example:
        >>> @checked_but("color")
        ... def draw(points: int, filled: bool = False, color: str = "red"): ...
        >>> draw(3, filled="no")
        Traceback (most recent call last):
        TypeError: filled must be True or False, got 'no' (str)
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)

        @functools.cache
        def rules() -> dict[str, Check]:  # at the first call: by then all names of the annotations are there
            found = {
                name: _rule(one.annotation, function.__globals__)
                for name, one in signature.parameters.items()
                if name not in arguments
                and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
                and one.annotation is not one.empty
            }
            return {name: rule for name, rule in found.items() if rule is not None}

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            try:
                given = signature.bind_partial(*args, **kwargs).arguments
            except TypeError:
                given = {}  # the function itself says which argument is unknown or too many
            for name, check in rules().items():
                if name in given:
                    check(name, given[name])
            return function(*args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


def check_fields(instance: Any, inside: str = "") -> None:
    """Check the plain fields of a dataclass as :func:`checked` does arguments; errors begin with ``inside``."""
    for field in fields(instance):
        if (rule := _plain_rule(str(field.type))) is not None:
            rule(inside + field.name, getattr(instance, field.name))


def check_scale(argument: str, given: Any) -> float:
    """Return ``given`` as a finite float of at least 0."""
    if isinstance(given, bool) or not isinstance(given, Real):
        raise TypeError(f"{argument} must be a number, got {given!r} ({type(given).__name__})")
    try:
        value = float(given)
    except OverflowError:
        value = math.inf
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{argument} must be finite and at least 0, got {given!r}")
    if value != given:
        raise ValueError(f"{argument} must be a number of double precision, got {given!r}")
    return value


def check_positive(argument: str, given: Any) -> float:
    """Return ``given`` as a finite float above 0."""
    if (value := check_scale(argument, given)) == 0.0:
        raise ValueError(f"{argument} must be above 0, got {given!r}")
    return value


def check_probability(argument: str, given: Any) -> float:
    """Return ``given`` as a float from 0 to 1."""
    if (value := check_scale(argument, given)) > 1.0:
        raise ValueError(f"{argument} must be from 0 to 1, got {given}")
    return value


_SHOWN = Repr()
_SHOWN.maxlevel, _SHOWN.maxstring, _SHOWN.maxother, _SHOWN.maxlist, _SHOWN.maxtuple, _SHOWN.maxdict = 3, 80, 80, 8, 8, 8


def shown(value: object) -> str:
    """``repr`` for an error's text: short, and safe of any value, also of one nested deep or of a huge number.

    Example:
        >>> shown([0.1, "obs[37]", 10**5000])
        'a list'
    """
    try:
        return _SHOWN.repr(value)
    except (ValueError, RecursionError):  # a number of more digits than Python writes
        return f"a {type(value).__name__}"
