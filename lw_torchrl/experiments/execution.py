"""Executing a run: its datasets, its training, its evaluation, and the result that is written last."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch

from lw_torchrl._checks import differences
from lw_torchrl._devices import check_device
from lw_torchrl._progress import Progress
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.experiments.runs import SCRIPTED, Run
from lw_torchrl.experiments.training import train_each, train_one
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules import ScriptedSkillActor

EVALUATION_SEED = 10_000
"""Training seeds count from 0; the evaluation of training seed k has seed 10000 + k."""
RESULTS = "results.json"


def _evaluate(
    run: Run,
    plans: Plans,
    out: Path,
    tasks: tuple[str, ...],
    progress: bool,
    text_encoder: TextEncoder | None,
    device: torch.device,
) -> EvaluationResult:
    options: dict[str, Any] = {
        "episodes_per_task": run.episodes,
        "seed": EVALUATION_SEED + run.seed,
        "noise_scale": 0.1,
        "stop_at_success": True,
    }
    if run.method == SCRIPTED:
        return evaluate(ScriptedSkillActor(plans), tasks=tasks, progress=progress, **options)
    options["device"] = device
    if run.setting.targets is None:
        policy = train_one(run, plans, out, progress, text_encoder, device)
        return evaluate(policy, tasks=tasks, progress=progress, **options)
    actors = train_each(run, plans, out, progress, text_encoder, device)
    found = sorted({*tasks} & {*actors})
    each = []
    with Progress("evaluating", len(found), "model", show=progress) as bar:
        for task in found:
            each.append(evaluate(actors[task], tasks=task, progress=False, **options))
            bar.update()
    shown = [task for one in each for task in one.config["tasks"]]
    return EvaluationResult(each[0].config | {"tasks": shown}, tuple(e for one in each for e in one.episodes))


class Evaluated(Protocol):
    """A run whose result is an evaluation: where it goes, and what it hangs on."""

    @property
    def folder(self) -> Path: ...

    @property
    def episodes(self) -> int: ...

    def describe(self, plans: Plans) -> dict[str, Any]: ...


def load_result(run: Evaluated, plans: Plans, out: Path) -> EvaluationResult | None:
    """The result of a run, if it is there.

    Raises:
        ValueError: it is of another configuration.
    """
    path = out / run.folder / RESULTS
    if not path.is_file():
        return None
    result = EvaluationResult.load(path)
    found, ours = result.config.get("run") or {}, run.describe(plans)
    evaluated = result.config.get("episodes_per_task")
    found, ours = ({**one, "episodes": count} for one, count in ((found, evaluated), (ours, run.episodes)))
    different = differences({key: found.get(key) for key in ours}, ours)
    if different:
        raise ValueError(
            f"out: {str(path)!r} is of another configuration, it differs in {', '.join(different)}; choose another "
            f"folder, or delete {str(path.parent)!r} to do the run again"
        )
    return result


def execute_run(
    run: Run,
    plans: Plans,
    out: Path,
    *,
    tasks: str | Sequence[str] = "MT50",
    progress: bool = True,
    text_encoder: TextEncoder | None = None,
    device: str | torch.device = "cpu",
) -> EvaluationResult:
    """Do a run, or what is left of it; its result is written last, to ``out/run.folder/results.json``.

    Args:
        run: what to do.
        plans: a plan for each of the 50 tasks.
        out: the experiments' folder.
        tasks: to evaluate.
        progress: show progress bars.
        text_encoder: texts to vectors (n, E) float32, which ``run.encoder_name`` names; None for the shipped one.
        device: where networks are trained and evaluated; it is no part of what the run is, so one that was begun
            elsewhere is finished here.

    Returns:
        The evaluation of the last checkpoint, action noise 0.1; ``config["run"]`` says what was done, and
        ``config["seconds"]`` how long this call took.

    Raises:
        ValueError: ``out`` holds the same run of another configuration.

    Source: paper section 'Conditional Plan Experiments'.
    """
    if (done := load_result(run, plans, out)) is not None:
        return done
    there = check_device("device", device)
    started = time.perf_counter()
    for dataset in run.datasets:
        dataset.collect(out, progress)
    result = _evaluate(run, plans, out, resolve_tasks(tasks), progress, text_encoder, there)
    spent = {"run": run.describe(plans), "seconds": round(time.perf_counter() - started, 1)}
    result = replace(result, config=result.config | spent)
    result.save(out / run.folder / RESULTS)
    return result
