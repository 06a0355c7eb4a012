"""How plans fare: which steps hold in which states, which were chosen, and where failed episodes got stuck."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot
from torchrl.envs import TransformedEnv

from lw_torchrl.envs.episodes import FinishedEpisode, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.tasks import resolve_tasks
from lw_torchrl.suites.metaworld.experts import ExpertActor
from lw_torchrl.transforms import QAFTransform

_AFTER = 20  # steps after the first success that still count, as in training data
_ROWS = 250  # or so, stepped together
_A_WHILE = 5  # states in which a step must have been in charge for an episode to have reached it
_LATE = 50  # the last steps of a failed episode, in which it got nowhere


@dataclass
class TaskUse:
    """How one task's plan was used, over all its episodes, to 20 steps after their first success."""

    states: int  # how many were seen
    true: list[float]  # per step of the plan, the share of states in which its condition held
    chosen: list[float]  # per step, the share of states in which it had the greatest weight; empty if no policy chose
    covered: float  # the share of the states before the first success in which some condition held
    gaps: list[tuple[int, int, int]]  # the others, as stretches: episode, first and last step of each
    num_true: float  # the median number of conditions that held, before the first success
    stuck: list[int]  # per step, in how many failed episodes it was chosen (or true) most in the last 50 steps
    furthest: list[int]  # per step, in how many failed episodes it was the last chosen (or true) in 5 states
    failed: int  # how many episodes failed

    def to_json(self) -> dict[str, Any]:
        """As plain numbers and lists."""
        return asdict(self)


class _Episode(NamedTuple):
    number: int
    qaf: Tensor
    chosen: Tensor | None
    before: int  # states before the first success
    success: bool

    def gaps(self) -> Iterator[tuple[int, int, int]]:
        zero = torch.zeros(1, dtype=torch.int32)
        none_holds = ~self.qaf[: self.before].any(-1)
        edges = torch.diff(none_holds.int(), prepend=zero, append=zero)
        for first, after in zip(*((edges == sign).nonzero().flatten().tolist() for sign in (1, -1)), strict=True):
            yield self.number, first, after - 1


class PlanUse:
    """Collects how plans are used from finished episodes: pass it to :func:`evaluate` as ``on_episode``."""

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
        """What was seen of each task."""
        return {task: _summed(seen) for task, seen in sorted(self._seen.items())}


def where_stuck(in_charge: Tensor, window: int) -> tuple[int, int]:
    """In the last ``window`` states: the step most often in charge, and the last one in charge for a while."""
    states = in_charge[-window:].sum(0)
    reached = (states >= states.max().clamp(1, _A_WHILE)).nonzero()
    return int(states.argmax()), int(reached[-1]) if len(reached) else 0


def _summed(seen: list[_Episode]) -> TaskUse:
    qaf = torch.cat([one.qaf for one in seen])
    steps = qaf.shape[1]
    before = torch.cat([one.qaf[: one.before] for one in seen])
    stuck, furthest = [0] * steps, [0] * steps
    for one in seen:
        if not one.success:
            in_charge = one.qaf.long() if one.chosen is None else one_hot(one.chosen, steps)
            stuck[where_stuck(in_charge, _LATE)[0]] += 1
            furthest[where_stuck(in_charge, len(in_charge))[1]] += 1
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
    plans: AnyPlans,
    tasks: str | Iterable[str] | None = None,
    *,
    episodes_per_task: int = 10,
    seed: int = 0,
) -> dict[str, TaskUse]:
    """Which conditions of the plans hold in the states that Meta-World's experts visit, without action noise, in some
    of the plans' tasks or all. An episode ends 20 steps after its first success.

    Example:
        >>> import lw_torchrl as lw
        >>> expert_use(lw.load_plans("MT10"), "reach", episodes_per_task=1)["reach"].covered
        1.0
    """
    use = PlanUse(plans)
    names = resolve_tasks(list(use.plans) if tasks is None else tasks)
    rows = len(names) * min(episodes_per_task, -(-_ROWS // len(names)))
    env = TransformedEnv(LanguageWorldEnv(names, num_envs=rows, seed=seed, strict=True), QAFTransform(use.plans))
    episodes = {task: range(episodes_per_task) for task in names}
    keys = ["qaf", ("next", "success")]
    for finished in run_episodes(env, ExpertActor(names), episodes, keys=keys, after_success=_AFTER):
        use(finished)
    env.close()
    return use.tasks()
