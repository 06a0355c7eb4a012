"""Checks of arguments, shared by every room: the error names the argument, what was given and what is allowed."""

import functools
import inspect
import math
import operator
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from difflib import get_close_matches
from numbers import Integral, Real
from reprlib import Repr
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

Function = TypeVar("Function", bound=Callable[..., Any])


def nearest(given: str, allowed: Iterable[str], *, n: int = 3) -> list[str]:
    """The ``n`` allowed names closest in spelling to ``given``, best first."""
    return get_close_matches(given, list(allowed), n=n, cutoff=0.4)


def did_you_mean(given: str, allowed: Iterable[str]) -> str:
    """The end of an error's sentence: the allowed name closest in spelling, "" if none is close."""
    return "".join(f"; did you mean {name!r}?" for name in nearest(given, allowed, n=1))


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


def _check_class(argument: str, given: Any, classes: tuple[type, ...], wanted: str) -> None:
    if not isinstance(given, classes):
        raise _wrong_type(argument, wanted, given)


check_text = functools.partial(_check_class, classes=(str,), wanted="a string")
check_path = functools.partial(_check_class, classes=(str, os.PathLike), wanted="a path")


def _check_real(argument: str, given: Any) -> float | None:
    if isinstance(given, bool) or not isinstance(given, Real):
        raise _wrong_type(argument, "a number", given)
    if given != given:
        raise ValueError(f"{argument} must be finite, got nan")
    return None if isinstance(given, int) else float(given)  # a large integer stays one


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


def _check_of(annotation: Any, classes: bool = True) -> Check | None:
    """Return the function that checks values against an annotation, or None if values are not checked."""
    origin, inside = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return inside[1]
    if origin is Literal:
        return functools.partial(check_choice, allowed=inside)
    if origin in (Union, UnionType):
        first, *more = {part for part in inside if part is not NoneType}
        if {first, *more} == {str, os.PathLike[str]}:
            check: Check | None = check_path
        elif more:
            return _check_of_class(annotation) if classes else None
        else:
            check = _check_of(first, classes)
        if check is not None and NoneType in inside:
            return lambda argument, given: None if given is None else check(argument, given)
        return check
    return _PLAIN.get(annotation) or (_check_of_class(annotation) if classes else None)


@functools.cache
def _matcher() -> Callable[[object, Any], bool]:
    """Return beartype's check of a value, which takes numbers of other libraries too. Importing it takes 0.1 s."""
    from beartype import BeartypeConf, FrozenDict
    from beartype.door import is_bearable

    return functools.partial(is_bearable, conf=BeartypeConf(hint_overrides=FrozenDict({float: Real, int: Integral})))


def _check_of_class(annotation: Any) -> Check | None:
    """Return the check of a class, function or collection; None for what cannot be checked."""
    origin, inside = get_origin(annotation) or annotation, get_args(annotation)
    if getattr(origin, "_is_protocol", False):
        return _check_of_class(Callable) if "__call__" in vars(origin) else None
    names_are_checked_inside = any(get_origin(part) is Literal for part in inside)
    anything = annotation in (Any, object, inspect.Parameter.empty) or isinstance(annotation, TypeVar)
    if anything or names_are_checked_inside:
        return None
    if any(not isinstance(part, type) or part.__name__ == "NestedKey" for part in inside):
        annotation = _without_contents(annotation)  # the function checks the elements itself

    def check(argument: str, given: Any) -> None:
        if not _matcher()(given, annotation):
            if isinstance(given, type):
                raise TypeError(f"{argument} must be {_words(annotation)}, got the class {given.__name__}")
            raise _wrong_type(argument, _words(annotation), given)

    return check


def _without_contents(annotation: Any) -> Any:
    """Return an annotation that says nothing of what collections hold and functions take."""
    origin, inside = get_origin(annotation), get_args(annotation)
    if origin in (Union, UnionType):
        return functools.reduce(operator.or_, map(_without_contents, inside))
    return _without_contents(inside[0]) if origin is Annotated else origin or annotation


