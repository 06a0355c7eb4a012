"""Checks of arguments, shared by every room: the error names the argument, what was given and what is allowed."""

import functools
import inspect
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from difflib import get_close_matches
from fractions import Fraction
from numbers import Integral, Real
from reprlib import Repr
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

Function = TypeVar("Function", bound=Callable[..., Any])


def nearest(given: str, allowed: Iterable[str], *, n: int = 3) -> list[str]:
    """The ``n`` allowed names closest in spelling to ``given``, best first."""
    return get_close_matches(given, list(allowed), n=n, cutoff=0.4)


def unknown_name(argument: str, given: object, allowed: Iterable[str]) -> ValueError:
    """The error for a name outside a fixed set, with those close in spelling; the caller raises it."""
    names = list(allowed)
    listed = ", ".join(repr(name) for name in names[:12]) + (", ..." if len(names) > 12 else "")
    message = f"{argument} must be one of {listed}, got {shown(given)}"
    if isinstance(given, str) and (close := nearest(given, names)):
        message += "; did you mean " + " or ".join(repr(name) for name in close) + "?"
    return ValueError(message)


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


def missing_keys(found: Iterable[Any], *needed: str) -> ValueError:
    """The error for a tensordict of the keys ``found`` that lacks one of two needed ones; the caller raises it."""
    names = [str(key) for key in found]
    absent = [key for key in needed if key not in names]
    hint = ": QAFTransform(plans) in the environment, and in the buffer, writes it" if "qaf" in absent else ""
    return ValueError(
        f"{' and '.join(needed)} are needed, got {', '.join(names)}; without {' and '.join(absent)}{hint}"
    )


def check_choice(argument: str, given: Any, allowed: Iterable[str]) -> Any:
    """Return ``given`` if it is one of ``allowed``, else raise :class:`ValueError` with the nearest name."""
    names = list(allowed)
    if given not in names:
        raise unknown_name(argument, given, names)
    return given


def _wrong_type(argument: str, wanted: str, given: Any) -> TypeError:
    return TypeError(f"{argument} must be {wanted}, got {shown(given)} ({type(given).__name__})")


def check_int(argument: str, given: Any, *, minimum: int | None = None) -> int:
    """Return ``given`` as an int of at least ``minimum``; :class:`TypeError` for another type."""
    if isinstance(given, bool) or not hasattr(given, "__index__"):
        raise _wrong_type(argument, "an integer", given)
    value = int(given.__index__())
    if minimum is not None and value < minimum:
        raise ValueError(f"{argument} must be at least {minimum}, got {value}")
    return value


def check_flag(argument: str, given: Any) -> bool:
    """Return ``given`` if it is True or False, NumPy's included; :class:`TypeError` otherwise."""
    if type(given).__name__ not in ("bool", "bool_"):
        raise _wrong_type(argument, "True or False", given)
    return bool(given)


def check_text(argument: str, given: Any) -> None:
    """Raise :class:`TypeError` unless ``given`` is a string."""
    if not isinstance(given, str):
        raise _wrong_type(argument, "a string", given)


def check_path(argument: str, given: Any) -> None:
    """Raise :class:`TypeError` unless ``given`` is a path."""
    if not isinstance(given, (str, os.PathLike)):
        raise _wrong_type(argument, "a path", given)


def _check_real(argument: str, given: Any) -> None:
    if isinstance(given, bool) or not isinstance(given, Real):
        raise _wrong_type(argument, "a number", given)
    if given != given:
        raise ValueError(f"{argument} must be finite, got nan")


def check_scale(argument: str, given: Any) -> float:
    """Return ``given`` as a finite float of at least 0."""
    _check_real(argument, given)
    try:
        value = float(given)
    except OverflowError:
        value = math.inf
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{argument} must be finite and at least 0, got {shown(given)}")
    if value != given:
        raise ValueError(f"{argument} must be a number of double precision, got {shown(given)}")
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


