"""Sensor values read from the state after each step, and the observations and success flags computed from them."""

from collections.abc import Callable, Sequence
from math import sqrt
from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from lw_torchrl.suites.metaworld.tables import NO_OFFSET, TaskReward, TaskSources

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Mask = NDArray[np.bool_]

# Columns of the sensor array. The first 18 are in the order of the observation. Column 3 (the gripper opening) is
# computed, as are the quaternions of tasks that read a rotation matrix. Columns that a task does not use are zero.
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

# These columns are used only by the dense reward.
LEFT_PAD = slice(43, 46)
RIGHT_PAD = slice(46, 49)
PLACE = slice(49, 52)
CORNERS = slice(52, 64)
REWARD_WIDTH = 64

MATRIX_OF = "matrix of "


class StateView:
    """A flat view of all arrays of a MuJoCo state, which share one block of memory: a single ``take`` reads from all of
    them, four times as fast as concatenating ten small arrays. The state must outlive this view."""

    def __init__(self, model: Any, data: Any) -> None:
        self._model = model
        positions = {"body": data.xpos, "geom": data.geom_xpos, "site": data.site_xpos}
        matrices = {"matrix of body": data.xmat, "matrix of geom": data.geom_xmat, "matrix of site": data.site_xmat}
        self._arrays = positions | matrices | {"quaternion of body": data.xquat, "joint": data.qpos}
        first = min(self._arrays.values(), key=_address)
        self._start = _address(first)
        size = max(_address(array) + array.nbytes for array in self._arrays.values()) - self._start
        if size > data.nbuffer:
            raise RuntimeError("this version of MuJoCo stores a state in more than one block of memory")
        self.numbers = as_strided(first, shape=(size // first.itemsize,), strides=(first.itemsize,))

    def find(self, what: str) -> Index:
        """Return the indices in ``numbers`` of a named quantity: the position (3) of "body NAME", "geom NAME" or "site
        NAME"; "matrix of geom NAME" (9), or of a body or site; "quaternion of body NAME" (4); or "joint NAME" (1)."""
        kind, _, name = what.rpartition(" ")
        array = self._arrays[kind]
        named = getattr(self._model, kind.split()[-1])(name)
        row = named.qposadr[0] if kind == "joint" else named.id
        own = array[row : row + 1]
        return (_address(own) - self._start) // own.itemsize + np.arange(own.size)


def _address(array: Array) -> int:
    return array.__array_interface__["data"][0]


def sensor_index(window: StateView, sources: TaskSources, reward: TaskReward | None) -> Index:
    """Return the indices in ``window`` of a task's sensors, (WIDTH,), or (REWARD_WIDTH,) with a dense reward."""
    success = sources.success
    parts = [(HAND, "body hand"), (OBJECT, sources.object)]  # the body "world" is at zero, and not rotated
    parts += [(RIGHT_CLAW, "body rightclaw"), (LEFT_CLAW, "body leftclaw")]
    if sources.quaternion.startswith(MATRIX_OF):
        parts.append((MATRIX, sources.quaternion))
    elif sources.quaternion != "zeros":
        body = "body world" if sources.quaternion == "identity" else sources.quaternion
        parts.append((QUATERNION, f"quaternion of {body}"))
    if sources.second is not None:
        parts.append((SECOND, sources.second))
        if sources.second_quaternion != "zeros":
            parts.append((SECOND_QUATERNION, f"quaternion of {sources.second_quaternion}"))
    if success.point == "gripper" or reward is not None:
        parts += [(RIGHT_TIP, "site rightEndEffector"), (LEFT_TIP, "site leftEndEffector")]
    if (point := success.stick_end or success.point) not in ("object", "second", "gripper"):
        parts.append((POINT, point))
    joint = sources.dial or success.joint
    if reward is not None:
        joint = joint or reward.joint
        parts += [(LEFT_PAD, "body leftpad"), (RIGHT_PAD, "body rightpad")]
        if reward.place is not None:
            parts.append((PLACE, reward.place))
        for number, corner in enumerate(reward.corners):
            start = CORNERS.start + 3 * number
            parts.append((slice(start, start + 3), corner))
    if joint is not None:
        parts.append((JOINT, f"joint {joint}"))
    index = np.full(WIDTH if reward is None else REWARD_WIDTH, window.find("body world")[0])
    for columns, what in parts:
        index[columns] = window.find(what)
    return index


WIDEST_GRIP = 0.1  # metres
DIAL_RADIUS = 0.05  # metres


class Observer:
    """An observation builder for a fixed set of rows: Meta-World's operations in Meta-World's order, bit for bit."""

    def __init__(self, sources: Sequence[TaskSources]) -> None:
        self._dials = np.flatnonzero([row.dial is not None for row in sources])
        self._offset = np.full((len(sources), CURRENT.stop), NO_OFFSET[0])
        self._offset[:, OBJECT] = [row.offset for row in sources]
        self._offset[:, SECOND] = [row.second_offset for row in sources]

    def observe(self, sensors: Array) -> Array:
        """Convert the columns CURRENT of the sensors (rows, WIDTH) in place to the part of the observation that
        describes the current state, and return a view of these columns."""
        current = sensors[:, CURRENT]
        current += self._offset
        span = row_norm(sensors[:, RIGHT_CLAW] - sensors[:, LEFT_CLAW])
        np.minimum(span / WIDEST_GRIP, 1.0, out=current[:, GRIPPER])
        if self._dials.size:
            angle = sensors[self._dials, JOINT.start]
            current[self._dials, OBJECT.start] += np.sin(angle) * DIAL_RADIUS
            current[self._dials, OBJECT.start + 1] -= np.cos(angle) * DIAL_RADIUS
        return current


def row_norm(vectors: Array) -> Array:
    """Return the Euclidean norm of each row, bit-identical to calling ``np.linalg.norm`` on that row. Both use the BLAS
    dot product; summing squares over an axis would round differently for one row in nine."""
    return np.sqrt(np.vecdot(vectors, vectors))


def quaternion_of_matrix(matrix: Any) -> tuple[float, float, float, float]:
    """Convert a rotation matrix, nine numbers, to a quaternion in x, y, z, w order. The result is bit-identical to
    SciPy's ``Rotation.from_matrix(...).as_quat()``, which is much slower. The kernel compiles this function."""
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = matrix
    trace = m00 + m11 + m22
    # SciPy first computes the largest component, then the other components from it, which loses fewer digits.
    if trace <= m00 or trace <= m11 or trace <= m22:
        if m00 >= m11 and m00 >= m22:
            x, y, z, w = 1.0 - trace + 2.0 * m00, m10 + m01, m20 + m02, m21 - m12
        elif m11 >= m22:
            x, y, z, w = m10 + m01, 1.0 - trace + 2.0 * m11, m21 + m12, m02 - m20
        else:
            x, y, z, w = m20 + m02, m21 + m12, 1.0 - trace + 2.0 * m22, m10 - m01
    else:
        x, y, z, w = m21 - m12, m02 - m20, m10 - m01, 1.0 + trace
    length = sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


class Scene(NamedTuple):
    """The inputs of a success rule: whether each row's point is near the goal (rows,), observed sensors (rows, WIDTH),
    goals (rows, 3), and points (rows, 3) that must reach the goals."""

    near: Mask
    sensors: Array
    goal: Array
    point: Array


STICK_LIFT = 0.01  # height above the stick's initial position, metres
STICK_SIDEWAYS = 0.04  # largest sideways distance between the stick's end and the handle, metres
STICK_UPWARD = 0.06


class SuccessFunction:
    """A callable that computes the success of a fixed set of rows. ``programs`` maps a row to its current
    :class:`TaskProgram`, for the one rule that reads contacts."""

    def __init__(self, sources: Sequence[TaskSources], programs: Callable[[int], Any]) -> None:
        success = [row.success for row in sources]
        self._programs = programs
        self._offset, self._axes, self._within, self._under, self._above, self._angle = (
            np.array([getattr(row, name) for row in success], np.float64)
            for name in ("offset", "axes", "within", "under", "above", "angle")
        )
        # A distance is at most ``within`` if it is less than the next larger float64.
        self._nearer_than = np.minimum(np.nextafter(self._within, np.inf), self._under)
        columns = {"object": OBJECT.start, "second": SECOND.start}
        self._columns = np.array([[columns.get(row.point, POINT.start)] for row in success]) + np.arange(3)
        self._rows = np.arange(len(success))[:, None]
        self._grippers = np.flatnonzero([row.point == "gripper" for row in success])
        self._at_height = np.flatnonzero([row.goal_height is not None for row in success])
        self._goal_height = np.array([row.goal_height for row in success if row.goal_height is not None], np.float64)
        rules = [row.rule for row in success]
        self._rules = [
            (getattr(SuccessFunction, "_" + name.replace(" ", "_")), np.flatnonzero([rule == name for rule in rules]))
            for name in sorted({rule for rule in rules if rule is not None})
        ]

    def __call__(self, sensors: Array, goal: Array) -> Mask:
        """Compute the success (rows,) bool from observed sensors (rows, WIDTH) and goals (rows, 3)."""
        point = sensors[self._rows, self._columns]
        if self._grippers.size:
            tips = sensors[self._grippers]
            point[self._grippers] = (tips[:, RIGHT_TIP] + tips[:, LEFT_TIP]) / 2.0
        if self._at_height.size:
            goal = goal.copy()
            goal[self._at_height, 2] = self._goal_height
        success = row_norm((point + self._offset - goal) * self._axes) < self._nearer_than
        scene = Scene(success, sensors, goal, point)
        for rule, rows in self._rules:
            success[rows] = rule(self, rows, scene)
        return success

    def _point_below_goal(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the ring is around the peg, below the peg's top."""
        return scene.near[rows] & (scene.goal[rows, 2] - scene.point[rows, 2] > 0.0)

    def _object_above_goal(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the object is higher than the goal, regardless of x and y."""
        return scene.sensors[rows, OBJECT.stop - 1] > scene.goal[rows, 2]

    def _joint_above(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the joint position is greater than ``above``."""
        return scene.sensors[rows, JOINT.start] > self._above[rows]

    def _joint_near(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the joint is at most ``within`` radians from ``angle``."""
        return np.abs(scene.sensors[rows, JOINT.start] - self._angle[rows]) <= self._within[rows]

    def _stick_inserted(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the container is at the goal and the end of the stick is through the container's handle."""
        held = scene.near[rows]
        if held.any():
            end, handle = scene.sensors[rows, POINT], scene.sensors[rows, SECOND]
            aside = np.abs(end - handle)
            held &= end[:, 0] >= handle[:, 0]
            held &= (aside[:, 1] <= STICK_SIDEWAYS) & (aside[:, 2] <= STICK_UPWARD)
        return held

    def _stick_held(self, rows: Index, scene: Scene) -> Mask:
        """Return whether the container is at the goal and the gripper holds the stick above the table."""
        held = scene.near[rows]
        for k in np.flatnonzero(held):
            current, program = scene.sensors[rows[k]], self._programs(int(rows[k]))
            lifted = current[OBJECT][2] - STICK_LIFT > program.stick_init_pos[2]
            if not (current[GRIPPER] > 0.0 and lifted):
                held[k] = False
                continue
            # Both pads must push against the stick; Meta-World reads these contact forces.
            model, data, pairs = program.model, program.data, program.data.contact.geom
            touched = (pairs == model.geom("objGeom").id).any(axis=1)
            for pad in ("leftpad_geom", "rightpad_geom"):
                contacts = touched & (pairs == model.geom(pad).id).any(axis=1)
                held[k] &= sum(data.efc_force[data.contact.efc_address[contacts]]) > 0
        return held
