"""What a command has found: tables on a terminal, plain columns in a pipe, or one JSON document with ``--json``."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lw_torchrl.evaluation import EvaluationResult

Row = Mapping[str, Any]
Columns = Mapping[str, str | Callable[[Row], Any]]
"""Heading to the name of what stands in a row, or to a function of the row."""


class Output:
    """Prints what is found as text, at once, or gathers it for a document.

    Args:
        as_json: gather.

    Attributes:
        fault: what the command ends with as an error, once all that it found is printed; "" for none.

    Example:
        >>> output = Output(as_json=False)
        >>> output.table("tasks", [{"task": "push", "episodes": 3}, {"task": "reach", "episodes": None}])
        task   episodes
        push   3
        reach
        >>> output = Output(as_json=True)
        >>> output.show("rate", float("nan"), "no rate")
        >>> output.document()
        '{\\n  "rate": null\\n}'
    """

    def __init__(self, as_json: bool) -> None:
        self.as_json, self.fault = as_json, ""
        self._found: dict[str, Any] = {}

    def show(self, key: str, value: Any, text: str | None = None) -> None:
        """Print ``text``, if there is any, or keep the value under the key."""
        if self.as_json:
            self._found[key] = value
        elif text is not None:
            print(text)

    def table(
        self,
        key: str,
        rows: Sequence[Row],
        columns: Columns | None = None,
        title: str = "",
    ) -> None:
        """Print rows as a table, or keep them under the key.

        Args:
            key: in the document.
            rows: what is found, by names.
            columns: of the text; all by their names if none are given.
            title: of the text.
        """
        if self.as_json:
            self._found[key] = [dict(row) for row in rows]
            return
        shown = columns if columns is not None else {name: name for row in rows for name in row}
        cells = [[_cell(row[of] if isinstance(of, str) else of(row)) for of in shown.values()] for row in rows]
        (_on_terminal if sys.stdout.isatty() else _in_pipe)(title, [*shown], cells)

    def result(self, found: EvaluationResult, **more: Mapping[str, Any]) -> None:
        """Print an evaluation's table, or keep its numbers under "tasks", with more of each, and its configuration."""
        rates = ("success_once", "success_at_end", "first_success", "mean_return")
        rows = [
            {"task": task, **{name: getattr(found, name)[task] for name in rates}}
            | {name: of[task] for name, of in more.items()}
            for task in found.config["tasks"]
        ]
        self.show("tasks", rows, found.table())
        self.show("mean_success", found.mean_success)
        self.show("config", found.config)

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
    if value is None or value is False:
        return ""
    return "yes" if value is True else str(value)


def _in_pipe(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Columns as wide as what stands in them, whatever the terminal; nothing behind the last."""
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