Check = Callable[[str, Any], object]
Count = Annotated[int, functools.partial(check_int, minimum=1)]  # Annotations that say more of a number: at least 1,
Natural = Annotated[int, functools.partial(check_int, minimum=0)]  # at least 0,
Scale = Annotated[float, check_scale]  # finite and at least 0,
Positive = Annotated[float, check_positive]  # finite and above 0,
Probability = Annotated[float, check_probability]  # from 0 to 1.

_PLAIN: dict[Any, Check] = {bool: check_flag, int: check_int, float: _check_real, str: check_text}
_PLAIN_KINDS = {*_PLAIN, Annotated, Literal, os.PathLike, NoneType}
_SEVERAL: dict[Any, tuple[type, str]] = {
    int: (Integral, "an integer"),
    float: (Real, "a number"),
    str: (str, "a string"),
    os.PathLike: (os.PathLike, "a path"),
    Fraction: (Fraction, "a fraction"),
    Mapping: (Mapping, "a mapping"),
    **dict.fromkeys((Sequence, Iterable, list, tuple), (Iterable, "a list")),
}


def _resolved(annotation: object, names: dict[str, Any]) -> Any:
    """What an annotation means, whose names stand in ``names``."""
    try:
        return eval(annotation, names) if isinstance(annotation, str) else annotation
    except (NameError, AttributeError, TypeError):  # imported for type checkers alone, or no type
        return Any


def _check_of_type(found: Any) -> Check | None:
    """The check of a type: of a class, a Literal, a function, or a collection of these."""
    origin, inside = get_origin(found) or found, get_args(found)
    if origin is Annotated:
        return inside[1]
    if origin in (Union, UnionType):
        others = [one for one in inside if one is not NoneType]
        origins = [get_origin(one) for one in others]
        if str not in others and Callable in origins and Literal not in origins:
            others = [Callable]  # a module is called too
        if len(others) == 1:
            check = _check_of_type(others[0])
        elif {*origins, *others} == {None, os.PathLike, str, os.PathLike[str]}:
            check = check_path
        else:
            kinds = {_SEVERAL.get(get_origin(one) or one): None for one in others}
            check = None if None in kinds else functools.partial(_check_kinds, kinds)
        return _or_none(check) if NoneType in inside else check
    if origin is Literal:
        return functools.partial(check_choice, allowed=inside)
    protocol = getattr(origin, "_is_protocol", False)
    if origin is Callable or (protocol and "__call__" in vars(origin)):
        return _check_function
    if origin in (Mapping, Sequence, Iterable):
        held = _check_of_type(inside[-1]) if isinstance(inside[-1], type) else None
        return held and functools.partial(_check_collection, origin, held)  # of the others the function tells more
    if not isinstance(origin, type) or origin in (tuple, object, Any) or protocol or origin.__name__ == "NestedKey":
        return None
    return _PLAIN.get(origin) or functools.partial(_check_class, origin)


def _or_none(check: Check | None) -> Check | None:
    return check and (lambda argument, given: None if given is None else check(argument, given))


def _check_kinds(kinds: Iterable[Any], argument: str, given: Any) -> None:
    """Check that a value is of one of several kinds; its function checks what it holds."""
    taken = tuple(kind for kind, _ in kinds)
    text = isinstance(given, (str, bytes)) and not (str in taken and isinstance(given, str))
    if text or not isinstance(given, taken):
        raise _wrong_type(argument, " or ".join(word for _, word in kinds), given)


def _check_function(argument: str, given: Any) -> None:
    if not callable(given):
        raise _wrong_type(argument, "a function", given)


def _check_class(wanted: type, argument: str, given: Any) -> None:
    if not isinstance(given, wanted):
        what = f"the class {given.__name__}" if isinstance(given, type) else f"{shown(given)} ({type(given).__name__})"
        article = "an" if wanted.__name__[0] in "AEIOU" else "a"
        raise TypeError(f"{argument} must be {article} {wanted.__name__}, got {what}")


