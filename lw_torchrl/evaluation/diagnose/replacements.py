"""Trusted parts that replace parts of a policy, and a wrapper that records the policy's observations and actions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn.functional import one_hot
from torch.nn.modules.module import register_module_forward_hook, register_module_forward_pre_hook
from torch.nn.utils.rnn import pad_sequence

from lw_torchrl._util.keys import write
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.suites.metaworld.experts import ExpertActor
from lw_torchrl.transforms.augmentation import ACTIVE_WEIGHT

EpisodeId = tuple[str, int]  # task and episode index
TRUE_OBSERVATION = "true_observation"  # the environment's observation, before any transform or module changes it
MEASURED = "measured"  # the key under which Control records observations, answers and actions
_REST = ScriptedSkill("", GRIPPER, gain=(0.0, 0.0, 0.0))  # stands in for a plan step without a scripted skill


class Scripts:
    """The scripted skills for the steps of plans, looked up by skill text in ``table``."""

    def __init__(self, plans: Plans, table: Mapping[str, ScriptedSkill]) -> None:
        self.plans, self.table, self.tables = plans, table, PlanTables(plans)
        self.skills: dict[str, list[ScriptedSkill | None]] = {}  # for each task; None for a step without a script
        for task, plan in plans.items():
            owner, listed = plan.definition, [table.get(step.skill) for step in plan.steps]
            self.skills[task] = [skill.for_task(owner) if skill and skill.suits(owner) else None for skill in listed]
        self.program = SkillProgram({plans[t].definition: [s or _REST for s in own] for t, own in self.skills.items()})
        # (tasks, S) bool, whether a step has a script
        self.known = pad_sequence([self.has_script(task) for task in self.tables.index.tasks], batch_first=True)

    def has_script(self, task: str) -> Tensor:
        """Return whether each step of a task's plan has a scripted skill, (S,) bool."""
        return torch.tensor([skill is not None for skill in self.skills[task]])

    def distance(self, task: str, step: int, observation: Tensor) -> float | None:
        """Return the metres from a plan step's moved object to its target in a state (D,); None without a script."""
        if (skill := self.skills[task][step]) is None:
            return None
        positions = self.plans[task].definition.positions(observation)
        error = positions[skill.target] + torch.tensor(skill.offset) - positions[skill.moved]
        return float(error[torch.tensor(skill.gain) > 0].norm())


def chosen(truth: Tensor, number: Tensor | int) -> Tensor:
    """Return the first plan step (...) whose condition holds in ``truth`` (..., S) bool, or else ``number`` - 1."""
    return torch.where(truth.any(-1), truth.int().argmax(-1), number - 1)


