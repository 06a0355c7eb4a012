"""Whether the hand keeps above the floor on its way: all rows whose reward asks for it, at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.observation import row_norm
from lw_torchrl.envs.engines.vectorized.rewards.parameters import FACTS, Parameters
from lw_torchrl.envs.engines.vectorized.rewards.terms import tolerance

Array = NDArray[np.float64]

DEPTH = 0.01  # metres below the floor that still count as above


class Funnels:
    """Judges a fixed set of rows.

    Args:
        task: the rows' numbers.
    """

    def __init__(self, task: Parameters) -> None:
        self._rows = np.flatnonzero(task.funnelled)
        task = task.of(self._rows)
        row = self._rows * FACTS
        self._height_of = row + task.funnel_over
        self._from = (row + task.funnel_over)[:, None, None] + (-2, -1)
        self._about = row[:, None, None] + task.funnel_about
        self._offset = task.funnel_offset[:, None]
        self._rim, self._slope, self._height = task.rim[:, None], task.slope[:, None], task.height[:, None]
        self._margin = task.funnel_margin

    def __call__(self, facts: Array) -> Array:
        """(rows,) 1 above the floor, less below it."""
        above = np.ones(len(facts))
        if self._rows.size:
            numbers = facts.reshape(-1)
            radius = row_norm(numbers.take(self._from) - (numbers.take(self._about) + self._offset)) - self._rim
            floor = np.where(radius > 0.0, self._slope * np.log(radius) + self._height, 0.0).min(axis=1)
            margin = np.where(np.isnan(self._margin), floor / 2.0, self._margin)
            z = numbers.take(self._height_of)
            above[self._rows] = np.where(z >= floor, 1.0, tolerance(floor - z, 0.0, DEPTH, margin))
        return above
