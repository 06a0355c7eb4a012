"""SegmentActor: a plan carried out by scripted skills in some pieces of an episode, and spoilt in the others."""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from lw_torchrl._seeding import episode_generator
from lw_torchrl.data.behaviours import Behaviour
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor


class SegmentActor(TensorDictModuleBase):
    """Acts as a :class:`Behaviour` of kind "segments" says, in episodes that are run from their beginning.

    Reads ``observation`` (N, 39) float32, ``task_id`` and ``episode`` (N,) int64, ``qaf`` (N, S) bool and ``_step``
    (N,) bool, the rows that count; writes ``action`` (N, 4) float32 in [-1, 1]. A row whose task or episode is another
    than at the last call begins one.

    Args:
        behaviour: how.
        plans: a plan for each task, whose every skill is a scripted one.
        seed: of the episodes; what is drawn hangs on (task, seed, episode).
        max_steps: of an episode.
    """

    row_by_row = True  # no network; what it draws stays with its rows

    def __init__(self, behaviour: Behaviour, plans: Plans, seed: int, max_steps: int) -> None:
        super().__init__()
        self.behaviour, self.seed, self.max_steps = behaviour, seed, max_steps
        self.script = ScriptedSkillActor(plans)
        self.in_keys = [*self.script.in_keys, "episode", "_step"]
        self.out_keys = ["action"]
        self._task = {task_id(task): plan.definition for task, plan in plans.items()}
        self._begun = torch.empty(0, 2, dtype=torch.int64)

    def _begin(self, rows: int) -> None:
        steps = rows, self.max_steps
        self._begun, self._done = torch.full((rows, 2), -1), torch.zeros(rows, dtype=torch.int64)
        self._right, self._skill = torch.zeros(steps, dtype=torch.bool), torch.zeros(steps, dtype=torch.int64)
        self._held = torch.zeros(*steps, 4)

    def _draw(self, row: int, task: int, episode: int) -> None:
        """The pieces of the row's new episode."""
        how, definition = self.behaviour, self._task[task]
        draws = episode_generator("segments", definition, self.seed, episode)
        length = draws.integers(how.shortest, how.longest + 1, -(-self.max_steps // how.shortest))
        pieces = np.repeat(np.arange(len(length)), length)[: self.max_steps]
        right = draws.random(len(length)) < how.right
        skill = draws.integers(len(self.script.plans[definition.name].steps), size=len(length))
        held = draws.uniform(-1.0, 1.0, (len(length), 4)).astype(np.float32)
        self._right[row] = torch.from_numpy(right[pieces])
        self._skill[row] = torch.from_numpy(skill[pieces])
        self._held[row] = torch.from_numpy(held[pieces])
        self._done[row] = 0

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``action``."""
        weights, actions = self.script.prepare(tensordict)
        rows = torch.arange(len(weights))
        if len(self._begun) != len(rows):
            self._begin(len(rows))
        now = torch.stack((tensordict.get("task_id"), tensordict.get("episode")), -1)
        active: Tensor = tensordict.get("_step")
        for row in (active & (now != self._begun).any(-1)).nonzero().flatten().tolist():
            self._draw(row, *now[row].tolist())
        self._begun = torch.where(active.unsqueeze(-1), now, self._begun)
        step = self._done.clamp(max=self.max_steps - 1)
        other = self._held[rows, step]
        if self.behaviour.otherwise == "skill":
            other = actions[rows, self._skill[rows, step]]
        follows = self._right[rows, step].unsqueeze(-1)
        self._done += active
        return tensordict.set("action", torch.where(follows, (weights.unsqueeze(-1) * actions).sum(-2), other))
