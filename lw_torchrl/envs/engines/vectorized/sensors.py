"""What is read from a state after each step: one row of numbers, fetched with one call."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.table import TaskReward
from lw_torchrl.envs.engines.vectorized.simulation_table import PLACES, Place, TaskSources

Array = NDArray[np.float64]

# One row of sensors. The first 18 numbers are laid out like the observation, whose number 3, the opening of
# the gripper, is computed. What a task does not have is left to chance.
HAND = slice(0, 3)
GRIPPER = 3
OBJECT = slice(4, 7)
QUATERNION = slice(7, 11)
SECOND = slice(11, 14)
SECOND_QUATERNION = slice(14, 18)
CURRENT = slice(0, 18)
RIGHT_CLAW = slice(18, 21)
LEFT_CLAW = slice(21, 24)
MATRIX = slice(24, 33)
RIGHT_TIP = slice(33, 36)
LEFT_TIP = slice(36, 39)
POINT = slice(39, 42)
JOINT = slice(42, 43)
WIDTH = 43

# Only the dense reward looks at these.
LEFT_PAD = slice(43, 46)
RIGHT_PAD = slice(46, 49)
PLACE = slice(49, 52)
CORNERS = slice(52, 64)
REWARD_WIDTH = 64

MATRIX_OF = "matrix of "


class StateView:
    """The arrays of a MuJoCo state as one, so that a single ``take`` reads from any of them.

    MuJoCo keeps them all in one block of memory. Joining ten small arrays instead costs four times as much,
    as each is a Python object that has left the processor's cache since the last step.

    Args:
        model: the compiled model.
        data: its state, which must live as long as this window.

    Raises:
        RuntimeError: the arrays do not lie in one block.
    """

    def __init__(self, model: Any, data: Any) -> None:
        self._model = model
        self._positions = {"body": data.xpos, "geom": data.geom_xpos, "site": data.site_xpos}
        self._matrices = {"body": data.xmat, "geom": data.geom_xmat, "site": data.site_xmat}
        self._quaternions: Array = data.xquat
        self._joints: Array = data.qpos
        arrays = [*self._positions.values(), *self._matrices.values(), self._quaternions, self._joints]
        first = min(arrays, key=_address)
        self._start = _address(first)
        size = max(_address(array) + array.nbytes for array in arrays) - self._start
        if size > data.nbuffer:
            raise RuntimeError("MuJoCo keeps this state in more than one block of memory")
        self.numbers = as_strided(first, shape=(size // first.itemsize,), strides=(first.itemsize,))

    def position(self, place: str) -> Array:
        """Where "body NAME", "geom NAME" or "site NAME" is."""
        return self._positions[Place.parse(place).kind][self._number(place)]

    def matrix(self, place: str) -> Array:
        """How the place is turned, nine numbers."""
        return self._matrices[Place.parse(place).kind][self._number(place)]

    def quaternion(self, place: str) -> Array:
        """How a body is turned, four numbers."""
        if Place.parse(place).kind != "body":
            raise ValueError(f"only a body has a quaternion of its own, got {place!r}")
        return self._quaternions[self._number(place)]

    def joint(self, name: str) -> Array:
        """The coordinate of a joint that has one."""
        address = self._model.joint(name).qposadr[0]
        return self._joints[address : address + 1]

    def where(self, array: Array) -> int:
        """The index in ``numbers`` of the first number of one of the arrays above."""
        return (_address(array) - self._start) // array.itemsize

    def _number(self, place: str) -> int:
        at = Place.parse(place)
        assert at.kind in PLACES
        return getattr(self._model, at.kind)(at.name).id


def _address(array: Array) -> int:
    return array.__array_interface__["data"][0]


def sensor_index(window: StateView, sources: TaskSources, reward: TaskReward | None) -> NDArray[np.intp]:
    """(WIDTH,) which numbers of the window make a task's row of sensors; (REWARD_WIDTH,) with a dense reward."""
    success = sources.success
    parts = [
        (HAND, window.position("body hand")),
        (OBJECT, window.position(sources.object)),
        (RIGHT_CLAW, window.position("body rightclaw")),
        (LEFT_CLAW, window.position("body leftclaw")),
    ]
    if sources.quaternion.startswith(MATRIX_OF):
        parts.append((MATRIX, window.matrix(sources.quaternion.removeprefix(MATRIX_OF))))
    elif sources.quaternion not in ("zeros", "identity"):
        parts.append((QUATERNION, window.quaternion(sources.quaternion)))
    if sources.second is not None:
        parts.append((SECOND, window.position(sources.second)))
        if sources.second_quaternion != "zeros":
            parts.append((SECOND_QUATERNION, window.quaternion(sources.second_quaternion)))
    if success.point == "gripper" or reward is not None:
        parts.append((RIGHT_TIP, window.position("site rightEndEffector")))
        parts.append((LEFT_TIP, window.position("site leftEndEffector")))
    if (point := success.stick_end or success.point) not in ("object", "second", "gripper"):
        parts.append((POINT, window.position(point)))
    joint = sources.dial or success.joint
    if reward is not None:
        joint = joint or reward.joint
        parts.append((LEFT_PAD, window.position("body leftpad")))
        parts.append((RIGHT_PAD, window.position("body rightpad")))
        if reward.place is not None:
            parts.append((PLACE, window.position(reward.place)))
        for number, corner in enumerate(reward.corners):
            start = CORNERS.start + 3 * number
            parts.append((slice(start, start + 3), window.position(corner)))
    if joint is not None:
        parts.append((JOINT, window.joint(joint)))
    index = np.zeros(WIDTH if reward is None else REWARD_WIDTH, dtype=np.intp)
    for columns, array in parts:
        index[columns] = window.where(array) + np.arange(array.size)
    return index
