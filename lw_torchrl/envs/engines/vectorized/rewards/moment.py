"""What a formula of a reward looks at."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.closeness import Closeness
from lw_torchrl.envs.engines.vectorized.rewards.parameters import Parameters
from lw_torchrl.envs.engines.vectorized.rewards.terms import Numbers

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Truth = NDArray[np.bool_]

Weak = Callable[[Any], Any]
"""Brings numbers to the precision that a formula is computed in: single, where a number of a float32 action takes part,
for NumPy gives way to it where a plain Python number meets it."""

Formula = Callable[["Moment", Index, Weak], Numbers]
"""(moment, rows, weak) -> (len(rows),) their rewards."""


@dataclass
class Moment:
    """All rows after one step.

    Attributes:
        task: the rows' numbers.
        facts: (rows, FACTS).
        close: how close the pairs of points are.
        near, placed, via: (rows,) the values of these terms.
        above: (rows,) whether the hand keeps above the floor.
        lift: (rows,) how well a held object is on its way to the goal.
        wide: (rows,) where ``lift`` is a NumPy number, not a Python one, so that single precision gives way to it.
        grasp: (rows,) how well the object is gripped.
        narrow: (rows,) where a number of the action takes part, so that the reward has the action's precision.
        closed: (rows,) how far the gripper is to close, from 0 to 1.
        effort: (rows,) the gripper's action on a scale from 0, open, to 1, closed.
        held: (rows,) whether the object counts as held.
    """

    task: Parameters
    facts: Array
    close: Closeness
    near: Array
    placed: Array
    via: Array
    above: Array
    lift: Array
    wide: Truth
    grasp: Array
    narrow: Truth
    closed: Numbers
    effort: Numbers
    held: Truth
