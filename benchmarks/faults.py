"""Faults to plant in what acts: in a plan, in a skill, in the answers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

import lw_torchrl as lw
from lw_torchrl.evaluation.explanation import attended
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables

OFFSET = 0.1  # metres, along x


def denied(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """The plan with the first clause of a step's condition denied."""
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    first, joint, rest = pairs[step][0].partition(" and ")
    first = first.replace(" is not ", " is ") if " is not " in first else first.replace(" is ", " is not ", 1)
    pairs[step] = (first + joint + rest, pairs[step][1])
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


def without(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """The plan without a step."""
    kept = [(str(one.condition), one.skill) for k, one in enumerate(plan.steps) if k != step]
    return lw.ConditionalPlan.from_pairs(plan.definition, kept)


def spoilt_skills(plans: lw.Plans, steps: Mapping[str, int]) -> Mapping[str, ScriptedSkill]:
    """The scripted skills, those of a step of each task's plan with a wrong offset."""
    table = dict(lw.load_skills())
    for plan in plans.values():
        skill = table[plan.steps[steps[plan.task]].skill].for_task(plan.task)
        x, y, z = skill.offset
        table[skill.text] = replace(skill, offset=(x + OFFSET, y, z), variants={})
    return table


class Liar(TensorDictModuleBase):
    """An evaluator that takes one condition of each task's plan for its opposite.

    Args:
        plans: the plans.
        steps: task to the condition's step; of a plan with fewer steps, counted on from its first.
    """

    def __init__(self, plans: lw.Plans, steps: Mapping[str, int]) -> None:
        super().__init__()
        self.plans, self.steps = plans, dict(steps)
        self.in_keys, self.out_keys = ["qaf", "task_id"], ["qaf"]
        self._tables = PlanTables(plans)
        self._flipped = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            self._flipped[row, self.steps.get(task, 0) % len(plans[task].steps)] = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        flipped = self._flipped[self._tables.rows(tensordict.get("task_id"))]
        return tensordict.set("qaf", tensordict.get("qaf") ^ flipped)

    def with_plans(self, plans: lw.Plans) -> Liar:
        return Liar(plans, self.steps)


class Clumsy(TensorDictModuleBase):
    """A policy that misses by 10 cm while the skill of one step of each plan is in force: it is shown the hand, or the
    goal where it moves an object, in another place. Other plans have its clumsy skill wherever they name it.

    Args:
        actor: a policy with plans.
        skills: task to the text of the skill.
    """

    def __init__(self, actor: Any, skills: Mapping[str, str]) -> None:
        super().__init__()
        self.actor, self.skills, self.plans = actor, dict(skills), actor.plans
        self.in_keys, self.out_keys, self.draws = actor.in_keys, actor.out_keys, False
        self._tables = PlanTables(self.plans)
        table = lw.load_skills()
        self._chosen = torch.zeros_like(self._tables.mask)
        self._hand = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            for number, one in enumerate(self.plans[task].steps):
                self._chosen[row, number] = one.skill == self.skills.get(task)
                known = table.get(one.skill)
                self._hand[row, number] = known is None or known.moved == GRIPPER

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = self.actor(tensordict)
        observation = tensordict.get("observation")
        rows = self._tables.rows(tensordict.get("task_id"))
        step = attended(tensordict.get("skill_weights"), self._tables.mask[rows])
        chosen, hand = self._chosen[rows, step] & (step >= 0), self._hand[rows, step]
        shown = observation.clone()
        shown[:, [0, 18]] -= OFFSET * (chosen & hand).unsqueeze(-1)
        shown[:, 36] += OFFSET * (chosen & ~hand)
        other = self.actor(tensordict.copy().set("observation", shown)).get("action")
        return tensordict.set("action", torch.where(chosen.unsqueeze(-1), other, tensordict.get("action")))

    def with_plans(self, plans: lw.Plans) -> Clumsy:
        return Clumsy(self.actor.with_plans(plans), self.skills)