def _words(annotation: Any) -> str:
    """Return an annotation in words: "a Suite, a path or None"."""
    origin, inside = get_origin(annotation) or annotation, get_args(annotation)
    if origin in (Union, UnionType):
        *others, last = dict.fromkeys(_words(part) for part in inside)
        return f"{', '.join(others)} or {last}" if others else last
    if annotation is NoneType or annotation is None:
        return "None"
    if origin is Annotated or origin is Literal:
        return _words(inside[0]) if origin is Annotated else " or ".join(map(repr, inside))
    named = {int: "an integer", float: "a number", str: "a string", os.PathLike: "a path", Callable: "a function"}
    named |= {Mapping: "a mapping", dict: "a mapping"} | dict.fromkeys((Sequence, Iterable, list, tuple), "a list")
    if origin in named:
        return named[origin]
    name = getattr(origin, "__name__", str(origin))
    return f"{'an' if name[0] in 'AEIOU' else 'a'} {name}"


def _checks_of(annotations: Mapping[str, Any], names: dict[str, Any], classes: bool = True) -> dict[str, Check]:
    """Return the checks of annotations, by name; ``names`` are those of the module that they stand in."""
    checks = {}
    for name, annotation in annotations.items():
        with suppress(NameError, AttributeError, TypeError):  # imported only for type checkers
            checks[name] = _check_of(eval(annotation, names) if isinstance(annotation, str) else annotation, classes)
    return {name: check for name, check in checks.items() if check is not None}


def checked(function: Function) -> Function:
    """Check a function's flags, numbers, texts, paths, choices and ranges by their annotations.

    :class:`TypeError` or :class:`ValueError` name the argument, what was given and what is allowed.

    Example:
        >>> @checked
        ... def draw(points: int, filled: bool = False): ...
        >>> draw(3, filled="no")
        Traceback (most recent call last):
        TypeError: filled must be True or False, got 'no' (str)
    """
    signature = inspect.signature(function)
    single = [one for one in signature.parameters.values() if one.kind not in (one.VAR_POSITIONAL, one.VAR_KEYWORD)]
    annotations = {one.name: one.annotation for one in single}

    @functools.cache
    def checks() -> dict[str, Check]:  # at the first call: by then the module has all names of the annotations
        return _checks_of(annotations, function.__globals__)

    @functools.wraps(function)
    def call(*args: Any, **kwargs: Any) -> Any:
        try:
            given = signature.bind_partial(*args, **kwargs).arguments
        except TypeError:
            given = {}  # the function itself says which argument is unknown or too many
        plain = {name: check(name, given[name]) for name, check in checks().items() if name in given}
        plain = {name: value for name, value in plain.items() if _is_other_number(given[name], value)}
        if plain:
            bound = signature.bind(*args, **kwargs)
            bound.arguments.update(plain)
            return function(*bound.args, **bound.kwargs)
        return function(*args, **kwargs)

    return call  # type: ignore[return-value]


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
        given = getattr(instance, name)
        value = check(inside + name, given)
        if _is_other_number(given, value):
            object.__setattr__(instance, name, value)


def _is_other_number(given: Any, value: Any) -> bool:
    """Return whether ``value`` is Python's number for ``given``, a number of another library, which JSON lacks."""
    return type(value) in (bool, int, float) and type(given) not in (bool, int, float)


@functools.cache
def _checks_of_fields(kind: Any) -> dict[str, Check]:
    checks: dict[str, Check] = {}
    for base in reversed(kind.__mro__):
        names = getattr(sys.modules.get(base.__module__), "__dict__", {})
        # Without classes: a __post_init__ converts some fields, PlanStep's condition from a text for one.
        checks |= _checks_of(inspect.get_annotations(base), names, classes=False)
    return {field.name: checks[field.name] for field in fields(kind) if field.name in checks}


_SHOWN = Repr()
_SHOWN.maxlevel, _SHOWN.maxstring, _SHOWN.maxother, _SHOWN.maxlist, _SHOWN.maxtuple, _SHOWN.maxdict = 3, 80, 80, 8, 8, 8


def shown(value: object) -> str:
    """``repr`` for an error's text: short, and safe of any value, also of one nested deep or of a huge number."""
    try:
        return _SHOWN.repr(value)
    except (ValueError, RecursionError):  # a number of more digits than Python writes
        return f"a {type(value).__name__}"
