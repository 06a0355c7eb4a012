"""python -m benchmarks.demonstrations: measure success by the number of demonstrations, with plans and without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import torch
import tyro

import lw_torchrl as lw
from benchmarks.figures import Panel, markdown_table, plot_panels
from benchmarks.paper.imitation import ImitationRun
from benchmarks.paper.recipes import PRESETS, SETTINGS
from benchmarks.paper.runs import execute_run
from benchmarks.statistics import mean_rate
from lw_torchrl._util.files import write_json, write_text
from lw_torchrl.evaluation import EvaluationResult


@dataclass(frozen=True)
class Arguments:
    """Train and evaluate the recipes of `python -m benchmarks.paper` on fewer demonstrations of each task.

    Zero-shot success rates are means over the 40 tasks without demonstrations, few-shot rates over all 50 tasks. The
    few-shot policy is one network instead of four, which is as good and trains four times as fast. The number of
    training steps is the same for any number of demonstrations. Existing results are reused.
    """

    settings: tuple[str, ...] = ("zero-shot", "few-shot")
    """Settings: zero-shot, few-shot."""
    methods: tuple[str, ...] = ("pcbc", "dc")
    """Methods: pcbc, dc, one-hot."""
    numbers: tuple[int, ...] = (1, 2, 5, 10, 100)
    """Numbers of demonstrations per task."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds of demonstrations, weights and minibatches."""
    episodes: int = 20
    """Number of evaluation episodes per task."""
    out: Path = Path("runs/demonstrations")
    """Folder for the runs, results.json, table.md and figure.png."""


PRESET = {"zero-shot": "strong", "few-shot": "one-network"}
"""The preset that is used in each setting."""
Rates = dict[str, dict[str, dict[int, list[list[float]]]]]


def main(arguments: Arguments) -> None:
    found: Rates = {}
    each = product(arguments.numbers, arguments.seeds, arguments.settings, arguments.methods)
    for number, seed, setting, method in each:
        result = executed(arguments, setting, method, number, seed)
        rates = [float(rate or 0.0) for task, rate in result.success_once.items() if counts(setting, task)]
        found.setdefault(setting, {}).setdefault(method, {}).setdefault(number, []).append(rates)
        report(arguments, found)


def executed(arguments: Arguments, setting: str, method: str, number: int, seed: int) -> EvaluationResult:
    """Return the result of one run, trained now or read from a folder named after the number of demonstrations."""
    fewer = replace(SETTINGS[setting], episodes=number)
    run = ImitationRun(fewer, method, seed, PRESETS[PRESET[setting]][setting], arguments.episodes)
    plans = lw.load_plans("MT50", skills=run.skills)
    result = execute_run(run, plans, arguments.out / str(number))
    print(f"{setting}, {method}, {number} demonstrations, seed {seed}: {result.mean_success:.3f}", flush=True)
    return result


def counts(setting: str, task: str) -> bool:
    return setting != "zero-shot" or task not in lw.MT10


def report(arguments: Arguments, found: Rates) -> None:
    """Write the numbers, the table and the figure of all available results."""
    lines, numbers = [], list(arguments.numbers)
    for setting, methods in found.items():
        for method, each in methods.items():
            cells = [str(mean_rate(each[number])) if number in each else "" for number in numbers]
            lines.append([setting, method, str(max(map(len, each.values()))), *cells])
    write_json(arguments.out / "results.json", found)
    write_text(arguments.out / "table.md", markdown_table(["setting", "method", "seeds", *map(str, numbers)], lines))
    draw(arguments, found)


def draw(arguments: Arguments, found: Rates) -> None:
    """Draw the mean over seeds with the worst and best seed."""
    tasks = {"zero-shot": "40 tasks without demonstrations", "few-shot": "50 tasks, all demonstrated"}
    panels: list[Panel] = []
    for setting, methods in found.items():
        rates: dict[str, list[list[float] | None]] = {}
        for method, each in methods.items():
            seeds = [[mean_of(seed) for seed in each.get(number, ())] for number in arguments.numbers]
            rates[method] = [[mean_of(means), min(means), max(means)] if means else None for means in seeds]
        panels.append((tasks.get(setting, setting), [str(number) for number in arguments.numbers], rates))
    plot_panels(panels, arguments.out / "figure.png", xlabel="demonstrations of each demonstrated task")


def mean_of(numbers: Sequence[float]) -> float:
    return sum(numbers) / len(numbers)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
