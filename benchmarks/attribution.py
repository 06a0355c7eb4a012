"""python -m benchmarks.attribution --policy FILE: diagnose the failures of a policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from random import Random
from time import perf_counter

import torch
import tyro

import lw_torchrl as lw
from benchmarks.any_plans import TEST
from lw_torchrl._util.checks import check_choice
from lw_torchrl.evaluation import plot_failures


@dataclass(frozen=True)
class Arguments:
    """Print how often each cause made a policy fail, and some of the failures."""

    policy: Path
    """File of the policy."""
    tasks: tuple[str, ...] = ()
    """Tasks, among the policy's; by default MT10 and the development tasks, so that failures on test tasks are not
    inspected."""
    episodes: int = 20
    """Number of episodes per task."""
    seed: int = 2000
    """Random seed of the episodes."""
    max_steps: int = 500
    """Number of steps per episode."""
    reference: str = "MT50"
    """Trusted plans: MT10, MT50, a file or a folder."""
    look_at: int = 10
    """Number of failures to list."""
    out: Path = Path("runs/attribution")
    """Folder for the results and the figure."""


def main(args: Arguments) -> None:
    actor = lw.load_actor(args.policy)
    seen = [task for task in actor.tasks if task not in TEST]
    tasks = [check_choice("tasks", task, actor.tasks) for task in args.tasks] or seen
    start = perf_counter()
    result = lw.evaluate(
        actor,
        tasks=tasks,
        episodes_per_task=args.episodes,
        seed=args.seed,
        max_steps=args.max_steps,
        stop_at_success=True,
        attribute=True,
        reference=lw.load_plans(args.reference),
    )
    result.save(args.out / "results.json", checkpoint=args.policy)
    plot_failures(result, args.out / "failures.png", title=str(args.policy))
    failures = list(result.failures or ())
    print(f"{result.failure_table()}\n{(perf_counter() - start) / 60:.1f} minutes\n\nto look at:")
    for failure in Random(args.seed).sample(failures, min(args.look_at, len(failures))):
        print(f"{failure.task}, episode {failure.episode}, at {failure.at}: {failure.cause}. {failure.why}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main(tyro.cli(Arguments))
