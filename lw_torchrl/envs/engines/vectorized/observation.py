"""Observations of many rows at once, from their sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.sensors import (
    CURRENT,
    GRIPPER,
    JOINT,
    LEFT_CLAW,
    MATRIX,
    MATRIX_OF,
    OBJECT,
    QUATERNION,
    RIGHT_CLAW,
    SECOND,
    SECOND_QUATERNION,
)
from lw_torchrl.envs.engines.vectorized.simulation_table import TaskSources

Array = NDArray[np.float64]

WIDEST_GRIP = 0.1  # metres
DIAL_RADIUS = 0.05  # metres


class Observer:
    """Makes the observations of a fixed set of rows.

    Each operation is Meta-World's, in its order, so that the last bit agrees.

    Args:
        sources: each row's task.
    """

    def __init__(self, sources: Sequence[TaskSources]) -> None:
        self._matrices = np.flatnonzero([row.quaternion.startswith(MATRIX_OF) for row in sources])
        self._dials = np.flatnonzero([row.dial is not None for row in sources])
        self._offset = np.array([row.offset for row in sources])
        self._seconds = np.flatnonzero([row.second is not None for row in sources])
        self._second_offset = np.array([row.second_offset for row in sources if row.second is not None])
        self._constant, self._is_constant = _constants(sources)

    def current(self, sensors: Array) -> Array:
        """(rows, 18) the part of the observation that describes the present state alone."""
        current = sensors[:, CURRENT].copy()
        np.copyto(current, self._constant, where=self._is_constant)
        span = row_norm(sensors[:, RIGHT_CLAW] - sensors[:, LEFT_CLAW])
        current[:, GRIPPER] = np.minimum(span / WIDEST_GRIP, 1.0)
        current[:, OBJECT] += self._offset
        if self._seconds.size:
            current[self._seconds, SECOND] += self._second_offset
        if self._matrices.size:
            current[self._matrices, QUATERNION] = quaternion_of_matrix(sensors[self._matrices, MATRIX])
        if self._dials.size:
            angle = sensors[self._dials, JOINT.start]
            current[self._dials, OBJECT.start] += np.sin(angle) * DIAL_RADIUS
            current[self._dials, OBJECT.start + 1] -= np.cos(angle) * DIAL_RADIUS
        return current


def _constants(sources: Sequence[TaskSources]) -> tuple[Array, NDArray[np.bool_]]:
    """What part of each row never changes: its value, and where."""
    value = np.zeros((len(sources), CURRENT.stop))
    fixed = np.zeros(value.shape, dtype=bool)
    for k, row in enumerate(sources):
        fixed[k, QUATERNION] = row.quaternion in ("zeros", "identity")
        value[k, QUATERNION.start] = row.quaternion == "identity"
        fixed[k, SECOND] = row.second is None
        fixed[k, SECOND_QUATERNION] = row.second is None or row.second_quaternion == "zeros"
    return value, fixed


def row_norm(vectors: Array) -> Array:
    """The length of each row, with the bits of ``np.linalg.norm`` of that row alone.

    That function takes the dot product from BLAS, and so does ``vecdot``; a sum of squares over an axis
    rounds differently in one case out of nine.
    """
    return np.sqrt(np.vecdot(vectors, vectors))


def quaternion_of_matrix(matrix: Array) -> Array:
    """(n, 4) quaternions, x y z w, of (n, 9) rotation matrices, with the bits of SciPy's
    ``Rotation.from_matrix(...).as_quat()`` at a fraction of its cost.
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix.T
    trace = m00 + m11 + m22
    quaternion = np.stack((m21 - m12, m02 - m20, m10 - m01, 1.0 + trace))
    # Most objects stand about upright and have a large w. Where another component is the largest, SciPy takes
    # that one from the diagonal and the others from it, which loses fewer digits.
    tilted = (trace <= m00) | (trace <= m11) | (trace <= m22)
    if tilted.any():
        for k in np.flatnonzero(tilted):
            quaternion[:, k] = _quaternion_of_tilted(matrix[k].reshape(3, 3).tolist(), float(trace[k]))
    x, y, z, w = quaternion * quaternion
    return (quaternion / np.sqrt(x + y + z + w)).T


def _quaternion_of_tilted(m: list[list[float]], trace: float) -> list[float]:
    """x, y, z, w, not yet of length 1, where w is not the largest. Few rows at a time: plain numbers are fast."""
    i = max(range(3), key=lambda axis: m[axis][axis])
    j, k = (i + 1) % 3, (i + 2) % 3
    quaternion = [0.0, 0.0, 0.0, m[k][j] - m[j][k]]
    quaternion[i] = 1.0 - trace + 2.0 * m[i][i]
    quaternion[j] = m[j][i] + m[i][j]
    quaternion[k] = m[k][i] + m[i][k]
    return quaternion
