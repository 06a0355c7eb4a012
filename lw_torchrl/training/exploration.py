"""Exploration: the noise on executed actions, more of it where a plan does not go on."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl.modules.networks import ACTION_SIZE
from lw_torchrl.training.online_config import OnlineConfig


def longest_standstill(rows: TensorDictBase) -> int:
    """The most rows of an episode, one after the other, with the same truth of all conditions; 0 without ``qaf``.

    Args:
        rows: (R,) in the order of time, with ``("collector", "traj_ids")`` (R,) int64 and ``qaf`` (R, S) bool.

    Example:
        >>> from tensordict import TensorDict
        >>> ids, truth = torch.tensor([0, 0, 0, 1, 1]), torch.tensor([[1], [0], [0], [0], [1]]).bool()
        >>> longest_standstill(TensorDict({"collector": {"traj_ids": ids}, "qaf": truth}, [5]))
        2
    """
    if (truth := rows.get("qaf", None)) is None:
        return 0
    ids = rows["collector", "traj_ids"]
    changes = (truth[1:] != truth[:-1]).any(-1) | (ids[1:] != ids[:-1])
    edges = torch.cat([torch.tensor([0]), changes.nonzero().flatten() + 1, torch.tensor([len(ids)])])
    return int(edges.diff().max())


class Exploration:
    """The noise of a round, from its first states on.

    A row is stuck where the truth of no condition has changed for longer than it ever took in the demonstrations.
    There the policy repeats what leads nowhere, so the noise on the hand grows, until half as long again, from
    ``exploration`` to ``stuck_exploration``; that on the gripper does not, since it opens grasps.

    Args:
        config: of the training.
        patience: states without a change after which a row is stuck; 0 for never.
    """

    def __init__(self, config: OnlineConfig, patience: int) -> None:
        self.patience = patience
        self._scale = torch.tensor([1.0, 1.0, 1.0, config.gripper_exploration]) * config.exploration
        self._stuck_scale = torch.tensor([*[config.stuck_exploration] * 3, float(self._scale[3])])
        self._drawn = torch.zeros(config.rows, ACTION_SIZE)
        self._since = torch.zeros(config.rows)
        self._truth: Tensor | None = None

    def draw(self) -> None:
        """Draw what is kept until the next call."""
        self._drawn = torch.randn_like(self._drawn)

    def noise(self, state: TensorDictBase) -> Tensor:
        """(N, 4) float32, what is to be added to the actions in these states.

        Args:
            state: N rows, one step after those of the last call or, where an episode ended, the first of the next;
                ``qaf`` (N, S) bool, if it is there.
        """
        truth = state.get("qaf", None)
        if not self.patience or truth is None:
            return self._drawn * self._scale
        if self._truth is not None:
            same = (truth == self._truth).all(-1)
            self._since = torch.where(same, self._since + 1, 0.0)
        self._truth = truth.clone()
        stuck = (2 * (self._since - self.patience) / self.patience).clamp(0.0, 1.0).unsqueeze(-1)
        return self._drawn * (self._scale + stuck * (self._stuck_scale - self._scale))

    def note(self, ended: Tensor) -> None:
        """Rows whose episodes ended, (N,) bool, begin anew."""
        self._since = torch.where(ended, -1.0, self._since)
