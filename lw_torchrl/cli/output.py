"""What a command prints: tables, plain columns in a pipe or one JSON document; and streams that it can print to."""

from __future__ import annotations

import json
import math
import os
import select
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import lw_torchrl as lw
from lw_torchrl._checks import counted

BROKEN_PIPE = 141  # what a shell reports of a program that a closed pipe ended
Row = Mapping[str, Any]
Columns = Mapping[str, str | Callable[[Row], Any]]
"""Heading to the name of what stands in a row, or to a function of the row."""


class Output:
    """Prints what is found as text, or gathers it for a JSON document; ``fault``, if any, then ends the command.

    Example:
        >>> columns = {"task": "task", "episodes": "run"}
        >>> _ = Output(as_json=False).table("tasks", [{"task": "push", "run": 3}], columns)
        task  episodes
        push  3
        >>> Output(as_json=True).show("rate", float("nan"), "no rate").document()
        '{\\n  "rate": null\\n}'
    """

    def __init__(self, as_json: bool) -> None:
        self.as_json, self.fault = as_json, ""
        self._found: dict[str, Any] = {}

    def show(self, key: str, value: Any, text: str | None = None) -> Output:
        """Print ``text``, if there is any, or keep the value under the key; returns itself, as the others do."""
        if self.as_json:
            self._found[key] = value
        elif text is not None:
            print(text)
        return self

    def table(self, key: str, rows: Sequence[Row], columns: Columns, title: str = "") -> Output:
        """Print rows as a table of these columns, or keep them under the key."""
        if self.as_json:
            return self.show(key, [dict(row) for row in rows])
        cells = [[_cell(row[of] if isinstance(of, str) else of(row)) for of in columns.values()] for row in rows]
        (_on_terminal if sys.stdout.isatty() else _in_pipe)(title, [*columns], cells)
        return self

    def result(self, found: lw.EvaluationResult, **more: Mapping[str, Any]) -> Output:
        """Print an evaluation's table, or keep its numbers under "tasks", with more of each, and its configuration."""
        rates = ("success_once", "success_at_end", "first_success", "mean_return")
        columns = {name: getattr(found, name) for name in rates} | more
        rows = [{"task": task, **{name: of[task] for name, of in columns.items()}} for task in found.config["tasks"]]
        self.show("tasks", rows, found.table()).show("mean_success", found.mean_success)
        return self.show("config", found.config)

    def notes(self, found: Iterable[str]) -> None:
        """Print what is noted of answers, the most frequent first, or keep it under "notes"."""
        noted = Counter(found).most_common()
        self.show("notes", [{"note": note, "answers": times} for note, times in noted])
        for note, times in noted:
            print(f"{counted(times, 'answer')}: {note}")

    def document(self) -> str:
        """All that was kept, as JSON: what is no finite number is null, a path a text."""
        return json.dumps(_plain(self._found), indent=2, allow_nan=False)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, int)) else str(value)


def _cell(value: Any) -> str:
    return "" if value is None or value is False else "yes" if value is True else str(value)


def _in_pipe(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Columns as wide as their cells, whatever the terminal; no padding behind the last."""
    lines = [headings, *rows]
    widths = [max(len(line[column]) for line in lines) for column in range(len(headings))]
    found = [f"{title}\n"] if title else []
    for line in lines:
        found.append("  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip())
    sys.stdout.write("\n".join([*found, ""]))  # at once, for who reads the first line alone


def _on_terminal(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """As wide as the terminal; the first column is never wrapped."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    class Printer(Console):
        def on_broken_pipe(self) -> None:  # rich's own exits with status 1
            raise

    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, no_wrap=number == 0)
    for row in rows:
        table.add_row(*row)
    Printer(highlight=False, markup=False).print(table)


def complain(message: str) -> None:
    """Print to the standard error, if it can be written to."""
    with suppress(OSError):
        print(message, file=sys.stderr, flush=True)


def nobody_reads() -> bool:
    """Whether the standard output or error is a pipe whose other end is closed."""
    poll = select.poll()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # under a test's capture they have no number
            poll.register(stream.fileno(), 0)
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in poll.poll(0))


@contextmanager
def sound_streams() -> Iterator[None]:
    """Within the block there are streams to print to; where nobody reads, the program ends quietly, with 141."""
    # In this order, since an opened file gets the lowest free number: nothing of ours is opened as 1 or 2.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    for stream in (sys.stdout, sys.stderr):
        if getattr(stream, "errors", None) in ("strict", "surrogateescape"):  # the latter in the C locale
            stream.reconfigure(errors="replace")  # type: ignore[union-attr]
    try:
        yield
    except BrokenPipeError:
        if not nobody_reads():
            raise
        sys.exit(BROKEN_PIPE)
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:  # what cannot be printed is dropped, else the interpreter fails at its end
                with open(os.devnull, "w", encoding="utf-8") as nowhere:
                    os.dup2(nowhere.fileno(), stream.fileno())
