"""The rewards of a dataset's rows, the returns of episodes, and n-step returns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._util.checks import Count, Probability, typed
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.data.dataset import DONE, REWARD, TRAJECTORY

RewardName = Literal["sparse", "dense", "cost", "dense_cost"]
STEPS = "steps_to_next_obs"  # TorchRL's key for the number of time steps between an observation and its "next"

_MOST = 10.0  # the maximum of Meta-World's dense reward, given at success


@dataclass(frozen=True)
class Reward:
    """A reward computed from a stored reward ("sparse" or "dense") as ``(source + shift) * scale``.

    ``at_success`` is the reward of a successful time step; if it is None, the formula also applies to such steps.
    """

    source: Literal["sparse", "dense"]
    shift: float = 0.0
    scale: float = 1.0
    at_success: float | None = None

    def of(self, source: Tensor, success: Tensor) -> Tensor:
        """Return the reward (R, 1) float32, given the stored reward (R, 1) float32 and the success (R, 1) bool."""
        if (self.shift, self.scale, self.at_success) == (0.0, 1.0, None):
            return source  # keeps the column memory-mapped
        reward = (source + self.shift) * self.scale
        return reward if self.at_success is None else torch.where(success, self.at_success, reward)


REWARDS: Mapping[RewardName, Reward] = ReadOnlyDict(
    {
        "sparse": Reward("sparse"),
        "dense": Reward("dense"),
        "cost": Reward("sparse", shift=-1.0, scale=0.01),
        "dense_cost": Reward("dense", shift=-_MOST, scale=0.01, at_success=0.0),
    }
)
"""The rewards by name: "sparse" (1 at success, otherwise 0); "dense" (Meta-World's reward, at most 10); "cost" (-0.01
per time step, 0 at success); "dense_cost" ((dense reward - 10) / 100, 0 at success). Use the costs with episodes that
end at success (``terminate_on_success``), so that the best return is 0 and staying near the goal is not rewarded."""


def episode_returns(reward: Tensor, lengths: Sequence[int] | Tensor) -> Tensor:
    """Compute each episode's return and length, (E, 2) float64, from the rewards (R, 1) float32 of E consecutive
    episodes.
    """
    rows = torch.as_tensor(lengths, dtype=torch.int64)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)


@typed
def n_step_returns(rollout: TensorDictBase, n_steps: Count, gamma: Probability) -> TensorDictBase:
    """Compute n-step transitions: replace each row's ``"next"`` with that of the row n - 1 time steps later.

    Fewer time steps are used where a trajectory or the rollout ends. Done flags also come from the later row (TorchRL's
    ``MultiStep`` keeps the flags of the first). ``("next", "reward")`` becomes the discounted sum of rewards. The new
    key ``steps_to_next_obs`` (..., T) int64 is the number of time steps, which TorchRL's value estimators read.

    Args:
        rollout: a TensorDict (..., T) with ("next", "reward") and ("next", "done") (..., T, 1). If
            ("collector", "traj_ids") exists, a trajectory also ends where its value changes.
        n_steps: the number n of time steps, at least 1.
        gamma: the discount factor in [0, 1]; must equal the loss's discount factor.

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
    for ahead in range(1, n_steps):  # sum in temporal order, so that results are reproducible
        inside = (row + ahead <= last).nonzero().flatten()
        total[inside] += gamma**ahead * reward[inside + ahead]
    later = rows.get("next")[last].set("reward", total)
    return rows.exclude("next").update({"next": later, STEPS: last - row + 1}).reshape(rollout.shape)
