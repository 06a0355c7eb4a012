"""Checks of arguments, shared by every room: the error names the argument, what was given and what is allowed."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from reprlib import Repr
from typing import Any


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


def check_scale(argument: str, given: Any) -> float:
    """Return ``given`` as a finite float of at least 0."""
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        raise TypeError(f"{argument} must be a number, got {given!r} ({type(given).__name__})")
    if not 0.0 <= given <= sys.float_info.max:
        raise ValueError(f"{argument} must be finite and at least 0, got {given!r}")
    if float(given) != given:
        raise ValueError(f"{argument} must be a number of double precision, got {given!r}")
    return float(given)


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
