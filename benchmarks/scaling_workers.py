"""python -m benchmarks.scaling_workers [WORKERS...]: seconds to collect and to evaluate 500 episodes over processes."""

from __future__ import annotations

import json
import sys
from tempfile import TemporaryDirectory
from typing import Any

import torch

import lw_torchrl as lw
from benchmarks.report import timed
from lw_torchrl._util.workers import available_cores

EPISODES = 500


def rows(workers: int | None = None, *, episodes: int = EPISODES, max_steps: int = 500) -> list[dict[str, Any]]:
    """Measure the collection of MT50 by experts, and the evaluation of an untrained policy, over worker processes.

    Args:
        workers: number of processes; None for one per core.
        episodes: number of episodes of all 50 tasks together.
        max_steps: time steps of each episode.

    Returns:
        A row for each of the two: ``name``, ``workers``, ``seconds`` and ``steps_per_second``. The first includes the
        start of the processes, unless an earlier call in this process has started them.
    """
    workers, each = workers or available_cores(), max(1, episodes // len(lw.MT50))
    run: dict[str, Any] = {"episodes_per_task": each, "max_steps": max_steps, "workers": workers, "progress": False}
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(lw.load_plans("MT50"))
    with TemporaryDirectory() as folder:
        collection = timed(lambda: lw.collect_demonstrations("MT50", root=f"{folder}/demos", **run))
    evaluation = timed(lambda: lw.evaluate(actor, tasks="MT50", seed=1_000, **run))
    steps = each * len(lw.MT50) * max_steps
    return [
        {"name": name, "workers": workers, "seconds": round(seconds, 2), "steps_per_second": round(steps / seconds)}
        for name, seconds in (("collection", collection), ("evaluation", evaluation))
    ]


if __name__ == "__main__":
    torch.set_num_threads(1)
    for number in [int(argument) for argument in sys.argv[1:]] or [available_cores()]:
        for row in rows(number):
            print(json.dumps(row), flush=True)
