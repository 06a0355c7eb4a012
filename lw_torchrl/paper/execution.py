"""Executing a run: its datasets, its training, its evaluation, and the result that is written last."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch

from lw_torchrl._checks import differences
from lw_torchrl._devices import check_device
from lw_torchrl._files import held
from lw_torchrl._progress import Progress
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules import ScriptedSkillActor
from lw_torchrl.modules.policy import Policy
from lw_torchrl.paper.runs import SCRIPTED, Run
from lw_torchrl.paper.training import train_each, train_one

EVALUATION_SEED = 10_000
"""Training seeds count from 0; the evaluation of training seed k has seed 10000 + k."""
RESULTS = "results.json"


def _evaluate(
    policies: Policy | ScriptedSkillActor | Mapping[str, Policy],
    run: Run,
    tasks: tuple[str, ...],
    progress: bool,
    device: torch.device,
) -> EvaluationResult:
    options: dict[str, Any] = {
        "episodes_per_task": run.episodes,
        "seed": EVALUATION_SEED + run.seed,
        "noise_scale": 0.1,
        "stop_at_success": True,
    }
    if run.method != SCRIPTED:
        options["device"] = device
    if not isinstance(policies, Mapping):
        return evaluate(policies, tasks=tasks, progress=progress, **options)
    each = []
    with Progress("evaluating", len(tasks), "model", show=progress) as bar:
        for task in tasks:
            each.append(evaluate(policies[task], tasks=task, progress=False, **options))
            bar.update()
    return EvaluationResult(each[0].config | {"tasks": [*tasks]}, tuple(e for one in each for e in one.episodes))


def _best(results: Sequence[EvaluationResult]) -> dict[str, Any]:
    """How many evaluations there are, and each task's best success rate of them."""
    rates = {task: max(one.success_once[task] or 0.0 for one in results) for task in results[0].success_once}
    return {"of": len(results), "rates": rates}


class Evaluated(Protocol):
    """A run whose result is an evaluation: where it goes, and what it hangs on."""

    @property
    def folder(self) -> Path: ...

    @property
    def episodes(self) -> int: ...

    def describe(self, plans: Plans) -> dict[str, Any]: ...


def load_result(run: Evaluated, plans: Plans, out: Path, tasks: Sequence[str] | None = None) -> EvaluationResult | None:
    """The result of a run, if it is there.

    Raises:
        ValueError: it is of another configuration, or an evaluation of others than ``tasks``, where they are given.
    """
    return _load(out / run.folder / RESULTS, run, plans, tasks)


def _load(path: Path, run: Evaluated, plans: Plans, tasks: Sequence[str] | None) -> EvaluationResult | None:
    if not path.is_file():
        return None
    result = EvaluationResult.load(path)
    found = (result.config.get("run") or {}) | {"episodes": result.config["episodes_per_task"]}
    ours = run.describe(plans) | {"episodes": run.episodes}
    if tasks is not None:
        found, ours = found | {"tasks": result.config["tasks"]}, ours | {"tasks": [*tasks]}
    if different := differences(found, ours):
        raise ValueError(
            f"out: {str(path)!r} is of another configuration, it differs in {', '.join(different)}; choose another "
            f"folder, or delete {run.folder} there to do the run again"
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
        tasks: to evaluate; of a run with a policy for each target, the targets among them.
        progress: show progress bars.
        text_encoder: texts to vectors (n, E) float32, which ``run.encoder_name`` names; None for the shipped one.
        device: where networks are trained and evaluated; it is no part of what the run is, so one that was begun
            elsewhere is finished here.

    Returns:
        The evaluation of the last checkpoint, action noise 0.1; ``config["run"]`` says what was done,
        ``config["seconds"]`` how long this call took, and ``config["best"]``, where the preset has more evaluations
        than one, ``of`` how many ``rates`` has each task's best success rate. The earlier ones are in
        ``evaluations/<steps>.json``.

    Raises:
        ValueError: ``out`` holds the same run of another configuration, or evaluated in other tasks; no task is one of
            its targets; or a text encoder that the run does not name, or none where it names one.

    Source: paper section 'Conditional Plan Experiments'.
    """
    shown, there = _shown(run, tasks), check_device("device", device)
    if run.method != SCRIPTED and (text_encoder is None) != (not run.encoder_name):
        raise ValueError(
            f"text_encoder must be given where the run has an encoder_name, by which its folder is told from others, "
            f"and only there; it has {run.encoder_name!r}"
        )
    if (done := load_result(run, plans, out, shown)) is not None:
        return done
    with held(out / run.folder, "out", folder=True, wait=True):
        return load_result(run, plans, out, shown) or _execute(run, plans, out, shown, progress, text_encoder, there)


def _shown(run: Run, tasks: str | Sequence[str]) -> tuple[str, ...]:
    """The tasks that are evaluated."""
    names = resolve_tasks(tasks)
    if run.method == SCRIPTED or run.setting.targets is None:
        return names
    targets = resolve_tasks(run.setting.targets)
    if not (shown := tuple(name for name in names if name in targets)):
        raise ValueError(f"tasks must name some of the run's targets, {', '.join(targets)}, got {', '.join(names)}")
    return shown


def _execute(
    run: Run,
    plans: Plans,
    out: Path,
    shown: tuple[str, ...],
    progress: bool,
    text_encoder: TextEncoder | None,
    there: torch.device,
) -> EvaluationResult:
    started = time.perf_counter()
    for dataset in run.datasets:
        dataset.collect(out, progress)
    earlier = out / run.folder / "evaluations"
    described: dict[str, Any] = {"run": run.describe(plans)}

    def look(policies: Policy | dict[str, Policy], step: int) -> None:
        file = earlier / f"{step}.json"
        if _load(file, run, plans, shown) is None:
            result = _evaluate(policies, run, shown, progress, there)
            replace(result, config=result.config | described).save(file)

    policies: Any
    if run.method == SCRIPTED:
        policies = ScriptedSkillActor(plans)
    else:
        train = train_one if run.setting.targets is None else train_each
        policies = train(run, plans, out, progress, look, text_encoder, there)
    result = _evaluate(policies, run, shown, progress, there)
    if run.preset.evaluations > 1 and run.method != SCRIPTED:
        found = [_load(file, run, plans, shown) for file in sorted(earlier.glob("*.json"))]
        described["best"] = _best([result, *filter(None, found)])
    described["seconds"] = round(time.perf_counter() - started, 1)
    result = replace(result, config=result.config | described)
    result.save(out / run.folder / RESULTS)
    return result
