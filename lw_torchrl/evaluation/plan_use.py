"""PlanUse: which steps of a plan are true and chosen in which states, and where failed episodes get stuck."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from itertools import groupby
from operator import itemgetter
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.rollout import rollout, suite_tasks
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.suites.metaworld.experts import ExpertActor

_AFTER = 20  # steps after the first success that still count, as in training data
_A_WHILE = 5  # number of states in which a step must be active to count as reached
_LATE = 50  # the last steps of a failed episode, in which it makes no progress


@dataclass
class TaskUse:
    """How one task's plan was used in all its episodes, each up to 20 steps after its first success."""

    states: int  # number of states
    true: list[float]  # per step of the plan, the share of states in which its condition held
    chosen: list[float]  # per step, the share of states in which it had the largest weight; empty without weights
    covered: float  # the share of states before the first success in which a condition held
    gaps: list[tuple[int, int, int]]  # the uncovered stretches: episode, first and last step
    num_true: float  # the median number of conditions that held before the first success
    stuck: list[int]  # per step, the failed episodes in which it was chosen (or true) most in the last 50 steps
    furthest: list[int]  # per step, the failed episodes in which it was the last one chosen (or true) in 5 states
    failed: int  # number of failed episodes

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class _Episode(NamedTuple):
    number: int
    qaf: Tensor
    chosen: Tensor | None
    before: int  # states before the first success
    success: bool

    def gaps(self) -> list[tuple[int, int, int]]:
        stretches = groupby(enumerate(self.qaf[: self.before].any(-1).tolist()), itemgetter(1))
        gaps = [[state for state, _ in stretch] for holds, stretch in stretches if not holds]
        return [(self.number, gap[0], gap[-1]) for gap in gaps]


class PlanUse:
    """Collect how plans are used in finished episodes: pass it to :func:`evaluate` as ``on_episode``."""

    def __init__(self, plans: AnyPlans) -> None:
        self.plans = as_plans(plans)
        self._seen: dict[str, list[_Episode]] = {}

    def __call__(self, episode: FinishedEpisode) -> None:
        success = episode.first_success
        before = success or len(episode.steps)
        steps = len(self.plans[episode.task].steps)
        qaf = episode.steps.get("qaf")[: before + _AFTER, :steps]
        weights = episode.steps.get("skill_weights", None)
        chosen = None if weights is None else weights[: before + _AFTER, :steps].argmax(-1)
        one = _Episode(episode.episode, qaf, chosen, before, success is not None)
        self._seen.setdefault(episode.task, []).append(one)

    def tasks(self) -> dict[str, TaskUse]:
        """Return the use of each task's plan."""
        return {task: _summed(seen) for task, seen in sorted(self._seen.items())}


def where_stuck(active: Tensor, window: int) -> tuple[int, int]:
    """Return the step that was active most often in the last ``window`` states, and the last one active for a while."""
    states = active[-window:].sum(0)
    reached = (states >= states.max().clamp(1, _A_WHILE)).nonzero()
    return int(states.argmax()), int(reached[-1]) if len(reached) else 0


def _summed(seen: list[_Episode]) -> TaskUse:
    qaf = torch.cat([one.qaf for one in seen])
    steps = qaf.shape[1]
    before = torch.cat([one.qaf[: one.before] for one in seen])
    stuck, furthest = [0] * steps, [0] * steps
    for one in seen:
        if not one.success:
            active = one.qaf.long() if one.chosen is None else one_hot(one.chosen, steps)
            stuck[where_stuck(active, _LATE)[0]] += 1
            furthest[where_stuck(active, len(active))[1]] += 1
    chosen = [one.chosen for one in seen if one.chosen is not None]
    counts = torch.bincount(torch.cat(chosen), minlength=steps) if len(chosen) == len(seen) else torch.zeros(0)
    return TaskUse(
        states=len(qaf),
        true=qaf.float().mean(0).tolist(),
        chosen=(counts / len(qaf)).tolist(),
        covered=float(before.any(-1).float().mean()),
        gaps=sorted(gap for one in seen for gap in one.gaps()),
        num_true=float(median(before.sum(-1).tolist())),
        stuck=stuck,
        furthest=furthest,
        failed=sum(not one.success for one in seen),
    )


def expert_use(
    plans: AnyPlans, tasks: str | Iterable[str] | None = None, *, episodes_per_task: int = 10, seed: int = 0
) -> dict[str, TaskUse]:
    """Return which conditions of the plans hold in the states that Meta-World's experts visit, without action noise.

    Episodes end 20 steps after their first success.

    Example:
        >>> import lw_torchrl as lw
        >>> expert_use(lw.load_plans("MT10"), "reach", episodes_per_task=1)["reach"].covered
        1.0
    """
    use = PlanUse(plans)
    names = resolve_tasks(list(use.plans) if tasks is None else tasks)
    suite, chosen = suite_tasks(names, None)
    episodes = dict.fromkeys(names, range(episodes_per_task))
    options: dict[str, Any] = {"env_options": {"seed": seed, "suite": suite}, "keys": ["qaf", ("next", "success")]}
    expert = ExpertActor(names)
    rollout("running experts", expert, chosen, episodes, use, plans=use.plans, after_success=_AFTER, **options)
    return use.tasks()
