"""python -m benchmarks.ablations: what each ingredient of the few-shot recipe gives, by training without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
import tyro

import lw_torchrl as lw
from lw_torchrl._files import write_text
from lw_torchrl.evaluation import count_solved
from lw_torchrl.evaluation.comparison import markdown_table
from lw_torchrl.experiments.execution import execute_run
from lw_torchrl.experiments.recipes import CLEAN, NOISY, PRESETS, SETTINGS, Member, Preset
from lw_torchrl.experiments.runs import Run

FULL = PRESETS["strong"]["few-shot"]


def _without(name: str, **changes: Any) -> Preset:
    return replace(FULL, name=f"strong-without-{name}", **changes)


def _members(**options: Any) -> tuple[Member, ...]:
    return tuple(replace(member, actor={**member.actor, **options}) for member in FULL.members)


ABLATIONS: Mapping[str, Preset] = MappingProxyType(
    {
        "the recipe": FULL,
        "clean demonstrations, failures kept": _without("noise", base=CLEAN),
        "noise drawn anew at every step, failures kept": _without("holding", base=NOISY),
        "rows long after success kept": _without("cutting", after_success=None),
        "the raw observation": _without("differences", members=_members(features="raw")),
        "no feature noise": _without("feature-noise", members=_members(feature_noise=0.0)),
        "width 256": _without("width", members=_members(width=256)),
        "a constant learning rate": _without("cosine", training=replace(FULL.training, schedule="constant")),
    }
)


@dataclass(frozen=True)
class Arguments:
    """Train PCBC few-shot with one ingredient of the recipe changed at a time. Stopped and started again it carries on.

    A seed of one change takes 4 to 9 minutes.
    """

    seeds: tuple[int, ...] = (0,)
    """Of demonstrations, weights and minibatches."""
    steps: int = FULL.training.steps
    """Minibatches, of the recipe and of each change."""
    out: Path = Path("runs/reproduce")
    """The experiments' folder: datasets and runs that `lw-torchrl reproduce` left there are used."""


def main(arguments: Arguments) -> None:
    plans = lw.load_plans("MT50")
    lines = []
    for change, preset in ABLATIONS.items():
        shorter = replace(preset, training=replace(preset.training, steps=arguments.steps))
        if arguments.steps != FULL.training.steps:
            shorter = replace(shorter, name=f"{preset.name}-{arguments.steps}-steps")
        runs = [Run(SETTINGS["few-shot"], "pcbc", seed, shorter) for seed in arguments.seeds]
        results = [execute_run(run, plans, arguments.out) for run in runs]
        means = ", ".join(f"{result.mean_success:.3f}" for result in results)
        solved = ", ".join(str(count_solved([list(result.success_once.values())])) for result in results)
        shown = (change, means, solved)
        print(" | ".join(shown), flush=True)
        lines.append(shown)
    table = markdown_table(("few-shot PCBC", "mean, by seed", "tasks >= 0.8"), lines)
    write_text(arguments.out / "few-shot" / f"ablations-{arguments.steps}-steps.md", table)
    print(f"\n{table}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
