"""One step of a plan tuned alone: which one, and that the policy does elsewhere what it did."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import torch

from lw_torchrl._checks import check_choice
from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation import PlanUse, evaluate, stuck_steps, weakest_step
from lw_torchrl.evaluation.protocol import policy_of
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.residual_actor import ResidualActor

WEAKEST = "weakest"
_EPISODES = 20


def tune_step(
    start: Policy, task: str, step: int | str, *, scale: float, seed: int, progress: bool = True
) -> tuple[ResidualActor, dict[str, Any]]:
    """A residual of one step of a task's plan, and what is to be told of it, as JSON.

    Args:
        start: the policy, conditioned on plans.
        task: one of its tasks.
        step: of its plan, counted from 0; or "weakest", the one that failed episodes came to and not beyond.
        scale: how far an action can be corrected.
        seed: of 20 episodes in which the weakest is looked for.
        progress: show a progress bar of them.

    Raises:
        ValueError: the plan does not have the step; or, to find the weakest, no episode failed.
        TypeError: the policy is not conditioned on plans.
    """
    told: dict[str, Any] = {}
    if isinstance(step, str):
        check_choice("step", step, (WEAKEST,))
        use = _watch(start, task, seed, progress)
        step = weakest_step(use, task).step
        told["stuck"] = [asdict(found) for found in stuck_steps(use)]
    actor = ResidualActor(start, scale=scale, steps={task: [step]})
    assert actor.plans is not None
    chosen = actor.plans[task].steps[step]
    return actor, {"step": step, "condition": str(chosen.condition), "skill": chosen.skill, **told}


def _watch(start: Policy, task: str, seed: int, progress: bool) -> PlanUse:
    """How a policy's plan is used in episodes of a task."""
    if start.plans is None:
        raise TypeError(f"step: {type(start).__name__} is not conditioned on plans, whose steps can be tuned")
    use = PlanUse(start.plans)
    evaluate(
        start,
        tasks=task,
        episodes_per_task=_EPISODES,
        seed=seed,
        stop_at_success=True,
        progress=progress,
        also_record=["qaf", "skill_weights"],
        on_episode=use,
    )
    return use


class Elsewhere:
    """Compares a residual of some steps with its start in the states of episodes: pass it to ``evaluate`` as
    ``on_episode``, and the policy's ``in_keys`` as ``also_record``.

    Attributes:
        states: that were seen.
        outside: in which none of the steps was in force.
        changed: in which of these the two actions are not the same, bit for bit.
    """

    def __init__(self, start: Policy, policy: ResidualActor) -> None:
        self._start, self._policy = policy_of(start.eval()), policy_of(policy.eval())
        self._action, self._weight = policy.out_keys_source[0], policy.out_keys_source[2]
        self.states = self.outside = self.changed = 0

    @torch.no_grad()
    def __call__(self, episode: FinishedEpisode) -> None:
        seen = episode.steps.exclude("action", "next")
        was, now = self._start(seen.copy()), self._policy(seen.copy())
        outside = now.get(self._weight).squeeze(-1) == 0
        same = (was.get(self._action) == now.get(self._action)).all(-1)
        self.states += len(outside)
        self.outside += int(outside.sum())
        self.changed += int((outside & ~same).sum())

    def to_json(self) -> dict[str, int]:
        return {"states": self.states, "outside": self.outside, "changed": self.changed}
