"""python -m benchmarks.exchange: measure the time to export and import 100,000 rows in each format, and the size."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Annotated

import tyro

import lw_torchrl as lw
from lw_torchrl.data.exchange import FORMATS


def _size(folder: Path) -> float:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def _seconds(act: Callable[[], object]) -> float:
    start = perf_counter()
    act()
    return perf_counter() - start


def main(
    episodes: Annotated[int, tyro.conf.arg(help="number of 500-step episodes per MT10 task")] = 20,
    repeats: Annotated[int, tyro.conf.arg(help="number of repetitions; the first is not counted")] = 3,
) -> None:
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        made = lw.collect_demonstrations("MT10", episodes_per_task=episodes, root=root / "demos")
        print(f"{made.num_steps} rows, {_size(root / 'demos'):.1f} MB as a dataset")
        print("| format | export | import | size |\n|---|---|---|---|")
        for kind in FORMATS:
            out, back = [], []
            for number in range(repeats + 1):
                there, again = root / f"{kind}{number}", root / f"{kind}{number}-back"
                out.append(_seconds(lambda: lw.export_dataset(root / "demos", kind, there)))  # noqa: B023
                back.append(_seconds(lambda: lw.import_dataset(there, again)))  # noqa: B023
            megabytes = _size(root / f"{kind}0")
            print(f"| `{kind}` | {median(out[1:]):.2f} s | {median(back[1:]):.2f} s | {megabytes:.1f} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
