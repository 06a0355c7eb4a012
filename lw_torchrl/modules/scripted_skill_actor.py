"""ScriptedSkillActor: a conditional plan carried out by scripted skills, without any training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from lw_torchrl._checks import check_choice
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import TaskIndex


class ScriptedSkillActor(TensorDictModuleBase):
    """Runs the skill of a true step of the plan; where none is true, that of the last step.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool, or float in [0, 1] for soft
    truth; writes ``action`` (B, 4) float32 in [-1, 1] and ``skill_weights`` (B, S) float32, which sum to 1. A step of
    soft truth is true above 0.5, whatever ``select`` is, as its hard truth would be.

    Args:
        plans: a plan for each task it is to act in; every step's skill is the text of a scripted one.
        select: of several true steps, "first" takes the first, "random" any, the paper's way, and "mix" all of
            them, in equal parts.
        skills: the scripted skills by text, as from :func:`load_skills`; None for the shipped ones.
        seed: of the random choice.

    Raises:
        ValueError: a wrong option, a skill text that is no scripted skill (with the nearest), or one that speaks of
            objects that its task lacks.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.ScriptedSkillActor(lw.load_plans("MT10"))
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, stop_at_success=True).success_once
        {'reach': 1.0}

    Source: paper sections 'Scripted Skills' and 'Conditional Plan Generation'.
    """

    in_keys = ["observation", "task_id", "qaf"]
    out_keys = ["action", "skill_weights"]

    def __init__(
        self,
        plans: Plans | Mapping[str, ConditionalPlan],
        select: Literal["first", "random", "mix"] = "first",
        *,
        skills: Mapping[str, ScriptedSkill] | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.plans = as_plans(plans)
        self.select = check_choice("select", select, ("first", "random", "mix"))
        self._skills = skills
        self.program = SkillProgram(
            {plan.definition: [step.skill for step in plan.steps] for plan in self.plans.values()}, skills
        )
        self.index = TaskIndex(self.plans)
        last = torch.tensor([len(self.plans[task].steps) - 1 for task in self.index.tasks])
        self._last = last
        self._generator = torch.Generator().manual_seed(seed)

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> ScriptedSkillActor:
        """The same skills under other plans."""
        return ScriptedSkillActor(plans, self.select, skills=self._skills, seed=self._generator.initial_seed())

    def _weights(self, qaf: Tensor, task_id: Tensor) -> Tensor:
        if qaf.dtype != torch.bool:
            qaf = qaf > 0.5
        rows = self.index.rows(task_id, f"tasks without a plan in {self.plans!r}")
        last = torch.nn.functional.one_hot(self._last.to(rows.device)[rows], qaf.shape[-1]).bool()
        true = torch.where(qaf.any(-1, keepdim=True), qaf, last).float()
        if self.select == "mix":
            return true / true.sum(-1, keepdim=True)
        if self.select == "first":
            chosen = true.argmax(-1)
        else:
            score = torch.rand(true.shape, generator=self._generator).to(true.device) + true
            chosen = score.argmax(-1)
        return torch.nn.functional.one_hot(chosen, qaf.shape[-1]).float()

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        observation, given, qaf = (tensordict.get(key) for key in self.in_keys)
        weights = self._weights(qaf, given)
        actions = self.program(observation, given)
        tensordict.set("skill_weights", weights)
        return tensordict.set("action", (weights.unsqueeze(-1) * actions).sum(-2))
