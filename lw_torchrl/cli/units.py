"""Runs of work behind a command: done elsewhere, each by a command of its own, and what they say as they end."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from typing import Literal


def run_there(
    command: str, names: Sequence[str], given: Sequence[str], launcher: Literal["local", "ray"], jobs: int
) -> Iterator[str]:
    """Do each of the named runs by ``lw-torchrl command ... --run NAME`` with the arguments ``given``; yield what each
    says as it ends."""
    from lw_torchrl.experiments.launchers import run_commands

    for index, printed in run_commands([[command, *given, "--run", name] for name in names], launcher, jobs):
        yield printed.strip() or names[index]


def report(total: int, lines: Iterator[str]) -> None:
    """Print what each run says as it ends, and how long the others will take."""
    started = time.perf_counter()
    for number, line in enumerate(lines, 1):
        left = (time.perf_counter() - started) / number * (total - number)
        print(f"[{number}/{total}] {line}; about {left / 60:.0f} min left", flush=True)
