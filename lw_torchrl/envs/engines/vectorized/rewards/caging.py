"""How well the gripper encloses and grips the object: all rows whose reward asks for it, at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.closeness import Closeness
from lw_torchrl.envs.engines.vectorized.rewards.parameters import ACROSS, FACTS, GRIP, VIA, Parameters
from lw_torchrl.envs.engines.vectorized.rewards.terms import Numbers, hamacher_product, tolerance
from lw_torchrl.envs.engines.vectorized.sensors import LEFT_PAD, RIGHT_PAD

Array = NDArray[np.float64]
Truth = NDArray[np.bool_]

CAGED = 0.97  # from here on it counts that the gripper closes
CAGED_FOR_PINCH = 0.95
PADS = np.array([LEFT_PAD.start + 1, RIGHT_PAD.start + 1])
SIDES = np.array([1.0, -1.0])


class Caging:
    """Judges a fixed set of rows.

    Args:
        task: the rows' numbers.
    """

    def __init__(self, task: Parameters) -> None:
        self._rows = np.flatnonzero(task.caged)
        task = task.of(self._rows)
        row = self._rows * FACTS
        self._pads = row[:, None] + PADS
        self._object = (row + GRIP.start + 1)[:, None]
        self._start = (row + task.cage_start)[:, None]
        self._radius, self._pad = task.radius[:, None], task.pad[:, None]
        self._signed = task.signed[:, None]
        self._high, self._medium = task.high, task.medium
        pinching = np.isfinite(task.pinch)
        self._gripping = ~pinching
        self._pinching = np.flatnonzero(pinching)
        self._pinch = (task.radius + task.pinch)[self._pinching][:, None]

    def __call__(self, facts: Array, close: Closeness, closed: Numbers, narrow: Truth) -> tuple[Array, Truth]:
        """Judge.

        Args:
            facts: (rows, FACTS).
            close: the terms.
            closed: (rows,) how far the gripper is to close, in the action's precision.
            narrow: (rows,) where ``closed`` is a number of the action itself, not a bound of its range.

        Returns:
            (rows,) from 0 to 1, and where it was computed in the action's precision, because ``closed`` takes part.
        """
        rows = self._rows
        numbers = facts.reshape(-1)
        pads, where = numbers.take(self._pads), numbers.take(self._object)
        aside = pads - where
        aside = np.where(self._signed, aside * SIDES, np.abs(aside))
        margin = np.abs(np.abs(pads - numbers.take(self._start)) - self._pad)
        left, right = tolerance(aside, self._radius, self._pad, margin).T
        cage = hamacher_product(hamacher_product(left, right), close.value[rows, ACROSS])
        near = close.value[rows, VIA]

        caged = cage > CAGED
        gripped = np.where(caged & self._gripping, closed[rows], 0.0)
        grasp = self._blend(cage, gripped, near, self._high, self._medium)
        narrow = narrow[rows] & caged & self._gripping
        if narrow.any():
            some, precision = np.flatnonzero(narrow), closed.dtype
            grasp[some] = self._blend(
                cage[some].astype(precision),
                closed[rows[some]],
                near[some].astype(precision),
                self._high[some],
                self._medium[some],
            )
        if (some := self._pinching).size:
            left, right = tolerance(aside[some], self._radius[some], self._pinch, margin[some]).T
            pinched = np.where(cage[some] > CAGED_FOR_PINCH, hamacher_product(left, right), 0.0)
            grasp[some] = (cage[some] + pinched) / 2

        all_grasps, all_narrow = np.zeros(len(facts)), np.zeros(len(facts), dtype=bool)
        all_grasps[rows], all_narrow[rows] = grasp, narrow
        return all_grasps, all_narrow

    @staticmethod
    def _blend(cage: Any, gripped: Any, near: Any, high: Truth, medium: Truth) -> Any:
        both = hamacher_product(cage, gripped)
        other = np.where(high, cage, near)
        return np.where(high | medium, (both + other) / 2, both)
