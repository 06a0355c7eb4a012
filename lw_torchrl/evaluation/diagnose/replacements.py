"""Trusted parts that replace the parts of a policy: true observations, exact answers, and scripted skills."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot

from lw_torchrl._util.keys import write
from lw_torchrl.evaluation.diagnose.failure import Misled
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.attention import ACTIVE_WEIGHT
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.metaworld.experts import ExpertActor
from lw_torchrl.transforms.qaf import plan_program

EpisodeId = tuple[str, int]  # task and episode index
TRUE_OBSERVATION = "true_observation"  # the environment's observation, before any transform or module changes it
_REST = ScriptedSkill("", GRIPPER, gain=(0.0, 0.0, 0.0))  # stands in for a plan step without a scripted skill
_RULER = 1e-3  # gain (action per meter) to measure distances, so small that no action is clipped


class Perception:
    """A context manager that detects wrong observations at a policy's input, and corrects them if ``correct`` is True.

    Hooks on the policy's innermost modules see changes made by the modules around them, but not by plain functions.
    """

    def __init__(self, actor: Any, correct: bool = False) -> None:
        self.actor, self.correct = actor, correct
        self.misled: dict[tuple[int, int], Misled] = {}  # by (task id, episode), for episodes with wrong observations
        self._now: TensorDictBase | None = None
        self._hooks: list[Any] = []

    def __enter__(self) -> Perception:
        if isinstance(self.actor, nn.Module):
            self._hooks = [self.actor.register_forward_pre_hook(self._begin)]
            self._hooks += [module.register_forward_pre_hook(self._look) for module in _innermost(self.actor)]
        return self

    def __exit__(self, *_: object) -> None:
        for hook in self._hooks:
            hook.remove()

    def _begin(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        self._now = args[0].select(TRUE_OBSERVATION, "task_id", "episode", "_step", strict=False).clone()

    def _look(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        tensordict = args[0] if args and isinstance(args[0], TensorDictBase) else None
        shown = None if tensordict is None else tensordict.get("observation", None)
        true = None if self._now is None else self._now.get(TRUE_OBSERVATION, None)
        if tensordict is None or self._now is None or shown is None or true is None or shown.shape != true.shape:
            return
        error = (shown - true).abs()
        for row in (error.amax(-1) > 0).logical_and(self._now.get("_step")).nonzero().flatten().tolist():
            which = int(self._now.get("task_id")[row]), int(self._now.get("episode")[row])
            misled = Misled(float(error[row].max()), int(error[row].argmax()))
            previous = self.misled.get(which, misled)
            self.misled[which] = max(previous, misled, key=lambda each: (each.error, each.number))
        if self.correct:
            tensordict.set("observation", true.clone())


def _innermost(actor: nn.Module) -> list[nn.Module]:
    """Return the modules that map an observation to an action and contain no other such module."""

    def acts(module: nn.Module) -> bool:
        return "observation" in getattr(module, "in_keys", ()) and "action" in getattr(module, "out_keys", ())

    acting = [module for module in actor.modules() if acts(module)]
    return [each for each in acting if not any(part is not each and acts(part) for part in each.modules())] or [actor]


class TrueAnswers(QueryEvaluator):
    """A query evaluator with exact answers, whose logits are 5 for true and -5 for false."""

    def __init__(self, plans: Plans) -> None:
        super().__init__(plans)
        self.program = plan_program(plans)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        truth = self.program(tensordict.get("observation"), tensordict.get("task_id"))
        return write(tensordict, self, [truth, 10.0 * truth.to(torch.float32) - 5.0])


def own_evaluators(actor: Any) -> list[QueryEvaluator]:
    """Return the query evaluators inside a policy, except evaluators nested in another evaluator."""
    if isinstance(actor, QueryEvaluator):
        return [actor]
    children = actor.children() if isinstance(actor, nn.Module) else ()
    return list(dict.fromkeys(evaluator for child in children for evaluator in own_evaluators(child)))


def with_true_answers(actor: Any) -> Any:
    """Return a copy of the policy with exact answers instead of its evaluators, or the policy if it has none."""
    if not own_evaluators(actor):
        return actor
    other = deepcopy(actor)
    for module in list(other.modules()):
        for name, child in list(module.named_children()):
            if isinstance(child, QueryEvaluator):
                module._modules[name] = TrueAnswers(child.plans)
    return other


class Scripts:
    """The scripted skills for the steps of plans, looked up by skill text in ``table``."""

    def __init__(self, plans: Plans, table: Mapping[str, ScriptedSkill]) -> None:
        self.plans, self.table = plans, table
        self.known: dict[str, list[bool]] = {}  # for each task, whether each plan step has a scripted skill
        skills: dict[Any, list[ScriptedSkill]] = {}
        rulers: dict[Any, list[ScriptedSkill]] = {}
        for task, plan in plans.items():
            listed = [table.get(step.skill) for step in plan.steps]
            suitable = [s.for_task(plan.definition) if s and s.suits(plan.definition) else None for s in listed]
            self.known[task] = [skill is not None for skill in suitable]
            skills[plan.definition] = own = [skill or _REST for skill in suitable]
            gains: list[Any] = [tuple(_RULER if gain else 0.0 for gain in skill.gain) for skill in own]
            rulers[plan.definition] = [replace(s, gain=gain, variants={}) for s, gain in zip(own, gains, strict=True)]
        self.program, self._ruler = SkillProgram(skills), SkillProgram(rulers)

    def distance(self, observation: Tensor, task_id: Tensor, step: int) -> Tensor:
        """Return the distance (T,) in meters between what a plan step's skill moves and the skill's target."""
        return self._ruler(observation, task_id)[:, step, :3].norm(dim=-1) / _RULER


def attended(weights: Tensor, steps: Tensor) -> Tensor:
    """Return the active plan step (...) int64: the first of ``steps`` (..., S) bool with the largest weight (..., S).

    The active plan step is -1 where all plan steps have the same weight, because either no or every condition holds.
    """
    most = weights.masked_fill(~steps, -1.0).amax(-1, keepdim=True)
    least = weights.masked_fill(~steps, 2.0).amin(-1, keepdim=True)
    first = (steps & (weights >= most - 1e-6)).int().argmax(-1)
    none = ((most - least).squeeze(-1) < 1e-3) & (steps.sum(-1) > 1)
    return torch.where(none, -1, first)


class ScriptedControl(nn.Module):
    """A policy whose attention weights mix the actions of scripted skills, instead of decoding an action.

    If no plan step is active, the policy's own action is kept. If the active plan step has no scripted skill, the
    expert acts. ``steps`` maps (task, episode) to the plan step in which scripts take control (None for all plan
    steps); ``part`` is the part of the action to replace, "displacement" or "gripper" (None for both).
    """

    def __init__(
        self,
        actor: Callable[[TensorDictBase], TensorDictBase],
        plans: Plans,
        scripts: Scripts,
        steps: Mapping[EpisodeId, int] | None = None,
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
        if weights is None:  # put all the weight on the first plan step whose condition holds, otherwise on the last
            truth = (tensordict.get("qaf") > 0.5) & mask
            first = torch.where(truth.any(-1), truth.int().argmax(-1), mask.sum(-1) - 1)
            weights = one_hot(first, mask.shape[-1]).float()
        step = attended(weights, mask)
        replaced = step >= 0
        if self._steps is not None:
            # Scripts take control where the plan step to replace in the row's episode has a noticeable weight.
            episodes = zip(task.tolist(), seen.get("episode").tolist(), strict=True)
            own = torch.tensor([self._steps.get(which, -1) for which in episodes], device=action.device)
            weight = weights.gather(-1, own.clamp(min=0).unsqueeze(-1)).squeeze(-1)
            replaced = replaced & (weight > ACTIVE_WEIGHT) & (own >= 0)
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
