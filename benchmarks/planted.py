"""Faults to plant in plans, skills, policies, answers to conditions, and the simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Transform

import lw_torchrl as lw
from lw_torchrl.evaluation.diagnose.replacements import attended
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.suites.metaworld.environments import MetaWorldEngine
from lw_torchrl.transforms.qaf import plan_program

OFFSET = 0.1  # metres, along x
Shown = Callable[[Tensor, Tensor], Tensor]
Done = Callable[[TensorDictBase], Tensor]


def denied(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """Return the plan with the first clause of a step's condition negated."""
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    first, joint, rest = pairs[step][0].partition(" and ")
    first = first.replace(" is not ", " is ") if " is not " in first else first.replace(" is ", " is not ", 1)
    pairs[step] = (first + joint + rest, pairs[step][1])
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


def without(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """Return the plan without a step."""
    kept = [(str(one.condition), one.skill) for k, one in enumerate(plan.steps) if k != step]
    return lw.ConditionalPlan.from_pairs(plan.definition, kept)


def swapped(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """Return the plan with the skills of a step and the next step swapped."""
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    other = (step + 1) % len(pairs)
    pairs[step], pairs[other] = (pairs[step][0], pairs[other][1]), (pairs[other][0], pairs[step][1])
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


def with_extra(plan: lw.ConditionalPlan, step: int) -> lw.ConditionalPlan:
    """Return the plan with an additional first step: a step's condition with the skill of the step before it."""
    pairs = [(str(one.condition), one.skill) for one in plan.steps]
    extra = (pairs[step][0], pairs[step - 1][1])
    return lw.ConditionalPlan.from_pairs(plan.definition, [extra, *pairs])


def perturbed_skills(plans: lw.Plans, steps: Mapping[str, int]) -> Mapping[str, ScriptedSkill]:
    """Return the scripted skills, with a wrong offset in the skill of one step of each plan."""
    table = dict(lw.load_skills())
    for plan in plans.values():
        skill = table[plan.steps[steps[plan.task]].skill].for_task(plan.task)
        x, y, z = skill.offset
        table[skill.text] = replace(skill, offset=(x + OFFSET, y, z), variants={})
    return table


class Liar(TensorDictModuleBase):
    """An evaluator that inverts the answers to one condition of each plan, or always answers that it is false.

    Args:
        plans: the plans.
        steps: the index of the affected step for each task, modulo the number of the plan's steps.
        never: answer false instead of inverting the answers.
    """

    def __init__(self, plans: lw.Plans, steps: Mapping[str, int], never: bool = False) -> None:
        super().__init__()
        self.plans, self.steps, self.never = plans, dict(steps), never
        self.in_keys, self.out_keys = ["qaf", "task_id"], ["qaf"]
        self._tables = PlanTables(plans)
        self._flipped = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            self._flipped[row, self.steps.get(task, 0) % len(plans[task].steps)] = True

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        flipped = self._flipped[self._tables.rows(tensordict.get("task_id"))]
        answers = tensordict.get("qaf")
        return tensordict.set("qaf", answers & ~flipped if self.never else answers ^ flipped)

    def with_plans(self, plans: lw.Plans) -> Liar:
        return Liar(plans, self.steps, self.never)


class Altered(TensorDictModuleBase):
    """A wrapper that changes the observation or the action of a policy.

    Args:
        actor: the policy.
        shown: a function that maps the observation (B, 39) and task_id (B,) to the observation for the policy.
        done: a function that maps the policy's output to the new action (B, 4).
        hidden: call the policy's ``forward``, so that hooks on modules do not observe the call.
    """

    row_by_row = True  # a delay remembers the rows of one call

    def __init__(self, actor: Any, shown: Shown | None = None, done: Done | None = None, hidden: bool = False) -> None:
        super().__init__()
        self.actor, self.shown, self.done, self.hidden, self.plans = actor, shown, done, hidden, actor.plans
        self.in_keys, self.out_keys, self.draws = actor.in_keys, actor.out_keys, False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        asked, told = tensordict.copy(), tensordict.get("observation")
        if self.shown is not None:
            asked.set("observation", self.shown(told, tensordict.get("task_id")))
        act = self.actor.forward if self.hidden else self.actor
        written = act(asked).set("observation", told)
        if self.done is not None:
            written.set("action", self.done(written))
        return tensordict.update(written.select(*self.out_keys))

    def with_plans(self, plans: lw.Plans) -> Altered:
        done = self.done.with_plans(plans) if isinstance(self.done, InStep) else self.done
        return Altered(self.actor.with_plans(plans), self.shown, done, self.hidden)


class InStep:
    """A function that changes the action while a certain skill of the task is active.

    Args:
        plans: the plans.
        skills: the text of the skill for each task.
        change: a function that maps the action (B, 4) to the changed action.
    """

    def __init__(self, plans: lw.Plans, skills: Mapping[str, str], change: Callable[[Tensor], Tensor]) -> None:
        self.skills, self.change = dict(skills), change
        self._tables = PlanTables(plans)
        self._chosen = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            for number, one in enumerate(plans[task].steps):
                self._chosen[row, number] = one.skill == self.skills.get(task)

    def __call__(self, written: TensorDictBase) -> Tensor:
        rows = self._tables.rows(written.get("task_id"))
        step = attended(written.get("skill_weights"), self._tables.mask[rows])
        chosen = (self._chosen[rows, step] & (step >= 0)).unsqueeze(-1)
        return torch.where(chosen, self.change(written.get("action")), written.get("action"))

    def with_plans(self, plans: lw.Plans) -> InStep:
        return InStep(plans, self.skills, self.change)


def scaled(*factors: float) -> Callable[[Any], Tensor]:
    """Return a function that multiplies an action, or the action in a policy's output, by the factors."""
    return lambda given: _action(given) * torch.tensor(factors)


def exchanged(given: Any) -> Tensor:
    """Return the action with x and y swapped."""
    return _action(given)[:, [1, 0, 2, 3]]


def drifting(effort: float) -> Callable[[Any], Tensor]:
    """Return a function that adds ``effort`` to the action along y."""
    return lambda given: (_action(given) + torch.tensor([0.0, effort, 0.0, 0.0])).clamp(-1.0, 1.0)


def timid(given: Any) -> Tensor:
    """Return the action with its displacement to the fourth power, which suppresses small motions."""
    action = _action(given)
    return torch.cat((action[:, :3].sign() * action[:, :3].abs() ** 4, action[:, 3:]), -1)


def _action(given: Any) -> Tensor:
    return given if isinstance(given, Tensor) else given.get("action")


def fingers(effort: float) -> Done:
    """Return a function that sets the gripper effort to a constant."""

    def done(written: TensorDictBase) -> Tensor:
        action = written.get("action").clone()
        action[:, 3] = effort
        return action

    return done


def moved_thing(dx: float, dy: float) -> Shown:
    """Return a function that shifts the observed position of the first object."""

    def shown(observation: Tensor, task_id: Tensor) -> Tensor:
        return observation + _at({4: dx, 22: dx, 5: dy, 23: dy}, observation)

    return shown


def moved_goal(dx: float, dy: float) -> Shown:
    """Return a function that shifts the observed position of the goal."""
    return lambda observation, task_id: observation + _at({36: dx, 37: dy}, observation)


def late_view(steps: float) -> Shown:
    """Return a function that delays the observed positions by ``steps``, extrapolated from the last step's motion."""

    def shown(observation: Tensor, task_id: Tensor) -> Tensor:
        seen = observation.clone()
        for number in (slice(0, 3), slice(4, 7)):
            past = observation[:, number.start + 18 : number.stop + 18]
            seen[:, number] = observation[:, number] + steps * (past - observation[:, number])
        return seen

    return shown


def _at(numbers: Mapping[int, float], like: Tensor) -> Tensor:
    found = torch.zeros(like.shape[-1])
    for number, value in numbers.items():
        found[number] = value
    return found


class Sensor(Transform):
    """A transform that simulates a misplaced camera: all observed positions except the hand's are shifted, for the
    policy and for the conditions."""

    def __init__(self, plans: lw.Plans, aside: float) -> None:
        super().__init__(in_keys=["observation", "task_id"], out_keys=["observation", "qaf"])
        self.plans, self.aside, self.program = plans, aside, plan_program(plans)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        told = next_tensordict.get("observation")
        seen = told + _at({4: self.aside, 22: self.aside, 36: self.aside}, told)
        answers = self.program(seen, next_tensordict.get("task_id"))
        return next_tensordict.set("observation", seen).set("qaf", answers)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def with_plans(self, plans: lw.Plans) -> Sensor:
        return Sensor(plans, self.aside)


def turned(degrees: float) -> Callable[[Any], Tensor]:
    """Return a function that rotates the action about the vertical axis."""
    turn = torch.eye(4)
    turn[0, 0] = turn[1, 1] = math.cos(math.radians(degrees))
    turn[0, 1] = math.sin(math.radians(degrees))
    turn[1, 0] = -turn[0, 1]
    return lambda given: _action(given) @ turn


class Delayed:
    """A function that delays the action, or some of its entries, by a number of steps in each episode."""

    def __init__(self, steps: int, *entries: int) -> None:
        self.steps, self.entries = steps, list(entries)
        self._past: dict[tuple[int, int], list[Tensor]] = {}

    def __call__(self, written: TensorDictBase) -> Tensor:
        action, seen = written.get("action").clone(), written.get("observation")
        first = (seen[:, :18] == seen[:, 18:36]).all(-1)  # after a reset, the previous and the current state are equal
        rows = zip(written.get("task_id").tolist(), written.get("episode").tolist(), strict=True)
        for which, row in {which: row for row, which in enumerate(rows)}.items():
            past = self._past[which] = [] if which not in self._past or first[row] else self._past[which]
            past.append(action[row].clone())
            action[row, self.entries] = past[max(0, len(past) - 1 - self.steps)][self.entries]
        return action


class Jammed(Transform):
    """A transform that makes the simulator execute a different action: the result of ``change`` for the action (B, 4),
    or the action times four factors."""

    def __init__(self, *factors: float, change: Callable[[Tensor], Tensor] | None = None) -> None:
        super().__init__(in_keys_inv=["action"], out_keys_inv=["action"])
        self.change = scaled(*factors) if change is None else change

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        return self.change(action)


class OtherPhysics:
    """A factory of Meta-World engines with changed MuJoCo models."""

    def __init__(self, change: Callable[[Any], None]) -> None:
        self.change = change

    def __call__(self, tasks: Any, **options: Any) -> MetaWorldEngine:
        engine = MetaWorldEngine(tasks, **options)
        for env in engine._envs:
            self.change(env.model)
        return engine


def slippery(model: Any) -> None:
    model.geom_friction[:] *= 0.01


def heavy(model: Any) -> None:
    """Increase the mass and inertia of all bodies."""
    model.body_mass[:] *= 30.0
    model.body_inertia[:] *= 30.0


def stiff(model: Any) -> None:
    model.dof_frictionloss[:] += 30.0


def slack(model: Any) -> None:
    """Make the hand follow its target slowly."""
    model.eq_solref[:, 0] = 1.0


def weak_fingers(model: Any) -> None:
    model.actuator_gainprm[:, 0] *= 0.05
    model.actuator_biasprm[:] *= 0.05


def upside_down(model: Any) -> None:
    model.opt.gravity[:] = (0.0, 0.0, 5.0)
