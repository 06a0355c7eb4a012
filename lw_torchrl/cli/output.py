"""Output of a command: text and tables, or one JSON document."""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import lw_torchrl as lw
from lw_torchrl._checks import counted

Row = Mapping[str, Any]
Columns = Mapping[str, str | Callable[[Row], Any]]
"""Heading to the key of a row, or to a function of the row."""


class Output:
    """Print results as text, or gather them for a JSON document.

    Attributes:
        fault: an error found in the user's files; :meth:`finish` raises it after everything is printed.

    Example:
        >>> columns = {"task": "task", "episodes": "run"}
        >>> _ = Output(as_json=False).table("tasks", [{"task": "push", "run": 3}], columns)
        task  episodes
        push  3
        >>> Output(as_json=True).show("rate", float("nan"), "unknown").finish()
        {
          "rate": null
        }
    """

    def __init__(self, as_json: bool) -> None:
        self.as_json, self.fault = as_json, ""
        self._document: dict[str, Any] = {}

    def show(self, key: str, value: Any, text: str | None = None) -> Output:
        """Print ``text`` if it is given, or keep ``value`` for the document; returns itself."""
        if self.as_json:
            self._document[key] = value
        elif text is not None:
            print(text)
        return self

    def table(self, key: str, rows: Sequence[Row], columns: Columns, title: str = "") -> Output:
        """Print rows as a table, or keep them for the document."""
        if self.as_json:
            return self.show(key, [dict(row) for row in rows])
        cells = [[_cell(row[of] if isinstance(of, str) else of(row)) for of in columns.values()] for row in rows]
        _print_table(title, [*columns], cells)
        return self

    def result(self, result: lw.EvaluationResult, **more: Mapping[str, Any]) -> Output:
        """Print an evaluation's table, or keep its numbers, ``more`` numbers of each task, and its config."""
        rates = ("success_once", "success_at_end", "first_success", "mean_return")
        columns = {name: getattr(result, name) for name in rates} | more
        rows = [{"task": task, **{name: of[task] for name, of in columns.items()}} for task in result.config["tasks"]]
        self.show("tasks", rows, result.table()).show("mean_success", result.mean_success)
        return self.show("config", result.config)

    def notes(self, notes: Iterable[str]) -> None:
        """Print the notes about a language model's answers, the most frequent first."""
        counts = Counter(notes).most_common()
        self.show("notes", [{"note": note, "answers": times} for note, times in counts])
        for note, times in counts:
            print(f"{counted(times, 'answer')}: {note}")

    def finish(self) -> None:
        """Print the document, and raise :class:`ValueError` if there is a fault."""
        if self.as_json:
            print(json.dumps(_plain(self._document), indent=2, allow_nan=False))
        if self.fault:
            raise ValueError(self.fault)


def _plain(value: Any) -> Any:
    """Numbers that are not finite become null, paths become strings."""
    if isinstance(value, Mapping):
        return {str(key): _plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(one) for one in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value if value is None or isinstance(value, (str, int)) else str(value)


def _cell(value: Any) -> str:
    return "" if value is None or value is False else "yes" if value is True else str(value)


def _print_table(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table as wide as the terminal, whose first column is never wrapped, or plain columns into a pipe."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    terminal = sys.stdout.isatty()
    table = Table(title=title or None, title_justify="left", box=SIMPLE_HEAD if terminal else None, pad_edge=False)
    for number, heading in enumerate(headings):
        table.add_column(heading, no_wrap=not terminal or number == 0)
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False, markup=False, width=None if terminal else 10_000)
    with console.capture() as capture:
        console.print(table)
    print("\n".join(line.rstrip() for line in capture.get().splitlines()))
