"""Rewards of a dataset's rows, and the returns of its episodes and of n steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._util.checks import Count, Probability, typed
from lw_torchrl.data.dataset import DONE, REWARD, TRAJECTORY

RewardName = Literal["sparse", "dense", "cost", "dense_cost"]
STEPS = "steps_to_next_obs"  # TorchRL's name of the column with the steps from an observation to its "next"

_MOST = 10.0  # Meta-World's dense reward, which it gives at success


@dataclass(frozen=True)
class Reward:
    """A reward: ``(source + shift) * scale`` of "sparse" or "dense"; ``at_success`` at a success, unless it is None."""

    source: Literal["sparse", "dense"]
    shift: float = 0.0
    scale: float = 1.0
    at_success: float | None = None

    def of(self, source: Tensor, success: Tensor) -> Tensor:
        """Return the reward (R, 1) float32 for the source's (R, 1) float32 and success (R, 1) bool."""
        if (self.shift, self.scale, self.at_success) == (0.0, 1.0, None):
            return source  # stays memory-mapped
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
"""By name: the success as 0 and 1; Meta-World's own, at most 10; a cost of 0.01 for each step, none at success; (dense
reward - 10) / 100, a cost of at most about 0.1 for each step, none at success. Costs need episodes that end at success
(``terminate_on_success``): then the best return is 0, and staying short of the goal earns nothing."""


def episode_returns(reward: Tensor, lengths: Sequence[int] | Tensor) -> Tensor:
    """Return the return and the number of rows of consecutive episodes, (E, 2) float64, for rewards (R, 1) float32."""
    rows = torch.as_tensor(lengths, dtype=torch.int64)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)


@typed
def n_step_returns(rollout: TensorDictBase, n_steps: Count, gamma: Probability) -> TensorDictBase:
    """Look n steps ahead in each row of a rollout, or fewer where its trajectory ends or the rollout is cut.

    All entries under ``"next"`` become those of the last of these steps, also the ends of episodes (TorchRL's
    ``MultiStep`` leaves those of the first step). ``("next", "reward")`` becomes the discounted sum, and
    ``steps_to_next_obs``, int64 of the rollout's shape, the number of steps, which TorchRL's value estimators read.

    Args:
        rollout: (..., T) with ("next", "reward") and ("next", "done"), (..., T, 1); a trajectory also ends where
            ("collector", "traj_ids") changes, if it is there.
        n_steps: at least 1.
        gamma: the discount, in [0, 1]; the loss must use the same.

    Example:
        >>> from tensordict import TensorDict
        >>> done = torch.tensor([False, False, True, False])[:, None]
        >>> after = TensorDict(reward=torch.ones(4, 1), done=done, x=torch.arange(4))
        >>> rollout = TensorDict(next=after).auto_batch_size_(1)
        >>> ahead = n_step_returns(rollout, 2, gamma=0.5)
        >>> ahead["next", "reward"].flatten().tolist(), ahead["next", "x"].tolist()
        ([1.5, 1.5, 1.0, 1.0], [1, 2, 2, 3])
    """
    rows = rollout.reshape(-1)
    end = rows.get(DONE).reshape(-1).clone()
    end[rollout.shape[-1] - 1 :: rollout.shape[-1]] = True
    if (trajectory := rows.get(TRAJECTORY, None)) is not None:
        end[:-1] |= trajectory[1:] != trajectory[:-1]
    row = torch.arange(len(end), device=end.device)
    next_end = torch.where(end, row, len(end) - 1).flip(0).cummin(0).values.flip(0)
    last = torch.minimum(row + n_steps - 1, next_end)
    reward = rows.get(REWARD)
    total = reward.clone()
    for ahead in range(1, n_steps):  # summed in the order of time
        inside = (row + ahead <= last).nonzero().flatten()
        total[inside] += gamma**ahead * reward[inside + ahead]
    later = rows.get("next")[last].set("reward", total)
    return rows.exclude("next").update({"next": later, STEPS: last - row + 1}).reshape(rollout.shape)
