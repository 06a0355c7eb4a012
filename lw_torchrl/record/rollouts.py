"""Recording what a plan-conditioned policy does: one episode of each task, as a rerun file."""

from __future__ import annotations

import os
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey

from lw_torchrl._files import replacing
from lw_torchrl.envs.episodes import policy_of, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.evaluation.protocol import make_env, tasks_of
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.policy import Policy, plans_of
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollout_pages import log_rollout

_KEYS: list[NestedKey] = ["observation", "task_id", "episode", "action", ("next", "success"), ("next", "reward")]
_PLAN_KEYS = {"qaf", "skill_weights", "action_corrected"}


def rollout_tasks(
    actor: Policy,
    tasks: str | Task | Iterable[str | Task],
    *,
    seed: int,
    episode: int = 0,
    noise_scale: float = 0.1,
    max_steps: int = 500,
    engine: Any = "vectorized",
) -> dict[str, TensorDictBase]:
    """One episode of each task, the same as :func:`lw_torchrl.evaluate` runs it.

    Returns:
        Task to a TensorDict of batch (T,): observation (T, 39) and action (T, 4) float32, the executed one, task_id and
        episode (T,) int64, next/success (T, 1) bool, next/reward (T, 1) float32; where the actor has plans qaf (T, S)
        bool, and skill_weights (T, S) and action_corrected (T, 1) float32 where it writes them; where it has an
        evaluator of queries, its qaf_logits (T, S) float32.
    """
    chosen = tasks_of(tasks, plans_of(actor))
    base = LanguageWorldEnv(list(chosen.values()), seed=seed, max_steps=max_steps, engine=engine, strict=True)
    env = make_env(actor, plans_of(actor), base)
    written = {"qaf", *actor.out_keys} if plans_of(actor) is not None else set()
    evaluator = getattr(actor, "evaluator", None)
    asked = [] if evaluator is None else evaluator.in_keys
    try:
        with torch.no_grad():
            return {
                found.task: found.steps if evaluator is None else evaluator(found.steps)
                for found in run_episodes(
                    env,
                    policy_of(actor.eval()),
                    {task: [episode] for task in chosen},
                    keys=list(dict.fromkeys([*_KEYS, *sorted(_PLAN_KEYS & written), *asked])),
                    noise=(lambda _: (noise_scale,) * 4) if noise_scale else None,
                )
            }
    finally:
        env.close()


def write_recording(
    path: str | os.PathLike[str],
    actor: Policy,
    rollouts: dict[str, TensorDictBase],
    *,
    seed: int | None = None,
    policy: str | None = None,
) -> None:
    """Write rollouts to a rerun file, each with its plan where there is one; the file is replaced whole.

    Args:
        path: the .rrd file.
        actor: whose plans and tasks they are.
        rollouts: task to rollout, as from :func:`rollout_tasks`.
        seed: that they were run with; None draws a hand over a table in the place of the robot.
        policy: who acted, in a word.
    """
    definitions = [definition for task in rollouts if (definition := actor.definition(task)) is not None]
    with replacing(path) as file, RerunLogger(file, exp_name=Path(path).stem) as logger:
        for rollout in rollouts.values():
            log_rollout(logger, rollout, actor.plans, seed=seed, policy=policy, tasks=definitions)


def active_skills(rollout: TensorDictBase, plan: ConditionalPlan) -> list[tuple[str, int]]:
    """The skills in the order in which they led, with how many steps each did, up to the first success.

    A skill leads where it has the largest weight; steps in which no condition holds count as "no condition holds".
    """
    success = rollout.get(("next", "success")).flatten().nonzero().flatten()
    end = int(success[0]) + 1 if len(success) else rollout.batch_size[0]
    leading = rollout.get("skill_weights")[:end].argmax(-1).tolist()
    answered = rollout.get("qaf")[:end].any(-1).tolist()
    names = [plan.steps[i].skill if any_ else "no condition holds" for i, any_ in zip(leading, answered, strict=True)]
    return [(name, len(list(group))) for name, group in groupby(names)]
