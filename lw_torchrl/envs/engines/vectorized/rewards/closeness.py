"""How close pairs of points are: all terms of all rows at once."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.observation import row_norm
from lw_torchrl.envs.engines.vectorized.rewards.parameters import FACTS, Parameters
from lw_torchrl.envs.engines.vectorized.rewards.terms import gaussian, long_tail

Array = NDArray[np.float64]


class Closeness(NamedTuple):
    """Every term of every row, each (rows, 4).

    Attributes:
        distance: how far the two points are from each other.
        margin: how far beyond what counts as close the value falls to 0.1.
        value: 1 where they are close, less where they are not.
    """

    distance: Array
    margin: Array
    value: Array


class Distances:
    """Measures a fixed set of rows.

    Args:
        task: the rows' numbers.
    """

    def __init__(self, task: Parameters) -> None:
        row = np.arange(len(task.within)).reshape(-1, 1, 1, 1, 1) * FACTS
        points = task.points + row
        self._first = np.ascontiguousarray(points[:, :, 0])
        self._second = np.ascontiguousarray(points[:, :, 1])
        self._offset = task.offset
        self._axes = task.axes[:, None]
        self._within = task.within
        self._gaussian = np.nonzero(task.gaussian)

    def __call__(self, facts: Array, less: Array) -> Closeness:
        """Measure.

        Args:
            facts: (rows, FACTS).
            less: (rows, 4) what is taken from the distance between a margin's points. NaN asks for the present
                distance as the margin, and is replaced by it.
        """
        numbers = facts.reshape(-1)
        apart = numbers.take(self._first)
        apart += self._offset
        apart -= numbers.take(self._second)
        apart *= self._axes
        length = row_norm(apart)
        distance = np.ascontiguousarray(length[:, 0])
        np.copyto(less, distance, where=np.isnan(less))
        margin = np.abs(length[:, 1] - less)
        beyond = (distance - self._within) / margin
        value = long_tail(beyond)
        if self._gaussian[0].size:
            value[self._gaussian] = gaussian(beyond[self._gaussian])
        value[distance <= self._within] = 1.0
        return Closeness(distance, margin, value)
