"""The rewards of a replay buffer's rows, and options of their discounted sums over n steps."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Literal

import torch
from torch import Tensor

from lw_torchrl._checks import check_int, check_probability

RewardName = Literal["sparse", "dense", "cost", "dense_cost"]

_MOST = 10.0  # Meta-World's dense reward, which it gives at success


@dataclass(frozen=True)
class Reward:
    """A reward: ``(source + shift) * scale`` of "sparse" or "dense"; at a success ``at_success``, if not None."""

    source: Literal["sparse", "dense"]
    shift: float = 0.0
    scale: float = 1.0
    at_success: float | None = None

    @property
    def is_source(self) -> bool:
        return (self.shift, self.scale, self.at_success) == (0.0, 1.0, None)

    def of(self, source: Tensor, success: Tensor) -> Tensor:
        """The reward, (R, 1) float32, of the source's and of success (R, 1) bool."""
        if self.is_source:
            return source
        made = (source + self.shift) * self.scale
        return made if self.at_success is None else torch.where(success, self.at_success, made)


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


def check_reward(source: Literal["sparse", "dense"], reward: Tensor, success: Tensor) -> None:
    """Raise :class:`ValueError` if the rewards of an environment's steps (R, 1) are plainly not those of ``source``."""
    sparse = success.to(torch.float32)
    if source == "sparse" and not torch.equal(reward, sparse):
        instead = "use reward='dense' or 'dense_cost', or make the environment with reward='sparse', frame_skip=1"
        raise ValueError(f"batch: the reward is not the success, as the demonstrations' is; {instead}")
    if source == "dense" and torch.equal(reward, sparse) and success.any():
        raise ValueError("batch: the reward is the success, but the demonstrations' is dense; use reward='sparse'")
    if len(reward) and float(reward.max()) > _MOST + 1e-3:
        more = f"{float(reward.max()):.4g} is more than a step's, {_MOST:g}"
        raise ValueError(f"batch: a reward of {more}; make the environment with frame_skip=1")


STEPS = "steps_to_next_obs"  # TorchRL's name of the column with the steps from an observation to its "next"


def check_n_steps(n_steps: Any, gamma: Any) -> tuple[int, float]:
    """Return both, with gamma 1 for n_steps=1; raise ValueError if only one of gamma and n_steps > 1 is given."""
    number = check_int("n_steps", n_steps, minimum=1)
    if number == 1:
        if gamma is not None:
            raise ValueError(f"gamma needs n_steps of 2 or more, got gamma={gamma!r} with n_steps=1")
        return 1, 1.0
    if gamma is None:
        raise ValueError(f"n_steps={number} needs gamma, the loss's discount")
    if not (discount := check_probability("gamma", gamma)):
        raise ValueError("gamma must be above 0, got 0")
    return number, discount
