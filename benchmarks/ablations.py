"""python -m benchmarks.ablations: measure the contribution of each ingredient of a recipe by training without it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal
from unittest.mock import patch

import torch
import tyro
from tensordict import TensorDictBase
from torch import Tensor

import lw_torchrl as lw
from benchmarks.figures import markdown_table
from benchmarks.paper.imitation import ImitationRun
from benchmarks.paper.recipes import EXECUTIONS, PRESETS, SETTINGS, Member, Preset
from benchmarks.paper.runs import execute_run
from benchmarks.statistics import count_solved
from lw_torchrl._util.files import write_text
from lw_torchrl.language.objects import NamedObject
from lw_torchrl.language.tasks import Task, role_object
from lw_torchrl.modules import RoleFeatures

Setting = Literal["few-shot", "zero-shot"]
FULL: Mapping[str, Preset] = PRESETS["strong"]


def _without(setting: Setting, name: str, **changes: Any) -> Preset:
    return replace(FULL[setting], name=f"strong-without-{name}", **changes)


def _without_plan_parts(setting: Setting) -> Preset:
    return _without(setting, "roles", members=tuple(replace(one, plan_parts={}) for one in FULL[setting].members))


def _members(**options: Any) -> tuple[Member, ...]:
    return tuple(replace(member, parts={**member.parts, **options}) for member in FULL["few-shot"].members)


def _few_shot(name: str, **changes: Any) -> Preset:
    return _without("few-shot", name, **changes)


def _zero_shot(name: str, **changes: Any) -> Preset:
    """Return the recipe with changed parts in the members that read plans."""
    members = tuple(replace(one, plan_parts={**one.plan_parts, **changes}) for one in FULL["zero-shot"].members)
    return _without("zero-shot", name, members=members)


def _object_itself(task: Task, name: str) -> NamedObject:
    return replace(role_object(task, name), offset=(0.0, 0.0, 0.0))


def _fit_without_contacts(roles: RoleFeatures, rows: TensorDictBase, weights: Tensor | None = None) -> None:
    roles.demonstrated[roles.tables.rows(rows.get("task_id")).unique()] = True
    roles.fitted.fill_(True)


ABLATIONS: Mapping[Setting, Mapping[str, Preset]] = MappingProxyType(
    {
        "few-shot": {
            "the recipe": FULL["few-shot"],
            "clean demonstrations, failures kept": _few_shot("noise", base=EXECUTIONS["clean"]),
            "noise drawn anew at every step, failures kept": _few_shot("holding", base=EXECUTIONS["noisy"]),
            "rows long after success kept": _few_shot("cutting", after_success=None),
            "the raw observation": _few_shot("differences", members=_members(features="raw")),
            "no feature noise": _few_shot("feature-noise", members=_members(feature_noise=0.0)),
            "neither focus nor roles": _without_plan_parts("few-shot"),
            "the first member alone": _few_shot("members", members=FULL["few-shot"].members[:1]),
            "a constant learning rate": _few_shot(
                "cosine", training=replace(FULL["few-shot"].training, schedule="constant")
            ),
        },
        "zero-shot": {
            "the recipe": FULL["zero-shot"],
            "all differences instead of roles": _without_plan_parts("zero-shot"),
            "no contacts": _zero_shot("contacts"),
            "objects' own places instead of named points": _zero_shot("points"),
            "the opening shown": _zero_shot("opening", features="opening"),
            "turned by 0.3": _zero_shot("any-yaw", yaw=0.3),
            "not turned": _zero_shot("yaw", yaw=0.0, tilt=0.0),
            "not tilted": _zero_shot("tilt", tilt=0.0),
            "fingers half open": _zero_shot("deciding", decided_gripper=False),
            "words in demonstrated tasks, too": _without("zero-shot", "seen", demonstrated=()),
            "no jitter": _zero_shot("jitter", jitter=0.0),
            "one member": _without("zero-shot", "members", members=FULL["zero-shot"].members[:1]),
        },
    }
)
PATCHES: Mapping[str, Callable[[], AbstractContextManager[Any]]] = MappingProxyType(
    {
        "no contacts": lambda: patch.object(RoleFeatures, "fit", _fit_without_contacts),
        "objects' own places instead of named points": lambda: patch(
            "lw_torchrl.modules.relative_features.role_object", _object_itself
        ),
    }
)
"""Context managers for the ablations that no argument of the library can switch on."""


@dataclass(frozen=True)
class Arguments:
    """Train PCBC with one ingredient of the recipe changed at a time.

    If the command is stopped, run it again to resume. Each seed of a change takes 3 to 8 minutes for the few-shot
    recipe, and 3 minutes for the zero-shot recipe.
    """

    setting: Setting = "few-shot"
    """Recipe to change."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds of demonstrations, weights and minibatches."""
    steps: int | None = None
    """Number of minibatches per training run; by default the recipe's."""
    episodes: int = 20
    """Number of evaluation episodes per task."""
    out: Path = Path("runs/reproduce")
    """Folder of the experiments. Datasets and runs of `python -m benchmarks.paper` in this folder are reused."""


def main(arguments: Arguments) -> None:
    setting = arguments.setting
    usual = FULL[setting].training.steps
    steps = usual if arguments.steps is None else arguments.steps
    lines = []
    for change, preset in ABLATIONS[setting].items():
        shorter = replace(preset, training=replace(preset.training, steps=steps))
        if steps != usual:
            shorter = replace(shorter, name=f"{preset.name}-{steps}-steps")
        runs = [ImitationRun(SETTINGS[setting], "pcbc", seed, shorter, arguments.episodes) for seed in arguments.seeds]
        with PATCHES.get(change, nullcontext)():
            results = [execute_run(run, lw.load_plans("MT50", skills=run.skills), arguments.out) for run in runs]
        means = ", ".join(f"{result.mean_success:.3f}" for result in results)
        solved = ", ".join(str(count_solved([list(result.success_once.values())])) for result in results)
        shown = (change, means, solved)
        print(" | ".join(shown), flush=True)
        lines.append(shown)
    table = markdown_table((f"{setting} PCBC", "mean, by seed", "tasks >= 0.8"), lines)
    write_text(arguments.out / setting / f"ablations-{steps}-steps.md", table)
    print(f"\n{table}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
