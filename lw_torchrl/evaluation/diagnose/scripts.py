"""Scripted skills in a policy's place: what they would do in its states, and control of part of its action."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot

from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.attention import ACTIVE_WEIGHT
from lw_torchrl.suites.metaworld.experts import ExpertActor

_REST = ScriptedSkill("", GRIPPER, gain=(0.0, 0.0, 0.0))  # stands for a text that no scripted skill has
_RULER = 1e-3  # action per metre, so small that no distance is clipped


class Scripts:
    """The scripted skills of the steps of plans, where a table of text to scripted skill has one."""

    def __init__(self, plans: Plans, table: Mapping[str, ScriptedSkill]) -> None:
        self.plans, self.table = plans, table
        self.known: dict[str, list[bool]] = {}
        skills: dict[Any, list[ScriptedSkill]] = {}
        for task, plan in plans.items():
            listed = [table.get(step.skill) for step in plan.steps]
            suitable = [one.for_task(plan.definition) if one and one.suits(plan.definition) else None for one in listed]
            self.known[task] = [one is not None for one in suitable]
            skills[plan.definition] = [one or _REST for one in suitable]
        rulers: dict[Any, list[ScriptedSkill]] = {}
        for definition, own in skills.items():
            gains: list[Any] = [tuple(_RULER if gain else 0.0 for gain in one.gain) for one in own]
            rulers[definition] = [replace(one, gain=gain, variants={}) for one, gain in zip(own, gains, strict=True)]
        self.program, self._ruler = SkillProgram(skills), SkillProgram(rulers)

    def distance(self, observation: Tensor, task_id: Tensor, step: int) -> Tensor:
        """Return the distance (T,) in metres from what a step's skill moves to its target."""
        return self._ruler(observation, task_id)[:, step, :3].norm(dim=-1) / _RULER


def attended(weights: Tensor, steps: Tensor) -> Tensor:
    """Return the active step (...): the first with most attention, ``weights`` (..., S), of ``steps`` (..., S) bool.

    It is -1 where all steps have the same weight, since no condition holds or all do.
    """
    most = weights.masked_fill(~steps, -1.0).amax(-1, keepdim=True)
    least = weights.masked_fill(~steps, 2.0).amin(-1, keepdim=True)
    first = (steps & (weights >= most - 1e-6)).int().argmax(-1)
    none = ((most - least).squeeze(-1) < 1e-3) & (steps.sum(-1) > 1)
    return torch.where(none, -1, first)


class ScriptedControl(nn.Module):
    """A policy under scripted control: its attention mixes the actions of scripted skills, wherever a step is active.

    Where the active step has no scripted skill, the action is the expert's. ``steps`` maps (task, episode) to the step
    in which scripts take control, None for all steps; ``part`` is "displacement" or "gripper", None for all.
    """

    def __init__(
        self,
        actor: Callable[[TensorDictBase], TensorDictBase],
        plans: Plans,
        scripts: Scripts,
        steps: Mapping[tuple[str, int], int] | None = None,
        part: str | None = None,
    ) -> None:
        super().__init__()
        self.actor, self.scripts = actor, scripts
        self._tables = PlanTables(plans)
        self._known = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            self._known[row, : len(plans[task].steps)] = torch.tensor(scripts.known[task])
        self._steps = None if steps is None else {(task_id(task), k): step for (task, k), step in steps.items()}
        unscripted = [task for task, known in scripts.known.items() if not all(known) and task in TASKS]
        self._expert = ExpertActor(unscripted) if unscripted else None
        numbers = torch.arange(plans.layout.action_size)
        gripper = numbers == torch.tensor(-1 if plans.layout.gripper is None else plans.layout.gripper)
        self._taken = numbers >= 0 if part is None else gripper if part == "gripper" else ~gripper

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.select("observation", "task_id", "episode", "_step", strict=False).clone()
        tensordict = self.actor(tensordict)
        action, task = tensordict.get("action"), seen.get("task_id")
        rows = self._tables.rows(task)
        mask, known = self._tables.mask.to(action.device)[rows], self._known.to(action.device)[rows]
        weights = tensordict.get("skill_weights", None)
        if weights is None:
            truth = (tensordict.get("qaf") > 0.5) & mask
            first = torch.where(truth.any(-1), truth.int().argmax(-1), mask.sum(-1) - 1)
            weights = one_hot(first, mask.shape[-1]).float()
        step = attended(weights, mask)
        replaced = step >= 0
        if self._steps is not None:
            replaced = replaced & self._has_weight(seen, weights)
        scripted = (weights * known).unsqueeze(-1) * self.scripts.program(seen.get("observation"), task)
        proper = scripted.sum(-2).to(action.dtype)
        unknown = ~known.gather(-1, step.clamp(min=0).unsqueeze(-1)).squeeze(-1)
        if self._expert is None:
            replaced = replaced & ~unknown
        elif (needed := replaced & unknown).any():
            expert = self._expert(seen.set("_step", needed).cpu()).get("action").to(action.device)
            proper = torch.where(unknown.unsqueeze(-1), expert, proper)
        taken = replaced.unsqueeze(-1) & self._taken.to(action.device)
        return tensordict.set("action", torch.where(taken, proper, action))

    def _has_weight(self, seen: TensorDictBase, weights: Tensor) -> Tensor:
        """Return (B,) bool: whether the step in which scripts take control has any weight in a row."""
        assert self._steps is not None
        episodes = zip(seen.get("task_id").tolist(), seen.get("episode").tolist(), strict=True)
        step = torch.tensor([self._steps.get(one, -1) for one in episodes], device=weights.device)
        return (weights.gather(-1, step.clamp(min=0).unsqueeze(-1)).squeeze(-1) > ACTIVE_WEIGHT) & (step >= 0)