def _check_collection(wanted: Any, check: Check, argument: str, given: Any) -> None:
    """Check a collection, and what it holds unless it can be iterated only once."""
    of_texts = isinstance(given, (str, bytes))
    right = isinstance(given, Mapping) if wanted is Mapping else hasattr(given, "__iter__") and not of_texts
    if not right or isinstance(given, type):
        raise _wrong_type(argument, "a mapping" if wanted is Mapping else "a list", given)
    if isinstance(given, (Mapping, Sequence)):
        for place, one in given.items() if isinstance(given, Mapping) else enumerate(given):
            check(f"{argument}[{shown(place)}]", one)


def checked_but(*arguments: str) -> Callable[[Function], Function]:
    """Check a function's arguments, but for those named, by their annotations: flags, numbers, texts, paths, choices,
    classes, functions, and collections of these. The function itself checks what may be a name or a :class:`Task`, for
    example; :class:`TypeError` or :class:`ValueError` name the argument, what was given and what is allowed.

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
        def checks() -> dict[str, Check]:  # at the first call: by then all names of the annotations are there
            found = {
                name: _check_of_type(_resolved(one.annotation, function.__globals__))
                for name, one in signature.parameters.items()
                if name not in arguments
                and one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)
                and one.annotation is not one.empty
            }
            return {name: check for name, check in found.items() if check is not None}

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            try:
                given = signature.bind_partial(*args, **kwargs).arguments
            except TypeError:
                given = {}  # the function itself says which argument is unknown or too many
            for name, check in checks().items():
                if name in given:
                    check(name, given[name])
            return function(*args, **kwargs)

        return call  # type: ignore[return-value]

    return decorate


checked = checked_but()  # all of a function's arguments


def passes_on(*others: Callable[..., Any]) -> Callable[[Function], Function]:
    """Say which ``**options`` a function takes: the keyword arguments of the functions that it hands them to.

    ``help`` and editors show them, and any other is a :class:`TypeError` that names the nearest.
    """

    def decorate(function: Function) -> Function:
        signature = inspect.signature(function)
        taken = {name: one for name, one in signature.parameters.items() if one.kind is not one.VAR_KEYWORD}
        for other in others:
            for name, one in inspect.signature(other).parameters.items():
                if one.kind is one.KEYWORD_ONLY:
                    taken.setdefault(name, one)

        @functools.wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            for name in kwargs:
                if name not in taken:
                    names = [known for known, one in taken.items() if one.kind is one.KEYWORD_ONLY]
                    of = function.__qualname__.removesuffix(".__init__")
                    raise TypeError(f"{of}: {unknown_name('argument', name, names)}")
            return function(*args, **kwargs)

        call.__signature__ = signature.replace(parameters=[*taken.values()])  # type: ignore[attr-defined]
        return call  # type: ignore[return-value]

    return decorate


def check_fields(instance: Any, inside: str = "") -> None:
    """Check the plain fields of a dataclass as :func:`checked` does arguments; errors begin with ``inside``."""
    kind: Any = type(instance)
    for name, check in _checks_of_fields(kind).items():
        check(inside + name, getattr(instance, name))


@functools.cache
def _checks_of_fields(kind: Any) -> dict[str, Check]:
    """The checks of a dataclass's flags, numbers, texts and choices."""
    found: dict[str, Check | None] = {}
    for base in reversed(kind.__mro__):
        names = getattr(sys.modules.get(base.__module__), "__dict__", {})  # of the module that it stands in
        for name, stated in inspect.get_annotations(base).items():
            meant = _resolved(stated, names)
            parts = get_args(meant) if get_origin(meant) in (Union, UnionType) else [meant]
            plain = all((get_origin(part) or part) in _PLAIN_KINDS for part in parts)
            found[name] = _check_of_type(meant) if plain else None
    return {field.name: check for field in fields(kind) if (check := found[field.name])}


_SHOWN = Repr()
_SHOWN.maxlevel, _SHOWN.maxstring, _SHOWN.maxother, _SHOWN.maxlist, _SHOWN.maxtuple, _SHOWN.maxdict = 3, 80, 80, 8, 8, 8


def shown(value: object) -> str:
    """``repr`` for an error's text: short, and safe of any value, also of one nested deep or of a huge number."""
    try:
        return _SHOWN.repr(value)
    except (ValueError, RecursionError):  # a number of more digits than Python writes
        return f"a {type(value).__name__}"
