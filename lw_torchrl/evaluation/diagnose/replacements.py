"""Trusted parts that replace the parts of a policy, and a record of what the policy was shown and what it did."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook

from lw_torchrl._util.keys import write
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.attention import ACTIVE_WEIGHT
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.metaworld.experts import ExpertActor

EpisodeId = tuple[str, int]  # task and episode index
TRUE_OBSERVATION = "true_observation"  # the environment's observation, before any transform or module changes it
SHOWN, DECIDED, COMMANDED, SCRIPTED = "shown_observation", "decided_action", "commanded_action", "scripted_action"
_REST = ScriptedSkill("", GRIPPER, gain=(0.0, 0.0, 0.0))  # stands in for a plan step without a scripted skill
_RULER = 1e-3  # gain (action per meter) to measure distances, so small that no action is clipped


class TrueAnswers(QueryEvaluator):
    """A query evaluator that keeps the environment's exact answers; its logits are 5 for true and -5 for false."""

    def __init__(self, plans: Plans) -> None:
        super().__init__(plans)
        self.in_keys = ["qaf"]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        truth = tensordict.get("qaf")
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


class Control(nn.Module):
    """A policy that records what it is shown and what it does, and that trusted parts control if requested.

    It writes the observation at the input of the policy's innermost module (``SHOWN``), that module's action
    (``DECIDED``; differs from the policy's own action, ``COMMANDED``, if a wrapper changes it), and the action of the
    scripted skills, mixed by the policy's attention weights (``SCRIPTED``; NaN without active or scripted plan step).

    Args:
        actor: the policy.
        scripts: the scripted skills of the plans that the policy follows.
        correct: show the true observation to the innermost module.
        unwrap: execute the innermost module's action.
        part: the part of the action that scripts take over: "motion", "gripper" or "all"; None for no part. If no plan
            step is active, the policy's own action is kept. If the active step has no scripted skill, the expert acts.
        steps: for each (task, episode), the only plan step in which scripts take over; None for all plan steps.
    """

    def __init__(
        self,
        actor: Callable[[TensorDictBase], TensorDictBase],
        scripts: Scripts,
        correct: bool = False,
        unwrap: bool = False,
        part: str | None = None,
        steps: Mapping[EpisodeId, int] | None = None,
    ) -> None:
        super().__init__()
        self.actor, self.scripts, self.correct, self.unwrap = actor, scripts, correct, unwrap
        self.row_by_row = bool(getattr(actor, "row_by_row", False))
        plans = scripts.plans
        self._tables = PlanTables(plans)
        self._known = torch.zeros_like(self._tables.mask)
        for row, task in enumerate(self._tables.index.tasks):
            self._known[row, : len(plans[task].steps)] = torch.tensor(scripts.known[task])
        self._steps = None if steps is None else {(task_id(task), k): step for (task, k), step in steps.items()}
        unscripted = [task for task, known in scripts.known.items() if not all(known) and task in TASKS]
        self._expert = ExpertActor(unscripted) if unscripted and part is not None else None
        gripper = gripper_of(plans)
        self._taken = {None: gripper & ~gripper, "gripper": gripper, "motion": ~gripper}.get(part, gripper | True)
        self._innermost: dict[nn.Module, bool] = {}
        self._calls: list[tuple[Tensor, Tensor]] = []  # what innermost modules were shown and decided
        self._true: Tensor | None = None
        self._shown = torch.empty(0)
        self._inside: list[nn.Module] = []  # the innermost module while it runs

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        true, observation, task = (tensordict.get(key).clone() for key in (TRUE_OBSERVATION, "observation", "task_id"))
        seen = tensordict.select("observation", "task_id", "episode", "_step", strict=False).clone()
        self._true, self._calls = true, []
        if self.correct:
            tensordict.set("observation", true.clone())
        hooks = [register_module_forward_pre_hook(self._correct), register_module_forward_hook(self._look)]
        try:
            tensordict = self.actor(tensordict)
        finally:
            self._true, self._inside = None, []
            for hook in hooks:
                hook.remove()
        action = tensordict.get("action")
        # The members of an ensemble decide together, so that no single one of their actions is to be executed.
        shown, decided = self._calls[0] if self._calls else (observation, action)
        decided = decided if len(self._calls) == 1 else action
        weights, scripted, step = self._script(tensordict, seen.get("observation"), task)
        tensordict.update({SHOWN: shown, DECIDED: decided, COMMANDED: action.clone(), SCRIPTED: scripted})
        replaced = step >= 0
        if self._steps is not None:
            # Scripts take control where the plan step to replace in the row's episode has a noticeable weight.
            episodes = zip(task.tolist(), seen.get("episode").tolist(), strict=True)
            own = torch.tensor([self._steps.get(which, -1) for which in episodes], device=action.device)
            weight = weights.gather(-1, own.clamp(min=0).unsqueeze(-1)).squeeze(-1)
            replaced = replaced & (weight > ACTIVE_WEIGHT) & (own >= 0)
        unknown = replaced & scripted.isnan().any(-1)
        if self._expert is not None and unknown.any():
            expert = self._expert(seen.set("_step", unknown).cpu()).get("action").to(action.device)
            scripted = torch.where(unknown.unsqueeze(-1), expert, scripted)
        taken = (replaced & ~scripted.isnan().any(-1)).unsqueeze(-1) & self._taken.to(action.device)
        return tensordict.set("action", torch.where(taken, scripted, decided if self.unwrap else action))

    def _script(self, written: TensorDictBase, observation: Tensor, task: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weights (B, S) of the plan steps, the scripts' action (B, A), and the active plan step (B,)."""
        rows = self._tables.rows(task)
        mask, known = self._tables.mask.to(task.device)[rows], self._known.to(task.device)[rows]
        weights = written.get("skill_weights", None)
        if weights is None:  # put all the weight on the first plan step whose condition holds, otherwise on the last
            truth = (written.get("qaf") > 0.5) & mask
            first = torch.where(truth.any(-1), truth.int().argmax(-1), mask.sum(-1) - 1)
            weights = one_hot(first, mask.shape[-1]).float()
        step = attended(weights, mask)
        unscripted = (step < 0) | ~known.gather(-1, step.clamp(min=0).unsqueeze(-1)).squeeze(-1)
        scripted = ((weights * known).unsqueeze(-1) * self.scripts.program(observation, task)).sum(-2)
        scripted = scripted.to(written.get("action").dtype)
        return weights, scripted.masked_fill(unscripted.unsqueeze(-1), torch.nan), step

    def _watched(self, module: nn.Module, tensordict: Any) -> bool:
        """Return whether a module is a whole policy: it acts, and it is our own or contains no other one that acts."""
        if self._true is None or not isinstance(tensordict, TensorDictBase):
            return False
        if module not in self._innermost:
            inner = [] if type(module).__module__.startswith("lw_torchrl.") else [*module.modules()][1:]
            self._innermost[module] = _acts(module) and not any(map(_acts, inner))
        shown = tensordict.get("observation", None) if self._innermost[module] else None
        return shown is not None and shown.shape == self._true.shape

    def _correct(self, module: nn.Module, args: tuple[Any, ...]) -> None:
        if not self._inside and args and self._watched(module, args[0]):
            assert self._true is not None
            self._inside, self._shown = [module], args[0].get("observation").clone()
            if self.correct:
                args[0].set("observation", self._true.clone())

    def _look(self, module: nn.Module, args: tuple[Any, ...], output: Any) -> None:
        if self._inside and module is self._inside[0]:
            self._inside = []
            if isinstance(output, TensorDictBase):
                self._calls.append((self._shown, output.get("action").clone()))


def gripper_of(plans: Plans) -> Tensor:
    """Return (A,) bool: which entry of an action is the gripper's."""
    numbers = torch.arange(plans.layout.action_size)
    return numbers == (-1 if plans.layout.gripper is None else plans.layout.gripper)


def _acts(module: nn.Module) -> bool:
    """Return whether a module maps an observation to an action."""
    return "observation" in getattr(module, "in_keys", ()) and "action" in getattr(module, "out_keys", ())
