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
from lw_torchrl._progress import Progress
from lw_torchrl.evaluation import EvaluationResult, evaluate
from lw_torchrl.experiments.runs import SCRIPTED, Run
from lw_torchrl.experiments.training import train_each, train_one
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules import ScriptedSkillActor
from lw_torchrl.modules.policy import Policy

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
    found = sorted({*tasks} & {*policies})
    each = []
    with Progress("evaluating", len(found), "model", show=progress) as bar:
        for task in found:
            each.append(evaluate(policies[task], tasks=task, progress=False, **options))
            bar.update()
    shown = [task for one in each for task in one.config["tasks"]]
    return EvaluationResult(each[0].config | {"tasks": shown}, tuple(e for one in each for e in one.episodes))


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


def load_result(run: Evaluated, plans: Plans, out: Path) -> EvaluationResult | None:
    """The result of a run, if it is there.

    Raises:
        ValueError: it is of another configuration.
    """
    return _load(out / run.folder / RESULTS, run, plans)


def _load(path: Path, run: Evaluated, plans: Plans) -> EvaluationResult | None:
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
        tasks: to evaluate.
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
        ValueError: ``out`` holds the same run of another configuration.

    Source: paper section 'Conditional Plan Experiments'.
    """
    if (done := load_result(run, plans, out)) is not None:
        return done
    there = check_device("device", device)
    started = time.perf_counter()
    for dataset in run.datasets:
        dataset.collect(out, progress)
    shown, earlier = resolve_tasks(tasks), out / run.folder / "evaluations"
    described: dict[str, Any] = {"run": run.describe(plans)}

    def look(policies: Policy | dict[str, Policy], step: int) -> None:
        file = earlier / f"{step}.json"
        if _load(file, run, plans) is None:
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
        found = [_load(file, run, plans) for file in sorted(earlier.glob("*.json"))]
        described["best"] = _best([result, *filter(None, found)])
    described["seconds"] = round(time.perf_counter() - started, 1)
    result = replace(result, config=result.config | described)
    result.save(out / run.folder / RESULTS)
    return result
