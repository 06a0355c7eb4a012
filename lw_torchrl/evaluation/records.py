"""Records of JSON files: dataclasses whose every field is checked, since no file is trusted."""

from collections.abc import Callable, Iterable
from dataclasses import fields
from reprlib import repr as short
from typing import Any

from lw_torchrl._checks import check_fields


def is_number(value: Any) -> bool:
    """Return whether JSON's value is a number that can be summed."""
    return type(value) in (int, float) and abs(value) < 1e300


def read_records(
    argument: str,
    stated: Any,
    record: Any,
    faults: Callable[[Any], Iterable[str]],
    parse: Callable[[str, dict[str, Any]], dict[str, Any]] = lambda where, entry: entry,
) -> tuple[Any, ...]:
    """Read a list of JSON objects as dataclasses.

    Each object must have exactly the fields that are compared; ``parse`` converts them, and ``faults`` yields what is
    wrong with a record, which raises :class:`ValueError`.
    """
    if not isinstance(stated, list):
        raise ValueError(f"{argument} must be a list, got {short(stated)}")
    names, records = {field.name for field in fields(record) if field.compare}, []
    for number, entry in enumerate(stated):
        where = f"{argument}[{number}]"
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(f"{where} must be an object of {', '.join(sorted(names))}, got {short(entry)}")
        records.append(record(**parse(where, entry)))
        check_fields(records[-1], f"{where}: ")
        for fault in faults(records[-1]):
            raise ValueError(f"{where}: {fault}, got {short(entry)}")
    return tuple(records)
