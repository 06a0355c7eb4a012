"""PlanWays: where the things are, one from the other, that a plan's steps speak of."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from lw_torchrl._checks import check_scale
from lw_torchrl.language.named_objects import NamedObject, coordinate_index
from lw_torchrl.language.observation import OBSERVATION_SIZE
from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules.observation_features import squash
from lw_torchrl.transforms.random_yaw import turn_observation, turn_vectors

_SCALE = 0.1  # metres
Pair = tuple[NamedObject, NamedObject]


class PlanWays(nn.Module):
    """The ways from one thing to another, mixed by the attention over the steps.

    Args:
        plans: the plans.
        tables: theirs.
        pairs: of a plan, for each step the things at the beginning and at the end of up to P ways; a step that has
            fewer has 0 there.
        number: P.
        noise: standard deviation of the noise on each feature while training.

    Attributes:
        width: 9·P features: three differences of each way, in units of 10 cm, and through tanh at 2 cm and at 10 cm.
    """

    begin: Tensor
    end: Tensor
    offset: Tensor
    constants: Tensor

    def __init__(
        self,
        plans: Plans,
        tables: PlanTables,
        pairs: Callable[[ConditionalPlan], Sequence[Sequence[Pair]]],
        number: int,
        noise: float = 0.0,
    ) -> None:
        super().__init__()
        self.noise = check_scale("feature_noise", noise)
        self.width = 9 * number
        constants = [0.0]
        shape = (len(plans), plans.num_steps, number, 3)
        index = torch.full((2, *shape), OBSERVATION_SIZE)  # the constant 0
        offset = torch.zeros(shape)
        for task, plan in plans.items():
            for step, found in enumerate(pairs(plan)):
                for one, ends in enumerate(found):
                    at = (tables.index.row(task), step, one)
                    for side, thing in enumerate(ends):
                        index[(side, *at)] = torch.tensor([coordinate_index(c, constants) for c in thing.position])
                        offset[at] += torch.tensor(thing.offset) * (2 * side - 1)
        # The tables come from the plans, not from training: they are not part of the state that is saved.
        self.register_buffer("begin", index[0], persistent=False)
        self.register_buffer("end", index[1], persistent=False)
        self.register_buffer("offset", offset, persistent=False)
        self.register_buffer("constants", torch.tensor(constants), persistent=False)

    def ways(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """(..., 39) float32, attention (..., S) float32 and rows (...) int64, as from :meth:`PlanTables.rows`, to
        (..., P, 3) float32 metres.

        Args:
            yaw: (...) float32, the angle by which :class:`RandomYaw` turned the observation: fixed places and offsets
                are turned with it.
        """
        if yaw is not None:
            observation = turn_observation(observation, -yaw)
        known = torch.cat((observation, self.constants.expand(*observation.shape[:-1], -1)), -1)
        begin, end = self.begin[rows], self.end[rows]  # (..., S, P, 3)
        flat = (*begin.shape[: rows.ndim], -1)
        way = (known.gather(-1, end.reshape(flat)) - known.gather(-1, begin.reshape(flat))).reshape(begin.shape)
        way = (weights[..., None, None] * (way + self.offset[rows])).sum(-3)
        return way if yaw is None else turn_vectors(way, yaw.unsqueeze(-1))

    def features(self, way: Tensor) -> Tensor:
        """(..., P, 3) metres to (..., 9·P)."""
        way = way.flatten(-2)
        found = torch.cat((way / _SCALE, *squash(way)), -1)
        return found + self.noise * torch.randn_like(found) if self.training and self.noise else found

    def forward(self, observation: Tensor, weights: Tensor, rows: Tensor, yaw: Tensor | None = None) -> Tensor:
        """As :meth:`ways`, to (..., 9·P) float32 features."""
        return self.features(self.ways(observation, weights, rows, yaw))
