"""``lw-torchrl reproduce``: the paper's experiments, unit by unit."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tyro.conf import Positional

if TYPE_CHECKING:
    from lw_torchrl.language.plans import Plans
    from lw_torchrl.trainers.experiments import Unit


def reproduce(
    experiment: Positional[Literal["zero-shot", "few-shot", "scripted", "all"]],
    /,
    seeds: tuple[int, ...] = (0, 1, 2),
    methods: tuple[Literal["pcbc", "dc", "one-hot"], ...] = ("pcbc", "dc", "one-hot"),
    preset: Literal["strong", "paper"] = "strong",
    plans: Path | None = None,
    episodes: int = 20,
    unit: str | None = None,
    out: Path = Path("runs/reproduce"),
) -> None:
    """Run the paper's experiments and compare them with the published results. Stopped and started again it carries on.

    A unit is one policy of one seed: its demonstrations, its training, its evaluation. Each can be run by a command
    of its own, with --unit, by any scheduler; the summary is written when the command is run without it.

    Example: lw-torchrl reproduce few-shot --seeds 0 1 2 --methods pcbc dc

    Args:
        experiment: zero-shot, 100 demonstrations of each MT10 task; few-shot, 10 of each MT50 task; scripted, plans
            with scripted skills; or all of them.
        seeds: of the demonstrations, the initial weights and the minibatches.
        methods: conditioned on plans, on the task's description, on the task's number.
        preset: ours, or the published recipe, which takes hours.
        plans: a folder of plans for all 50 tasks instead of ours.
        episodes: evaluated for each task, on seeds that no training used, action noise 0.1.
        unit: run this one alone, such as few-shot/strong/pcbc/seed0.
        out: where everything goes.
    """
    from lw_torchrl._checks import check_choice
    from lw_torchrl.cli import _calm_torch
    from lw_torchrl.language.plans import load_plans
    from lw_torchrl.trainers.experiments import PRESETS, SETTINGS, Unit, run_unit

    _calm_torch()
    chosen = [name for name in SETTINGS if experiment in (name, "all")]
    units = [
        Unit(SETTINGS[name], method, seed, PRESETS[preset], episodes)
        for name in chosen
        for method in methods
        for seed in seeds
    ]
    if experiment in ("scripted", "all"):
        units += [Unit(SETTINGS["few-shot"], "scripted", seed, PRESETS[preset], episodes) for seed in seeds]
    if unit is not None:
        named = {str(one.folder): one for one in units}
        units = [named[check_choice("unit", unit, named)]]

    def plans_of(one: Unit) -> Plans:
        if plans is not None:
            return load_plans(plans)
        return load_plans("MT50", skills="MT10" if one.setting.name == "zero-shot" else "own")

    started = time.perf_counter()
    for number, one in enumerate(units, 1):
        before = time.perf_counter()
        result = run_unit(one, plans_of(one), out)
        spent = time.perf_counter() - before
        left = (time.perf_counter() - started) / number * (len(units) - number)
        print(
            f"[{number}/{len(units)}] {one.folder}: mean success {result.mean_success:.3f}, {spent:.0f} s; "
            f"about {left / 60:.0f} min left"
        )
    if unit is None:
        _summarize(units, out)


def _summarize(units: list[Unit], out: Path) -> None:
    """A summary, a table and a figure for each setting, from the results on disk."""
    from lw_torchrl._files import write_json
    from lw_torchrl.evaluation import (
        EvaluationResult,
        Summary,
        plot_sorted_tasks,
        published_curves,
        summarize,
    )

    found: dict[str, dict[str, dict[int, EvaluationResult]]] = {}
    for one in units:
        result = EvaluationResult.load(out / one.folder / "results.json")
        found.setdefault(one.setting.name, {}).setdefault(one.method, {})[one.seed] = result
    for setting, methods in found.items():
        summaries: dict[str, Summary] = {
            method: summarize(results, whole_seeds=True) for method, results in methods.items()
        }
        curves = published_curves(setting)
        folder = out / setting / units[0].preset.name
        for method, summary in summaries.items():
            print(f"\n{setting}, {method}: {summary.table(curves)}")
        write_json(folder / "summary.json", {method: summary.to_json() for method, summary in summaries.items()})
        plot_sorted_tasks(summaries, folder / "tasks.png", published=curves, title=f"{setting}, last checkpoint")
        print(f"\nwritten to {folder}")
