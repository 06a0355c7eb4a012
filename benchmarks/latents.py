"""python -m benchmarks.latents: what a term on the skills' latents gives zero-shot and one-shot, weight by weight."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro

import lw_torchrl as lw
from benchmarks.paper.imitation import ImitationRun
from benchmarks.paper.recipes import PRESETS, SETTINGS, Preset
from benchmarks.paper.runs import execute_run
from lw_torchrl._files import write_text
from lw_torchrl.evaluation import count_solved
from lw_torchrl.evaluation.summary import markdown_table


@dataclass(frozen=True)
class Arguments:
    """Train PCBC by our recipe with a term on its skills' latents. Stopped and started again it carries on."""

    setting: Literal["zero-shot", "few-shot", "one-shot"] = "zero-shot"
    consistency: tuple[float, ...] = (0.0, 0.1, 1.0)
    """Weights of `latent_consistency`, each by itself; 0 is the recipe."""
    contrast: tuple[float, ...] = ()
    """Weights of `latent_contrast`, each by itself."""
    seeds: tuple[int, ...] = (0,)
    """Of demonstrations, weights and minibatches."""
    out: Path = Path("runs/reproduce")
    """The experiments' folder: datasets and runs that `python -m benchmarks.paper` left there are used."""


def preset(setting: str, option: str, weight: float) -> Preset:
    """Our recipe with a weight for one of the terms."""
    strong = PRESETS["strong"][setting]
    if not weight:
        return strong
    changed: dict[str, Any] = {option: weight}
    name = f"strong-{option.replace('_', '-')}-{weight:g}"
    return replace(strong, name=name, training=replace(strong.training, **changed))


def main(arguments: Arguments) -> None:
    asked = [("latent_consistency", weight) for weight in arguments.consistency]
    asked += [("latent_contrast", weight) for weight in arguments.contrast]
    lines = []
    for option, weight in asked:
        recipe = preset(arguments.setting, option, weight)
        runs = [ImitationRun(SETTINGS[arguments.setting], "pcbc", seed, recipe) for seed in arguments.seeds]
        results = [execute_run(run, lw.load_plans("MT50", skills=run.skills), arguments.out) for run in runs]
        means = ", ".join(f"{result.mean_success:.3f}" for result in results)
        solved = ", ".join(str(count_solved([list(result.success_once.values())])) for result in results)
        lines.append((f"{option} {weight:g}", means, solved))
        print(" | ".join(lines[-1]), flush=True)
    table = markdown_table((f"{arguments.setting} PCBC", "mean, by seed", "tasks >= 0.8"), lines)
    write_text(arguments.out / arguments.setting / "latents.md", table)
    print(f"\n{table}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
