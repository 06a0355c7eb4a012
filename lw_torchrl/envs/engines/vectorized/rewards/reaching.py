"""The rewards of tasks in which nothing need be gripped."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.observation import row_norm
from lw_torchrl.envs.engines.vectorized.rewards.moment import Formula, Index, Moment, Weak
from lw_torchrl.envs.engines.vectorized.rewards.parameters import GOAL, TCP, VIA
from lw_torchrl.envs.engines.vectorized.rewards.terms import hamacher_product, square, tolerance
from lw_torchrl.envs.engines.vectorized.sensors import GRIPPER, HAND, JOINT, OBJECT, QUATERNION

Array = NDArray[np.float64]

TO_HANDLE = np.array([-0.05, 0.0, 0.0])
BESIDE_HANDLE = np.array([0.05, 0.03, -0.01])
UPRIGHT = np.array([0.707, 0.0, 0.0, 0.707])


def reach(m: Moment, rows: Index, weak: Weak) -> Array:
    return 10 * m.placed[rows]


def press(m: Moment, rows: Index, weak: Weak) -> Array:
    """Be near with the gripper open (``shut``: closed); where held, press as well. ``weights`` of the two."""
    opening = m.facts[rows, GRIPPER]
    opening = np.where(m.task.shut[rows], 1 - opening, opening)
    first, second = m.task.weights[rows].T
    reward = first * hamacher_product(opening, m.near[rows])
    return reward + np.where(m.held[rows], second * m.placed[rows], 0.0)


def press_behind_wall(m: Moment, rows: Index, weak: Weak) -> Array:
    """Come near with the gripper closed, then open it and press."""
    opening = m.facts[rows, GRIPPER]
    coming = 2 * hamacher_product((1 - opening) / 2.0, m.near[rows])
    return np.where(m.held[rows], 2 + 2 * (1 + opening) + 4 * square(m.placed[rows]), coming)


def weighted_sum(m: Moment, rows: Index, weak: Weak) -> Array:
    """Near and placed, with ``weights``, times ``factor``."""
    first, second = m.task.weights[rows].T
    return (first * m.near[rows] + second * m.placed[rows]) * m.task.factor[rows]


def both(m: Moment, rows: Index, weak: Weak) -> Any:
    """Near as well as placed, times ``factor``; ``gripper``: and the gripper is told to close."""
    near = weak(m.near[rows])
    near = np.where(m.task.gripper[rows], hamacher_product(near, weak(m.closed[rows])), near)
    return weak(m.task.factor[rows]) * hamacher_product(near, weak(m.placed[rows]))


def slide(m: Moment, rows: Index, weak: Weak) -> Array:
    """Come near; low down and near, slide."""
    low = m.facts[rows, TCP.start + 2] <= 0.03
    return np.where(low & m.held[rows], 2 + 7 * m.placed[rows], 1.5 * m.near[rows])


def door(m: Moment, rows: Index, weak: Weak) -> Array:
    """Come to the handle from above, told to close the gripper, and turn the door."""
    facts = m.facts[rows]
    handle, angle = facts[:, OBJECT], -facts[:, JOINT.start]
    near = tolerance(row_norm(facts[:, HAND] - (handle + TO_HANDLE) - BESIDE_HANDLE), 0.0, 0.06, 0.5)
    ready = hamacher_product(m.above[rows], near)
    turned = tolerance(np.pi / 2.0 + np.pi / 6 - angle, 0.0, 0.5, np.pi / 3.0)
    opened = 0.2 * (-angle < -np.pi / 90.0) + 0.8 * turned
    reward = 2.0 * hamacher_product(ready, m.effort[rows]) + 8.0 * opened
    return np.where(np.abs(handle[:, 0] - facts[:, GOAL.start]) <= 0.08, 10.0, reward)


def lid(m: Moment, rows: Index, weak: Weak) -> Array:
    """Come to the lid from above, told to close the gripper, lift it and bring it over the box, all of it upright."""
    ready = hamacher_product(m.above[rows], m.near[rows])
    lifted = 0.2 * (m.facts[rows, OBJECT.stop - 1] + 0.02 > 0.04) + 0.8 * m.placed[rows]
    reward = 2.0 * hamacher_product(m.effort[rows], ready) + 8.0 * lifted
    reward = np.where(m.close.distance[rows, VIA] < 0.08, 10.0, reward)
    return reward * turned_like(m.facts[rows, QUATERNION], UPRIGHT, 0.2)


def turned_like(quaternion: Array, ideal: Array, margin: float) -> Array:
    """1 where a quaternion is the ideal one, 0 from ``margin`` on."""
    return np.maximum(1.0 - row_norm(quaternion - ideal) / margin, 0.0)


REACHING: dict[str, Formula] = {
    "reach": reach,
    "press": press,
    "press behind wall": press_behind_wall,
    "sum": weighted_sum,
    "both": both,
    "slide": slide,
    "door": door,
    "lid": lid,
}
