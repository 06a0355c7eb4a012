"""ScriptedSkillActor: a policy that executes conditional plans with scripted skills, without training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torch.nn.functional import one_hot

from lw_torchrl._util.checks import typed
from lw_torchrl._util.keys import Keys, dispatched, read, write
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.modules.parts import Part, in_mode_of
from lw_torchrl.transforms.qaf import read_truth


class ScriptedSkillActor(Part):
    """A policy that executes plans with scripted skills.

    At each time step, the actor executes the skill of a plan step whose condition is true, or the skill of the last
    plan step if no condition is true.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool, or float in [0, 1] for soft
    truth; writes ``action`` (B, 4) float32 in [-1, 1] and ``skill_weights`` (B, S) float32, whose rows sum to 1. Soft
    truth above 0.5 counts as true. If an observation is NaN, the action is NaN.

    Args:
        plans: a plan for each task; every step's skill must be the text of a scripted skill.
        select: which skill acts if several steps are true: "first", "random" (as in the paper), or "mix" (the mean).
        skills: a mapping from text to scripted skill, see :func:`load_skills`; None for the shipped skills.
        seed: seed of the random choice, from -2**63 to 2**64 - 1.
        in_keys, out_keys: replacements for the default keys, in the order above; nested keys are allowed.

    Raises:
        ValueError: a skill text is unknown (the message suggests the nearest) or names objects that the task lacks; at
            call time, ``qaf`` has the wrong number of steps or values outside [0, 1], or belongs to other plans.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.ScriptedSkillActor(lw.load_plans("MT10"))
        >>> lw.evaluate(actor, tasks="reach", episodes_per_task=2, seed=1_000, stop_at_success=True).success_once
        {'reach': 1.0}

    Source: paper sections 'Scripted Skills' and 'Conditional Plan Generation'.
    """

    _options = ("plans", "select", "seed")

    @typed
    def __init__(
        self,
        plans: AnyPlans,
        select: Literal["first", "random", "mix"] = "first",
        *,
        skills: Mapping[str, ScriptedSkill] | None = None,
        seed: int = 0,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(("observation", "task_id", "qaf"), ("action", "skill_weights"), in_keys, out_keys)
        self.plans = as_plans(plans)
        self.tasks, self.layout = tuple(self.plans), self.plans.layout
        self.select, self.seed, self.draws = select, seed, select == "random"
        self._skills = None if skills is None else dict(skills)
        texts: Any = {plan.definition: [step.skill for step in plan.steps] for plan in self.plans.values()}
        self.program = SkillProgram(texts, skills)
        self.tables = PlanTables(self.plans)
        self._last = self.tables.mask.sum(-1) - 1
        self._generator = torch.Generator().manual_seed(seed)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module. Raises a :class:`TypeError` for custom skills."""
        if self._skills is not None:
            raise TypeError("a ScriptedSkillActor with custom skills cannot be saved; save the skills file instead")
        return super().config

    @property
    def truth_keys(self) -> tuple[NestedKey, NestedKey]:
        """The keys of the conditions' truth values and of the task id."""
        return self.in_keys[2], self.in_keys[1]

    @property
    def observation_key(self) -> NestedKey:
        """The key of the observation."""
        return self.in_keys[0]

    def with_plans(self, plans: AnyPlans) -> ScriptedSkillActor:
        """Return an actor that has the same skills but follows other plans."""
        options = {**super().config, "plans": plans, "skills": self._skills}
        return in_mode_of(self, ScriptedSkillActor(**options))

    def skill_weights(self, tensordict: TensorDictBase) -> Tensor:
        """Return the weight of each plan step, (B, S) float32."""
        qaf, rows = read_truth(tensordict, self.truth_keys, self.tables)
        qaf, steps = qaf > 0.5, qaf.shape[-1]
        last = one_hot(self._last.to(rows.device)[rows], steps).bool()
        active = torch.where(qaf.any(-1, keepdim=True), qaf, last).float()
        if self.select == "mix":
            return active / active.sum(-1, keepdim=True)
        # Noise in [0, 1) orders the active steps at random, and never ranks an inactive step above an active step.
        if self.draws:
            active += torch.rand(active.shape, generator=self._generator, dtype=torch.float32).to(active.device)
        return one_hot(active.argmax(-1), steps).float()

    def skill_actions(self, tensordict: TensorDictBase) -> Tensor:
        """Return the action of each plan step's skill, (B, S, A) float32."""
        observation, task_id, _ = read(tensordict, self.in_keys)
        return self.program(observation, task_id)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        weights = self.skill_weights(tensordict)
        action = (weights.unsqueeze(-1) * self.skill_actions(tensordict)).sum(-2)
        return write(tensordict, self, [action, weights])
