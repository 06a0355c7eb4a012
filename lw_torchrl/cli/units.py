"""What the commands share that do runs of work, one after another, or each in a process of its own."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Literal

from lw_torchrl._checks import check_int
from lw_torchrl.cli.outputs import check_folder


def check_asked(list: bool, run: str | None, out: Path, jobs: int) -> None:
    """Raise :class:`ValueError` for what cannot be asked of runs at once, or where nothing can be written."""
    if not list:
        check_folder("--out", out)
    elif run is not None:
        raise ValueError("--list names the runs and does none, --run does one: give one of them")
    check_int("jobs", jobs, minimum=1)


def report(total: int, lines: Iterable[str]) -> None:
    """Print what each run says as it ends, and how long the others will take."""
    started = time.perf_counter()
    for number, line in enumerate(lines, 1):
        left = (time.perf_counter() - started) / number * (total - number)
        print(f"[{number}/{total}] {line}; about {left / 60:.0f} min left", flush=True)


def elsewhere(
    names: Iterable[str], command: Sequence[str], launcher: Literal["local", "ray"], jobs: int
) -> Iterator[str]:
    """Do runs by ``lw-torchrl COMMAND --run NAME``, several at a time; yields what each printed, as it ends."""
    from lw_torchrl.paper.launchers import run_commands

    listed = [*names]
    for index, printed in run_commands([[*command, "--run", name] for name in listed], launcher, jobs):
        yield printed.strip() or listed[index]
