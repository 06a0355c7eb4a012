"""Records of JSON read with nothing taken on trust: rules say what each field must be."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from math import isfinite
from reprlib import repr as short
from typing import Any, TypeVar

Rules = Iterable[tuple[str, bool, str]]  # a field, whether it is what it must be, and what that is
Record = TypeVar("Record")


def is_number(value: Any) -> bool:
    """Whether JSON's value is a finite number."""
    return type(value) in (int, float) and abs(value) < 1e300 and isfinite(value)


def is_integer(value: Any, minimum: int, maximum: int = 2**63 - 1) -> bool:
    """Whether JSON's value is an integer of this range."""
    return type(value) is int and minimum <= value <= maximum


def check_rules(argument: str, values: Mapping[str, Any], rules: Rules) -> None:
    """Raise :class:`ValueError` for the first value that is not what its rule says."""
    for name, holds, wanted in rules:
        if not holds:
            raise ValueError(f"{argument}: {name} must be {wanted}, got {short(values[name])}")


def read_records(
    argument: str, stated: Any, record: Callable[..., Record], rules: Callable[[Record], Rules]
) -> tuple[Record, ...]:
    """A list of objects as dataclasses, whose fields that are compared each must have."""
    if not isinstance(stated, list):
        raise ValueError(f"{argument} must be a list, got {short(stated)}")
    names = {field.name for field in fields(record) if field.compare}  # type: ignore[arg-type]
    found = []
    for number, entry in enumerate(stated):
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(
                f"{argument}[{number}] must be an object of {', '.join(sorted(names))}, got {short(entry)}"
            )
        found.append(record(**entry))
        check_rules(f"{argument}[{number}]", entry, rules(found[-1]))
    return tuple(found)
