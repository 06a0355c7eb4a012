"""Results of benchmarks: how they are timed and printed."""

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
        quick: measure a little of everything: the code runs, the figures mean nothing.
        compiled: measure ``torch.compile`` too, which takes up to a minute before the first figure.
        folder: where a benchmark may write.
    """

    quick: bool
    compiled: bool
    folder: Path

    def pick(self, full: int, quick: int) -> int:
        """Return the number for a full run, or for a quick one."""
        return quick if self.quick else full


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: what is measured.
        ours: the absolute number, of ``unit``.
        unit: "µs", "s", "GB", ...
        rival: what it is compared with, "" for a number that stands alone.
        theirs: the rival's number, of the same unit, measured in turns with ours.
        ratio: the median over the rounds of ``theirs / ours``, above 1 where ours is faster; or, of a part of a
            whole and of what does more than the rival, ``ours / theirs``.
        spread: the quartiles of that ratio over the rounds.
        target: what the number or the ratio is to reach, "" for none.
        met: whether it does, None without a target.
        note: what else there is to know.
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
    """A benchmark cannot run here; the message says why."""


def take_turns(
    contenders: Mapping[str, Callable[[], object]], rounds: int, *, warm_up: int = 1
) -> dict[str, list[float]]:
    """Seconds of each call, the contenders called in turn, in an order that is reversed every other round."""
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
    """Seconds of one call."""
    start = perf_counter()
    call()
    return perf_counter() - start


def bars(rounds: Iterable[int], what: str) -> Iterable[int]:
    """``rounds`` with a progress bar, which goes away at the end."""
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
    """A row from the seconds of ours and the rival's in the same rounds; ``scale`` makes units of seconds."""
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
    """A row whose ratio is the share that ``part`` has of ``whole``, both in seconds of the same rounds."""
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
    """A row whose ratio says how many times as long as ``shorter`` the ``longer`` takes, in the same rounds."""
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
    """A row that is a number alone, with a limit or without."""
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
    """A table for the terminal."""
    cells = [COLUMNS, *map(_cells, rows)]
    widths = [max(len(line[column]) for line in cells) for column in range(len(COLUMNS))]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(line, widths, strict=True)).rstrip() for line in cells)


def as_markdown(rows: Sequence[Row]) -> str:
    """The same table for benchmarks/results/performance.md."""
    cells = [COLUMNS, tuple("---" for _ in COLUMNS), *map(_cells, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in cells) + "\n"
