"""The rewards that rows of a dataset can be given."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from torch import Tensor

RewardName = Literal["sparse", "dense", "cost", "dense_cost"]

_MOST = 10.0  # Meta-World's dense reward, which it gives at success


@dataclass(frozen=True)
class Reward:
    """A reward: ``(source + shift) * scale`` of "sparse" or "dense"; at a success ``at_success``, if not None."""

    source: Literal["sparse", "dense"]
    shift: float = 0.0
    scale: float = 1.0
    at_success: float | None = None

    def of(self, source: Tensor, success: Tensor) -> Tensor:
        """The reward, (R, 1) float32, of the source's and of success (R, 1) bool."""
        if (self.shift, self.scale, self.at_success) == (0.0, 1.0, None):
            return source  # as in the file
        reward = (source + self.shift) * self.scale
        return reward if self.at_success is None else torch.where(success, self.at_success, reward)


REWARDS: Mapping[RewardName, Reward] = MappingProxyType(
    {
        "sparse": Reward("sparse"),
        "dense": Reward("dense"),
        "cost": Reward("sparse", shift=-1.0, scale=0.01),
        "dense_cost": Reward("dense", shift=-_MOST, scale=0.01, at_success=0.0),
    }
)
"""By name: the success as 0 and 1; Meta-World's own, at most 10; a cost of 0.01 a step, none at success; (dense
reward - 10) / 100, a cost of at most about 0.1 a step, none at success. Costs need episodes that end at
success (``terminate_on_success``): then the best return is 0, and staying short of the goal earns nothing."""
