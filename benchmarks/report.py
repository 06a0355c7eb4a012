"""Time benchmarks in turns, and print the results as tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median, quantiles
from time import perf_counter
from typing import Any

from tqdm.auto import tqdm


@dataclass(frozen=True)
class Settings:
    """Options of all benchmarks.

    Attributes:
        quick: run a small version of everything as a test; the numbers are meaningless.
        compiled: also measure ``torch.compile``, which takes up to a minute to compile.
        folder: a folder to which benchmarks may write.
    """

    quick: bool
    compiled: bool
    folder: Path

    def pick(self, full: int, quick: int) -> int:
        """Return ``quick`` in a quick run, and ``full`` otherwise."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: the measured quantity.
        ours: our value, in ``unit``.
        unit: "µs", "s", "GB", ...
        rival: the name of the alternative, or "" without a comparison.
        theirs: the value of the alternative, in the same unit, measured in turns with ours.
        ratio: the median over rounds of ``theirs / ours``, which is above 1 if ours is faster. For a share of a whole,
            and for code that does more than the alternative, the median of ``ours / theirs``.
        spread: the quartiles of the ratio over the rounds.
        target: the target for the value or ratio, or "" without a target.
        met: whether the target is met; None without a target.
        note: a remark.
    """

    name: str
    ours: float
    unit: str
    rival: str = ""
    theirs: float | None = None
    ratio: float | None = None
    spread: tuple[float, float] | None = None
    target: str = ""
    met: bool | None = None
    note: str = ""

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class Skipped(Exception):
    """An error for a benchmark that cannot run here; the message states the reason."""


def take_turns(
    contenders: Mapping[str, Callable[[], object]], rounds: int, *, warm_up: int = 1
) -> dict[str, list[float]]:
    """Call all contenders in each round, in an order that alternates, and return the seconds of each call by name."""
    names = list(contenders)
    found: dict[str, list[float]] = {name: [] for name in names}
    for number in range(-warm_up, rounds):
        for name in names if number % 2 else reversed(names):
            start = perf_counter()
            contenders[name]()
            seconds = perf_counter() - start
            if number >= 0:
                found[name].append(seconds)
    return found


def timed(call: Callable[[], object]) -> float:
    """Return the seconds that a call takes."""
    start = perf_counter()
    call()
    return perf_counter() - start


def bars(rounds: Iterable[int], what: str) -> Iterable[int]:
    """Return ``rounds`` with a progress bar that disappears at the end."""
    return tqdm(rounds, desc=what, leave=False, delay=1)


def compare(
    name: str,
    ours: Sequence[float],
    rival: str,
    theirs: Sequence[float],
    *,
    unit: str,
    scale: float,
    at_least: float | None = None,
    note: str = "",
) -> Row:
    """Return a row from our seconds and the rival's in the same rounds; ``scale`` converts seconds to ``unit``."""
    ratios = [b / a for a, b in zip(ours, theirs, strict=True)]
    row = _row(name, ours, rival, theirs, ratios, unit=unit, scale=scale, note=note)
    if at_least is None:
        return row
    return replace(row, target=f"ratio ≥ {at_least:g}", met=row.ratio is not None and row.ratio >= at_least)


def part_of(
    name: str,
    part: Sequence[float],
    whole_name: str,
    whole: Sequence[float],
    *,
    unit: str,
    scale: float,
    at_most: float | None = None,
    note: str = "",
) -> Row:
    """Return a row whose ratio is the share of ``part`` in ``whole``, both in seconds in the same rounds."""
    shares = [a / b for a, b in zip(part, whole, strict=True)]
    row = _row(name, part, whole_name, whole, shares, unit=unit, scale=scale, note=note)
    if at_most is None:
        return row
    return replace(row, target=f"share ≤ {at_most:g}", met=row.ratio is not None and row.ratio <= at_most)


def times_as_long(
    name: str,
    longer: Sequence[float],
    shorter_name: str,
    shorter: Sequence[float],
    *,
    unit: str,
    scale: float,
    at_most: float,
) -> Row:
    """Return a row whose ratio is ``longer`` divided by ``shorter``, both in seconds in the same rounds."""
    row = part_of(name, longer, shorter_name, shorter, unit=unit, scale=scale, at_most=at_most)
    return replace(row, target=f"ratio ≤ {at_most:g}")


def _row(
    name: str,
    ours: Sequence[float],
    rival: str,
    theirs: Sequence[float],
    ratios: Sequence[float],
    *,
    unit: str,
    scale: float,
    note: str,
) -> Row:
    ratio = median(ratios)
    low, _, high = quantiles(ratios, n=4, method="inclusive") if len(ratios) > 1 else (ratio, ratio, ratio)
    return Row(
        name=name,
        ours=median(ours) * scale,
        unit=unit,
        rival=rival,
        theirs=median(theirs) * scale,
        ratio=ratio,
        spread=(low, high),
        note=note,
    )


def under(name: str, ours: float, unit: str, most: float | None = None, note: str = "") -> Row:
    """Return a row without a comparison, with or without an upper limit."""
    target = "" if most is None else f"≤ {most:g} {unit}"
    return Row(name, ours, unit, target=target, met=None if most is None else ours <= most, note=note)


def _number(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _ratio(value: float) -> str:
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}" if value >= 0.2 else f"{value:.3f}"


COLUMNS = ("measured", "ours", "rival", "theirs", "ratio", "quartiles", "target", "met")


def _cells(row: Row) -> tuple[str, ...]:
    return (
        row.name,
        f"{_number(row.ours)} {row.unit}",
        row.rival,
        "" if row.theirs is None else f"{_number(row.theirs)} {row.unit}",
        "" if row.ratio is None else _ratio(row.ratio),
        "" if row.spread is None else f"{_ratio(row.spread[0])} to {_ratio(row.spread[1])}",
        row.target,
        {None: "", True: "yes", False: "NO"}[row.met],
    )


def as_text(rows: Sequence[Row]) -> str:
    """Return the rows as a table for the terminal."""
    cells = [COLUMNS, *map(_cells, rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(COLUMNS))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def as_markdown(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table for benchmarks/results/performance.md."""
    cells = [COLUMNS, tuple("---" for _ in COLUMNS), *map(_cells, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) + "\n"
