"""Benchmarks of a user's workflow: evaluate a policy, and collect demonstrations."""

from __future__ import annotations

import shutil
from tempfile import mkdtemp
from typing import Any

import torch

import lw_torchrl as lw
from benchmarks.report import Row, Settings, timed, under
from lw_torchrl._util.workers import available_cores


def _size(settings: Settings, full: int) -> tuple[tuple[str, ...], int, int]:
    """Return the tasks, the number of episodes per task, and the number of steps per episode."""
    return (lw.MT50[:2], 1, 20) if settings.quick else (lw.MT50, full, 500)


def _name(what: str, tasks: tuple[str, ...], episodes: int, steps: int) -> str:
    return f"{what} {len(tasks)} tasks × {episodes} episodes × {steps} steps, {available_cores()} cores"


def evaluation(settings: Settings) -> list[Row]:
    """Evaluate an untrained plan-conditioned policy for full episodes, and the expert until its first success."""
    tasks, episodes, steps = _size(settings, 20)
    options: dict[str, Any] = {"tasks": tasks, "episodes_per_task": episodes, "seed": 1_000, "max_steps": steps}
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(lw.load_plans("MT50"))
    full = timed(lambda: lw.evaluate(actor, **options))
    found: list[lw.EvaluationResult] = []
    stopped = timed(lambda: found.append(lw.evaluate(lw.ExpertActor(tasks), stop_at_success=True, **options)))
    rate = sum(episode.success for episode in found[0].episodes) / len(found[0].episodes)
    return [
        under(_name("evaluation of a PlanConditionedActor,", tasks, episodes, steps), full, "s", 60, "untrained"),
        under(
            _name("evaluation of ExpertActor, stopped at success,", tasks, episodes, steps),
            stopped,
            "s",
            30,
            f"success {rate:.2f}",
        ),
    ]


def collection(settings: Settings) -> list[Row]:
    """Collect full-length demonstrations of every task."""
    tasks, episodes, steps = _size(settings, 10)
    settings.folder.mkdir(parents=True, exist_ok=True)
    folder = mkdtemp(prefix="demos-", dir=settings.folder)
    try:
        seconds = timed(
            lambda: lw.collect_demonstrations(
                tasks, episodes_per_task=episodes, root=f"{folder}/demos", max_steps=steps
            )
        )
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    return [under(_name("collection,", tasks, episodes, steps), seconds, "s", 60)]
