"""ScriptedSkillActor: a conditional plan carried out by scripted skills, without any training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import checked, shown
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.plan_attention import check_truth
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.query_evaluator import QueryEvaluator, ReadsPlans, plans_and_evaluator
from lw_torchrl.transforms.qaf import plan_number_key


class ScriptedSkillActor(ReadsPlans, Policy):
    """Runs the skill of a true step of the plan; where none is true, that of the last step.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool, or float in [0, 1] for soft
    truth; writes ``action`` (B, 4) float32 in [-1, 1] and ``skill_weights`` (B, S) float32, which sum to 1. A step of
    soft truth is true above 0.5, whatever ``select`` is. Where an observation is NaN, so is the action.

    Args:
        plans: a plan for each task it is to act in; every step's skill is the text of a scripted one.
        select: of several true steps, "first" takes the first, "random" any, as in the paper, "mix" all, equally.
        skills: the scripted skills by text, as from :func:`load_skills`; None for the shipped ones.
        seed: of the random choice, from -2**63 to 2**64 - 1.
        evaluator: answers the conditions in the place of ``qaf``, true where positive; see :class:`QueryEvaluator`.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Raises:
        ValueError: a skill text that is no scripted skill (with the nearest), or that names objects that its task
            lacks; at call time, ``qaf`` of other steps, outside [0, 1], or, as ``qaf_plan`` tells, of other plans.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.ScriptedSkillActor(lw.load_plans("MT10"))
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, stop_at_success=True).success_once
        {'reach': 1.0}

    Source: paper sections 'Scripted Skills' and 'Conditional Plan Generation'.
    """

    @checked
    def __init__(
        self,
        plans: AnyPlans,
        select: Literal["first", "random", "mix"] = "first",
        *,
        skills: Mapping[str, ScriptedSkill] | None = None,
        seed: int = 0,
        evaluator: QueryEvaluator | None = None,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.read_plans(plans, evaluator, in_keys, out_keys, ("action", "skill_weights"))
        self.config = {"select": select, "seed": seed, "in_keys": self.own_keys, "out_keys": self.out_keys}
        if not -(2**63) <= seed < 2**64:
            raise ValueError(f"seed must be from -2**63 to 2**64 - 1, got {shown(seed)}")
        self.select = select
        self.draws = self.select == "random"
        self._skills = None if skills is None else dict(skills)
        listed: Any = {plan.definition: [step.skill for step in plan.steps] for plan in self.plans.values()}
        self.program = SkillProgram(listed, skills)
        self.tables = PlanTables(self.plans)
        self._last = self.tables.mask.sum(-1) - 1
        self._generator = torch.Generator().manual_seed(seed)

    @classmethod
    def for_plans(cls, plans: Plans, *, text_encoder: TextEncoder | None = None, **options: Any) -> ScriptedSkillActor:
        return cls(plans, **options)

    def with_plans(self, plans: AnyPlans) -> ScriptedSkillActor:
        """The same skills under other plans."""
        evaluator = None if self.evaluator is None else self.evaluator.with_plans(as_plans(plans))
        return ScriptedSkillActor(plans, skills=self._skills, evaluator=evaluator, **self.config)

    def with_evaluator(self, evaluator: QueryEvaluator) -> ScriptedSkillActor:
        """The same skills, with the conditions answered by an evaluator."""
        options = {**self.config, "in_keys": self.in_keys[:2]}
        return ScriptedSkillActor(self.plans, skills=self._skills, evaluator=evaluator, **options)

    def describe(self) -> dict[str, Any]:
        """As :meth:`Policy.describe`; :class:`TypeError` with skills of one's own, which no policy file holds."""
        if self._skills is not None:
            raise TypeError("a ScriptedSkillActor with skills of your own cannot be saved: keep their file instead")
        return super().describe()

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> ScriptedSkillActor:
        plans, evaluator = plans_and_evaluator(found, text_encoder)
        return cls(plans, evaluator=evaluator, **found["options"])

    def _weights(self, qaf: Tensor, rows: Tensor) -> Tensor:
        check_truth(qaf, (*rows.shape, self.tables.mask.shape[-1]))
        if qaf.dtype != torch.bool:
            qaf = qaf > 0.5
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

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """The weights (B, S), and the action of each step's skill (B, S, 4). With an evaluator, in the weights' place
        the plans' rows (B,) int64, and behind the actions what it reads."""
        observation, given, *rest = self.read(tensordict)
        rows = self.tables.rows(given)
        if self.evaluator is not None:
            asked = [tensordict.get(key) for key in self.evaluator.in_keys]
            return rows, self.program(observation, given), *asked
        qaf = rest[0]
        self.tables.refuse_others(tensordict.get(plan_number_key(self.in_keys[2]), None), rows)
        return self._weights(qaf, rows), self.program(observation, given)

    def act(self, *prepared: Tensor) -> tuple[Tensor, Tensor]:
        """From what :meth:`prepare` gives: action (B, 4), and the weights."""
        weights, actions, *asked = prepared
        if self.evaluator is not None:
            weights = self._weights(self.evaluator.answers(*asked) > 0, weights)
        return (weights.unsqueeze(-1) * actions).sum(-2), weights
