"""Tables on a terminal, or in a file."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence


def print_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Print a table; the first column is never wrapped."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    class Printer(Console):
        def on_broken_pipe(self) -> None:  # rich's own exits with status 1
            raise

    table = Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    for number, column in enumerate(columns):
        table.add_column(column, no_wrap=number == 0)
    for row in rows:
        table.add_row(*row)
    wide = None if sys.stdout.isatty() or "COLUMNS" in os.environ else 160
    Printer(highlight=False, markup=False, width=wide).print(table)
