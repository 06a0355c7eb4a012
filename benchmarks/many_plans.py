"""evaluate_plans: execute many plans for the same tasks with scripted skills, in one batched simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from lw_torchrl.envs.episodes import FinishedEpisode
from lw_torchrl.evaluation.rollout import ROWS, rollout
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import TaskIndex
from lw_torchrl.language.tasks import task_ids
from lw_torchrl.suites.suite import Suite, find_suite

_PLACE = "place"


def evaluate_plans(
    plans: Sequence[ConditionalPlan],
    *,
    episodes: int = 20,
    seed: int,
    choose: Literal["random", "first"] = "random",
    skills: Mapping[str, ScriptedSkill] | None = None,
    noise_scale: float = 0.0,
    max_steps: int | None = None,
    suite: str | Suite | None = None,
    num_envs: int = ROWS,
    num_threads: int | None = None,
    progress: bool = True,
    on_plan: Callable[[int, tuple[bool, ...]], object] | None = None,
) -> list[tuple[bool, ...]]:
    """Execute many plans with scripted skills, and return for each plan whether it succeeded in each episode.

    Several plans may belong to the same task. All plans of a task start from the same initial states. The result does
    not depend on ``num_envs`` or on the other plans. If no condition is true, the last step's skill acts.

    Args:
        plans: plans whose steps have scripted skills, such as ``DecodedPlan.scripted``.
        episodes: number of episodes of each plan; an episode ends at its first success.
        seed: random seed of the environment and of the choice among true steps.
        choose: which step acts if several conditions are true: a "random" one at each time step, as in the paper, or
            the "first".
        skills: the scripted skills by text; None for the shipped skills, :func:`~lw_torchrl.load_skills`.
        noise_scale, max_steps, suite, num_envs, num_threads, progress: as for :func:`evaluate`.
        on_plan: called with the index of a plan and its successes when all its episodes have ended.

    Source: paper section 'LLM Experiments', 'Scripted Skills'.
    """
    if not plans:
        raise ValueError("plans must contain at least one plan, got none")
    by_task: dict[str, dict[str, list[int]]] = {}  # for each task, the indices of the plans with each fingerprint
    for index, plan in enumerate(plans):
        by_task.setdefault(plan.task, {}).setdefault(Plans([plan]).fingerprint, []).append(index)
    equal = {task: list(found.values()) for task, found in by_task.items()}
    different = {task: [plans[same[0]] for same in found] for task, found in equal.items()}
    policy = _PlanOfRow(different, episodes, seed, choose, skills)
    suite = find_suite(list(different), suite)
    won: dict[int, dict[int, bool]] = {index: {} for index in range(len(plans))}

    def in_order(index: int) -> tuple[bool, ...]:
        return tuple(won[index][episode] for episode in range(episodes))

    def keep(one: FinishedEpisode) -> None:
        for index in equal[one.task][int(one.steps.get(_PLACE)[0]) // episodes]:
            won[index][one.episode] = one.first_success is not None
            if len(won[index]) == episodes and on_plan is not None:
                on_plan(index, in_order(index))

    rollout(
        "executing plans",
        policy,
        {task: suite.tasks.get(task, listed[0].definition) for task, listed in different.items()},
        {task: list(range(episodes)) * len(listed) for task, listed in different.items()},
        keep,
        num_envs=max(len(different), num_envs),
        env_options={"suite": suite, "seed": seed, "max_steps": max_steps, "num_threads": num_threads},
        keys=[_PLACE, ("next", "success")],
        noise_scale=noise_scale,
        after_success=0,
        place=_PLACE,
        progress=progress,
    )
    return [in_order(index) for index in range(len(plans))]


class _PlanOfRow(nn.Module):
    """A policy that follows a different plan in each row, selected by the episode's position in the task's list.

    The list contains the episodes of the task's first plan, then those of the second plan, and so on.
    """

    row_by_row = True

    def __init__(
        self, plans: Mapping[str, Sequence[ConditionalPlan]], episodes: int, seed: int, choose: str, skills: Any
    ) -> None:
        super().__init__()
        self.episodes, self.seed, self.random = episodes, seed, choose == "random"
        self._index = TaskIndex(task_ids(plans))
        conditions: dict[Any, list[Any]] = {}
        texts: dict[Any, list[str]] = {}
        first: dict[str, int] = {}
        rows: list[Tensor] = []
        for task, listed in plans.items():
            definition, first[task] = listed[0].definition, len(rows)
            if any(plan.definition != definition for plan in listed):
                raise ValueError(f"plans of {task!r} must have the same task definition, got different definitions")
            asked = list(dict.fromkeys(step.condition for plan in listed for step in plan.steps))
            done = list(dict.fromkeys(step.skill for plan in listed for step in plan.steps))
            conditions[definition], texts[definition] = asked, done
            for plan in listed:
                steps = [(asked.index(step.condition), done.index(step.skill), 1) for step in plan.steps]
                rows.append(torch.tensor(steps))
        self._condition, self._skill, there = pad_sequence(rows, batch_first=True).unbind(-1)
        self._step, self._last = there.bool(), there.sum(-1) - 1
        self._first = torch.tensor([first[task] for task in self._index.tasks])
        numbers = [Plans([plan]).numbers[task] for task, listed in plans.items() for plan in listed]
        self._number = np.array(numbers, dtype=np.uint64)
        self.queries, self.skills = QueryProgram(conditions), SkillProgram(texts, skills)
        self._before = self._steps_done = torch.zeros(0, dtype=torch.int64)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, task_id, place = (tensordict.get(key) for key in ("observation", "task_id", _PLACE))
        plan = self._first[self._index.rows(task_id, "tasks without a plan")] + place // self.episodes
        truth = self.queries(observation, task_id).gather(-1, self._condition[plan]) & self._step[plan]
        chosen = self._choose(truth, plan, place)
        chosen = torch.where(truth.any(-1), chosen, self._last[plan])
        skill = self._skill[plan].gather(-1, chosen.unsqueeze(-1))
        actions = self.skills(observation, task_id)
        action = actions.gather(-2, skill.unsqueeze(-1).expand(*skill.shape, actions.shape[-1])).squeeze(-2)
        return tensordict.set("action", action)

    def _choose(self, truth: Tensor, plan: Tensor, place: Tensor) -> Tensor:
        if not self.random:
            return truth.int().argmax(-1)
        if len(self._before) != len(place):
            self._before, self._steps_done = torch.full_like(place, -1), torch.zeros_like(place)
        self._steps_done = torch.where(place == self._before, self._steps_done + 1, 0)
        self._before = place.clone()
        episode = (place % self.episodes).numpy().astype(np.uint64)
        found = _drawn(self.seed, self._number[plan.numpy()], episode, self._steps_done.numpy().astype(np.uint64))
        ranks = _drawn(found[:, None], np.arange(truth.shape[-1], dtype=np.uint64)[None])
        return (torch.from_numpy((ranks >> np.uint64(12)).astype(np.int64)) + 1).masked_fill(~truth, 0).argmax(-1)


def _drawn(*keys: int | NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return pseudorandom numbers uint64 that depend only on the keys, of their broadcast shape (splitmix64)."""
    found = np.zeros(1, dtype=np.uint64)
    for key in keys:
        found = found ^ (np.uint64(key % 2**64) if isinstance(key, int) else key)
        found = found + np.uint64(0x9E3779B97F4A7C15)
        for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
            found = (found ^ (found >> np.uint64(shift))) * np.uint64(factor)
        found = found ^ (found >> np.uint64(31))
    return found
