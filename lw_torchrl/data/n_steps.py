"""Targets of n steps: how far each row looks ahead within its trajectory, and the discounted rewards on the way."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import check_int, check_probability

STEPS = "steps_to_next_obs"
"""The column that says how many steps lie between ``observation`` and ``("next", "observation")``; TorchRL's name."""


def check_n_steps(n_steps: Any, gamma: Any) -> tuple[int, float]:
    """Both, if they go together: more than one step needs the discount."""
    number = check_int("n_steps", n_steps, minimum=1)
    if number == 1:
        if gamma is not None:
            raise ValueError(f"gamma belongs to n_steps of 2 or more, got gamma={gamma!r} with n_steps=1")
        return 1, 1.0
    if gamma is None:
        raise ValueError(f"n_steps={number} needs gamma, the discount that the loss has too")
    if not (discount := check_probability("gamma", gamma)):
        raise ValueError("gamma must be above 0, got 0")
    return number, discount


def last_rows(end: Tensor, n_steps: int) -> Tensor:
    """The row in which ``n_steps`` steps from each row end: (R,) int64, at most the end of its trajectory.

    Args:
        end: whether each row is the last of its trajectory, (R,) bool; rows are in the order of time.
        n_steps: steps to look ahead.
    """
    rows = torch.arange(len(end))
    ends = torch.where(end, rows, max(len(end) - 1, 0))
    return torch.minimum(rows + n_steps - 1, ends.flip(0).cummin(0).values.flip(0))


def sum_rewards(reward: Tensor, last: Tensor, gamma: float, n_steps: int) -> Tensor:
    """The discounted rewards from each row to ``last``: (R, 1), summed in the order of time."""
    total = reward.clone()
    rows = torch.arange(len(reward))
    for ahead in range(1, n_steps):
        inside = (rows + ahead <= last).nonzero().flatten()
        total[inside] += gamma**ahead * reward[inside + ahead]
    return total
