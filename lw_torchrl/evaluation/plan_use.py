"""PlanUse: measure how often plan steps are chosen, how often conditions hold, and where failed episodes get stuck."""

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

_AFTER = 20  # time steps after the first success that still count, as in training data
_LATE = 50  # number of final states of a failed episode that show where the episode got stuck


@dataclass
class TaskUse:
    """Statistics of a task's plan over all episodes of the task, each cut 20 time steps after its first success.

    If no skill weights were recorded, ``chosen`` is empty, and ``stuck`` counts true conditions instead.
    """

    states: int  # number of states
    true: list[float]  # for each plan step, the fraction of states in which the condition held
    chosen: list[float]  # for each plan step, the fraction of states in which its skill weight was the largest
    covered: float  # the fraction of states before the first success in which some condition held
    gaps: list[tuple[int, int, int]]  # intervals in which no condition held: episode, first and last time step
    num_true: float  # the median number of conditions that held before the first success
    stuck: list[int]  # for each plan step, the number of failed episodes that chose it most in the last 50 states
    failed: int  # number of failed episodes

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


class _Episode(NamedTuple):
    number: int
    qaf: Tensor
    chosen: Tensor | None
    before: int  # number of states before the first success
    success: bool


class PlanUse:
    """A collector of statistics on how plans are used; pass an instance to :func:`evaluate` as ``on_episode``."""

    def __init__(self, plans: AnyPlans) -> None:
        self.plans = as_plans(plans)
        self._episodes: dict[str, list[_Episode]] = {}

    def __call__(self, episode: FinishedEpisode) -> None:
        success = episode.first_success
        before, steps = success or len(episode.steps), len(self.plans[episode.task].steps)
        counted = episode.steps[: before + _AFTER]
        weights = counted.get("skill_weights", None)
        chosen = None if weights is None else weights[:, :steps].argmax(-1)
        kept = _Episode(episode.episode, counted.get("qaf")[:, :steps], chosen, before, success is not None)
        self._episodes.setdefault(episode.task, []).append(kept)

    def tasks(self) -> dict[str, TaskUse]:
        """Return the statistics of each task's plan."""
        return {task: _sum(episodes) for task, episodes in sorted(self._episodes.items())}


def _sum(episodes: list[_Episode]) -> TaskUse:
    qaf = torch.cat([episode.qaf for episode in episodes])
    steps = qaf.shape[1]
    before = torch.cat([episode.qaf[: episode.before] for episode in episodes])
    stuck, gaps = [0] * steps, []
    for episode in episodes:
        holds = episode.qaf[: episode.before].any(-1).tolist()
        stretches = [(held, [*group]) for held, group in groupby(enumerate(holds), itemgetter(1))]
        gaps += [(episode.number, group[0][0], group[-1][0]) for held, group in stretches if not held]
        if not episode.success:
            active = episode.qaf.long() if episode.chosen is None else one_hot(episode.chosen, steps)
            stuck[int(active[-_LATE:].sum(0).argmax())] += 1
    chosen = [episode.chosen for episode in episodes if episode.chosen is not None]
    counts = torch.bincount(torch.cat(chosen), minlength=steps) if len(chosen) == len(episodes) else torch.zeros(0)
    return TaskUse(
        states=len(qaf),
        true=qaf.float().mean(0).tolist(),
        chosen=(counts / len(qaf)).tolist(),
        covered=float(before.any(-1).float().mean()),
        gaps=sorted(gaps),
        num_true=float(median(before.sum(-1).tolist())),
        stuck=stuck,
        failed=sum(not episode.success for episode in episodes),
    )


def expert_use(
    plans: AnyPlans, tasks: str | Iterable[str] | None = None, *, episodes_per_task: int = 10, seed: int = 0
) -> dict[str, TaskUse]:
    """Measure how often the plans' conditions hold in the states that Meta-World's experts visit without action noise.

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