def weights_of(written: TensorDictBase, truth: Tensor, number: Tensor | int) -> Tensor:
    """Return a policy's attention (..., S) float32, or all attention on the chosen step if the policy wrote none."""
    weights: Tensor | None = written.get("skill_weights", None)
    steps = truth.shape[-1]
    return one_hot(chosen(truth, number), steps).float() if weights is None else weights[..., :steps]


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
    """A wrapper that records a policy's observations and actions, and can replace parts of the policy by trusted parts.

    Each call adds a nested TensorDict "measured" with six entries. "true" is the environment's observation, and "shown"
    is the observation that the innermost module (the policy inside all wrappers) receives. "answered" holds the answers
    that the policy acts on. "decided" is the innermost module's action, and "commanded" is the action of the whole
    policy, including changes by wrappers. "scripted" is the sum of the scripted skills' actions, weighted by the
    policy's attention; NaN if no plan step is active or the active plan step has no scripted skill.

    Args:
        actor: the policy.
        scripts: the scripted skills of the plans that the policy follows.
        correct: pass the true observation to the innermost module.
        answer: replace the answers of query evaluators inside the policy with the environment's exact answers.
        unwrap: return the innermost module's action instead of the whole policy's.
        part: the part of the action that scripts take over: "motion", "gripper" or "all"; None for no part. If no plan
            step is active, the policy's own action is kept. If the active step has no scripted skill, the expert acts.
        steps: for each (task, episode), the only plan step in which scripts take over; None for all plan steps.
    """

    def __init__(
        self,
        actor: Callable[[TensorDictBase], TensorDictBase],
        scripts: Scripts,
        correct: bool = False,
        answer: bool = False,
        unwrap: bool = False,
        part: str | None = None,
        steps: Mapping[EpisodeId, int] | None = None,
    ) -> None:
        super().__init__()
        self.actor, self.scripts, self.correct, self.answer, self.unwrap = actor, scripts, correct, answer, unwrap
        self.row_by_row = bool(getattr(actor, "row_by_row", False))
        self._steps = None if steps is None else {(task_id(task), k): step for (task, k), step in steps.items()}
        unscripted = [task for task, skills in scripts.skills.items() if None in skills and task in TASKS]
        self._expert = ExpertActor(unscripted) if unscripted and part is not None else None
        gripper = gripper_of(scripts.plans)
        self._taken = {None: gripper & ~gripper, "gripper": gripper, "motion": ~gripper}.get(part, gripper | True)
        self._innermost: dict[nn.Module, bool] = {}

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        true, task = tensordict.get(TRUE_OBSERVATION).clone(), tensordict.get("task_id").clone()
        seen = tensordict.select("observation", "task_id", "episode", "_step", strict=False).clone()
        if self.correct:
            tensordict.set("observation", true.clone())
        with self._watching(true, tensordict.get("qaf").clone()) as (calls, answers):
            tensordict = self.actor(tensordict)
        action = tensordict.get("action")
        # An ensemble has several innermost modules. None of their actions is meant to be executed by itself.
        shown, decided = calls[0] if calls else (seen.get("observation"), action)
        decided = decided if len(calls) == 1 else action
        weights, scripted, step = self._script(tensordict, seen.get("observation"), task)
        answered = torch.stack(answers).mean(0) if answers else tensordict.get("qaf").float()
        measured = {"true": true, "shown": shown, "answered": answered, "decided": decided, "scripted": scripted}
        tensordict.set(MEASURED, {**measured, "commanded": action.clone()})
        replaced = step >= 0
        if self._steps is not None:
            # Scripts take control in the rows in which the plan step to replace has a noticeable weight.
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
        rows = self.scripts.tables.rows(task)
        mask, known = (table.to(task.device)[rows] for table in (self.scripts.tables.mask, self.scripts.known))
        weights = weights_of(written, (written.get("qaf") > 0.5) & mask, mask.sum(-1))
        step = attended(weights, mask)
        unscripted = (step < 0) | ~known.gather(-1, step.clamp(min=0).unsqueeze(-1)).squeeze(-1)
        scripted = ((weights * known).unsqueeze(-1) * self.scripts.program(observation, task)).sum(-2)
        scripted = scripted.to(written.get("action").dtype)
        return weights, scripted.masked_fill(unscripted.unsqueeze(-1), torch.nan), step

    @contextmanager
    def _watching(self, true: Tensor, truth: Tensor) -> Iterator[tuple[list[tuple[Tensor, Tensor]], list[Tensor]]]:
        """Record each innermost policy's observations and actions, and the answers of query evaluators.

        If ``correct``, the policies receive the observation ``true`` instead of their own. If ``answer``, the
        evaluators return the answers ``truth``.
        """
        calls: list[tuple[Tensor, Tensor]] = []
        answers: list[Tensor] = []
        running: list[tuple[nn.Module, Tensor]] = []  # the innermost policy while it runs, and its observation

        def before(module: nn.Module, args: tuple[Any, ...]) -> None:
            seen = args[0] if args else None
            if running or not isinstance(seen, TensorDictBase) or not self._is_innermost(module):
                return
            shown = seen.get("observation", None)
            if shown is not None and shown.shape == true.shape:
                running.append((module, shown.clone()))
                if self.correct:
                    seen.set("observation", true.clone())

        def after(module: nn.Module, _: tuple[Any, ...], output: Any) -> None:
            if isinstance(module, QueryEvaluator):
                if self.answer:
                    write(output, module, [truth, 10.0 * truth.float() - 5.0])
                answers.append(output.get(module.out_keys[0]).float())
            if running and module is running[0][0]:
                shown = running.pop()[1]
                if isinstance(output, TensorDictBase):
                    calls.append((shown, output.get("action").clone()))

        with register_module_forward_pre_hook(before), register_module_forward_hook(after):
            yield calls, answers

    def _is_innermost(self, module: nn.Module) -> bool:
        """Return whether a module is an innermost policy, which maps an observation to an action.

        A policy from this package always counts as innermost, any other policy only if no policy is inside it.
        """
        if module not in self._innermost:
            inner = [] if type(module).__module__.startswith("lw_torchrl.") else [*module.modules()][1:]
            self._innermost[module] = _acts(module) and not any(map(_acts, inner))
        return self._innermost[module]


def gripper_of(plans: Plans) -> Tensor:
    """Return a mask (A,) bool that selects the gripper's entry of an action."""
    numbers = torch.arange(plans.layout.action_size)
    return numbers == (-1 if plans.layout.gripper is None else plans.layout.gripper)


def _acts(module: nn.Module) -> bool:
    """Return whether a module maps an observation to an action."""
    return "observation" in getattr(module, "in_keys", ()) and "action" in getattr(module, "out_keys", ())
