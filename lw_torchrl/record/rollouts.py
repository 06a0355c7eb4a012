"""Recording what a plan-conditioned policy does: one episode of each task, as a rerun file."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from tensordict.utils import NestedKey
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._files import replacing
from lw_torchrl._progress import Progress
from lw_torchrl.envs.episodes import FinishedEpisode, policy_of, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.evaluation.protocol import actor_plans, make_env, tasks_of
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollout_pages import log_rollout

_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_PLAN_KEYS = {"qaf", "skill_weights", "action_corrected"}


def run_recorded(
    actor: Any,
    tasks: str | Task | Iterable[str | Task],
    *,
    plans: Plans | None = None,
    seed: int,
    episodes: Sequence[int] = (0,),
    noise_scale: float = 0.1,
    max_steps: int = 500,
    engine: Any = "vectorized",
    progress: bool = False,
) -> list[FinishedEpisode]:
    """Episodes with all that :func:`lw_torchrl.log_rollout` shows of them, run as :func:`lw_torchrl.evaluate` does.

    The arguments are as there, but for these.

    Args:
        plans: whose queries to answer; None for the actor's own.
        episodes: indices, of each task.
        progress: show a bar where it takes longer than a second.

    Returns:
        By task, as they were given, and episode: TensorDicts of batch (T,).
    """
    answered = actor_plans(actor, plans)
    chosen = tasks_of(tasks, answered)
    base = LanguageWorldEnv(list(chosen.values()), seed=seed, max_steps=max_steps, engine=engine, strict=True)
    env = make_env(actor, answered, base)
    written = set() if answered is None else {"qaf", *actor.out_keys}
    evaluator = getattr(actor, "evaluator", None)
    asked = [] if evaluator is None else evaluator.in_keys
    bar = Progress("recording", len(chosen) * len(episodes) * max_steps, "step", show=progress)
    found = {}
    try:
        with bar, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for one in run_episodes(
                env,
                policy_of(actor.eval()),
                {task: list(episodes) for task in chosen},
                keys=list(dict.fromkeys([*_KEYS, *sorted(_PLAN_KEYS & written), *asked])),
                noise=(lambda _: (noise_scale,) * 4) if noise_scale else None,
                on_progress=bar.update,
            ):
                steps = one.steps if evaluator is None else evaluator(one.steps)
                found[one.task, one.episode] = one._replace(steps=steps)
    finally:
        env.close()
    return [found[task, episode] for task in chosen for episode in episodes]


def write_recording(
    path: str | os.PathLike[str],
    episodes: Iterable[FinishedEpisode],
    plans: Plans | None = None,
    *,
    seed: int | None = None,
    policy: str | None = None,
    tasks: Iterable[Task] = (),
) -> None:
    """Write episodes of :func:`run_recorded` to a rerun file, which is replaced whole.

    The other arguments are as for :func:`lw_torchrl.log_rollout`.
    """
    tasks = list(tasks)
    with replacing(path) as file, RerunLogger(file, exp_name=Path(path).stem) as logger:
        for one in episodes:
            log_rollout(logger, one.steps, plans, seed=seed, policy=policy, tasks=tasks)


def active_skills(episode: FinishedEpisode, plan: ConditionalPlan) -> list[tuple[str, int]]:
    """The skills, or "no condition holds", in the order in which they led (had the largest weight), with how many steps
    each did, up to the first success."""
    end = episode.first_success
    leading = episode.steps.get("skill_weights")[:end].argmax(-1).tolist()
    answered = episode.steps.get("qaf")[:end].any(-1).tolist()
    names = [plan.steps[i].skill if any_ else "no condition holds" for i, any_ in zip(leading, answered, strict=True)]
    return [(name, len(list(group))) for name, group in groupby(names)]
