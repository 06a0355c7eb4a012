"""Progress reports for long tasks: a bar on a terminal or in a notebook, otherwise a line of text every 30 seconds."""

from __future__ import annotations

import sys
import time
from typing import Any

DELAY, EVERY = 1.0, 30.0  # seconds before a bar is shown, and seconds between lines of text


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class Progress:
    """A progress report on stderr. At the start, ``initial`` of the ``total`` units are already finished."""

    def __init__(self, what: str, total: int, unit: str, *, initial: int = 0, show: bool = True) -> None:
        self.what, self.total, self.unit, self.initial = what, total, unit, initial
        self.done, self.notes = initial, ""
        self._bar: Any = None
        if show and sys.stderr is not None and (sys.stderr.isatty() or "ipykernel" in sys.modules):
            from tqdm.auto import tqdm

            scaled = total >= 100_000
            self._bar = tqdm(total=total, initial=initial, desc=what, unit=unit, unit_scale=scaled, delay=DELAY)
        self._started = time.monotonic()
        self._next = self._started + EVERY if show and sys.stderr is not None and self._bar is None else float("inf")

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *error: object) -> None:
        if self._bar is not None:
            self._bar.close()

    def update(self, units: int = 1) -> None:
        """Add ``units`` to the number of finished units; use a negative number if units must be repeated."""
        self.done += units
        if self._bar is not None:
            self._bar.update(units)
        elif (now := time.monotonic()) >= self._next:
            self._next, spent, left = now + EVERY, now - self._started, ""
            if self.done > self.initial:
                left = f", {_duration(spent / (self.done - self.initial) * (self.total - self.done))} left"
            print(f"{self.what}: {self.done}/{self.total} {self.unit}s{left}{self.notes}", file=sys.stderr, flush=True)

    def note(self, **notes: str) -> None:
        """Show notes next to the progress, for example ``loss="0.012"``."""
        self.notes = "".join(f", {name} {value}" for name, value in notes.items())
        if self._bar is not None:
            self._bar.set_postfix(notes, refresh=False)
