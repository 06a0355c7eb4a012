"""Fetch's numbers in our axes, and our actions in Fetch's.

Fetch's x points away from the robot, its y to the left, its z up from the floor; lengths are metres in both.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

HAND_HEIGHT = 0.03
"""Metres of the hand above Fetch's grip site, which is between the finger pads. Meta-World's hand is as high above what
it holds, so "near" and the other relations mean the same."""
OPEN = 0.1
"""Metres between the fingers, of an open gripper."""

Array = NDArray[np.float64]


def our_positions(positions: Array, origin: Array) -> Array:
    """Positions in Fetch's axes, (..., 3) float64, seen from ``origin`` (..., 3), which is in Fetch's axes too."""
    way = positions - origin
    return np.stack((-way[..., 1], way[..., 0], way[..., 2]), -1)


def our_quaternions(quaternions: Array) -> Array:
    """Fetch's quaternions (..., 4) float64, w first, with the axis of rotation in our axes. So that of a thing which
    was not turned stays (1, 0, 0, 0)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.stack((w, -y, x, z), -1)


def turned_quaternions(quaternions: Array) -> Array:
    """Orientations of bodies (..., 4) float64, w first, in Fetch's axes, as they are in ours: turned by a quarter."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    return np.sqrt(0.5) * np.stack((w - z, x - y, x + y, w + z), -1)


def fetch_actions(action: NDArray[Any]) -> NDArray[Any]:
    """The actions of gymnasium-robotics that equal ours, (..., 4) of the same dtype: displacement x, y, z, where 1 asks
    for 5 cm, and the gripper's effort, where +1 opens. Ours go to the right, away and up, and +1 closes."""
    return np.stack((action[..., 1], -action[..., 0], action[..., 2], -action[..., 3]), -1)
