"""Scripts in charge: policies whose skills, displacement or gripper scripted skills take over."""

from collections.abc import Mapping

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from lw_torchrl.evaluation.explanation import Scripts, attended
from lw_torchrl.evaluation.running import Acts
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.tasks import TASKS, task_id
from lw_torchrl.modules.attention import ACTIVE_WEIGHT
from lw_torchrl.suites.metaworld.experts import ExpertActor


class WithScripts(nn.Module):
    """A policy whose attention mixes scripted skills' actions, where it singles any steps out; where the step in force
    has no scripted skill, the action is the expert's.

    Args:
        steps: (task, episode) to the step in which scripts take over; None for all steps.
        part: of the action, "displacement" or "gripper"; None for all of it.
    """

    def __init__(
        self,
        actor: Acts,
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
            truth = tensordict.get("qaf") & mask
            first = torch.where(truth.any(-1), truth.int().argmax(-1), mask.sum(-1) - 1)
            weights = torch.nn.functional.one_hot(first, mask.shape[-1]).float()
        step = attended(weights, mask)
        replaced = step >= 0
        if self._steps is not None:
            replaced = replaced & self._in_step(seen, weights)
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

    def _in_step(self, seen: TensorDictBase, weights: Tensor) -> Tensor:
        """(B,) bool, the rows in which the step that is asked for has any weight."""
        assert self._steps is not None
        which = zip(seen.get("task_id").tolist(), seen.get("episode").tolist(), strict=True)
        asked = torch.tensor([self._steps.get(one, -1) for one in which], device=weights.device)
        return (weights.gather(-1, asked.clamp(min=0).unsqueeze(-1)).squeeze(-1) > ACTIVE_WEIGHT) & (asked >= 0)
