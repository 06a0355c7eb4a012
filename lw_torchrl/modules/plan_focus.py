"""PlanFocus: where the things are, one from the other, that the plan's steps speak of."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from lw_torchrl._checks import check_scale
from lw_torchrl.language.named_objects import coordinate_index
from lw_torchrl.language.observation import OBSERVATION_SIZE
from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.language.plans import Plans, PlanStep
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.observation_features import squash

_PAIRS = 2  # of a step: those of its first and of its last clause that compares two things
_SCALE = 0.1  # metres


def _pairs(step: PlanStep) -> list[tuple[str, str]]:
    found = [(clause.subject, clause.object) for clause in step.condition.clauses if clause.object is not None]
    return [found[0], found[-1]] if found else []


class PlanFocus(nn.Module):
    """From the subject to the object of the conditions' clauses, mixed by the attention over the steps.

    A step's condition names what its skill is about: "the gripper is above the handle and not near the handle". So the
    way from gripper to handle stands in the same place as that from gripper to puck in another task, and what was
    learned there is of use here.

    Args:
        plans: the plans.
        tables: theirs.
        noise: standard deviation of the noise on each feature while training.

    Attributes:
        width: 18 features: of the first and the last clause with two things, three differences each, in units of 10
            cm, and through tanh at 2 cm and at 10 cm; 0 for a step without such a clause.
    """

    first: Tensor
    second: Tensor
    offset: Tensor
    constants: Tensor
    width = _PAIRS * 9

    def __init__(self, plans: Plans, tables: PlanTables, noise: float = 0.0) -> None:
        super().__init__()
        self.noise = check_scale("feature_noise", noise)
        constants = [0.0]
        shape = (len(plans), plans.num_steps, _PAIRS, 3)
        index = torch.full((2, *shape), OBSERVATION_SIZE)  # the constant 0
        offset = torch.zeros(shape)
        for task, plan in plans.items():
            for number, step in enumerate(plan.steps):
                for pair, names in enumerate(_pairs(step)):
                    at = (tables.index.row(task), number, pair)
                    for side, position in enumerate(self._positions(names, plan.definition)):
                        index[(side, *at)] = torch.tensor([coordinate_index(c, constants) for c in position[0]])
                        offset[at] += torch.tensor(position[1]) * (2 * side - 1)
        # The tables come from the plans, not from training: they are not part of the state that is saved.
        self.register_buffer("first", index[0], persistent=False)
        self.register_buffer("second", index[1], persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("constants", torch.tensor(constants), persistent=False)

    @staticmethod
    def _positions(names: tuple[str, str], task: Task) -> list[tuple]:
        return [(task.object(name).position, task.object(name).offset) for name in names]

    def forward(self, observation: Tensor, weights: Tensor, rows: Tensor) -> Tensor:
        """(..., 39) float32, attention (..., S) float32 and rows (...) int64, as from :meth:`PlanTables.rows`,
        to (..., 18) float32."""
        known = torch.cat((observation, self.constants.expand(*observation.shape[:-1], -1)), -1)
        first, second = self.first[rows], self.second[rows]  # (..., S, 2, 3)
        flat = (*first.shape[: rows.ndim], -1)
        way = (known.gather(-1, second.reshape(flat)) - known.gather(-1, first.reshape(flat))).reshape(first.shape)
        way = (weights[..., None, None] * (way + self.offset[rows])).sum(-3).flatten(-2)
        found = torch.cat((way / _SCALE, *squash(way)), -1)
        return found + self.noise * torch.randn_like(found) if self.training and self.noise else found
