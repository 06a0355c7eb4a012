"""Find the points at which a hand can grasp or push objects, from the shapes in the simulator's model."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, typed
from lw_torchrl.language.layout import places
from lw_torchrl.language.objects import NamedObject, typed_position
from lw_torchrl.language.tasks import Task, TaskList
from lw_torchrl.suites.engine import BodyPoses
from lw_torchrl.suites.suite import Suite, find_suite

Array = NDArray[np.float64]

BETWEEN_FINGERS = 0.08  # metres, the maximum width of an object that fits between the fingers
PADS = 0.045  # metres from the hand's position down to the fingertips
_BELOW_TOP = 0.035  # metres that the fingertips reach below the top of a grasped object
_BESIDE = 0.015  # metres from the hand's position to the side of the closed fingers that pushes
_NEAR = 0.03  # metres, the maximum distance between an object's surface and its observed position
_STEP = 0.005  # metres between candidate positions


@typed
def find_points(tasks: TaskList = "MT50", *, suite: str | Suite | None = None, episodes: Count = 3) -> dict[str, Task]:
    """Return the tasks with points on objects that are found from shapes, instead of the points that people named.

    A free object that fits between the fingers, which close along y, gets a point "... grip": the hand position at
    which the fingers grasp the object nearest to its observed position, near its top and above the table. An object
    that is too wide gets "... side": the hand position from which to push it to the task's target. Objects on hinges or
    rails get no points.

    Policies with canonical plans use an object's point for every step that touches the object. To use these points,
    pass the returned tasks to :func:`~lw_torchrl.load_plans`.

    Args:
        tasks: names, :class:`Task` objects, "MT10" or "MT50".
        suite: the suite of the tasks, whose engine must have ``row_model`` and ``poses``; None for the names' suite.
        episodes: number of initial states to examine, from seed 0 on; each point is the median.

    Returns:
        A mapping from name to :class:`Task`. Points are offsets in metres from an object's position.

    Raises:
        ValueError: a task is unknown.
        TypeError: the engine has no ``model`` or ``poses``.

    Example:
        >>> from benchmarks.finding_points import find_points
        >>> find_points("push")["push"].objects[-1].name
        'puck grip'

    Source: original to this library.
    """
    suite = find_suite(tasks, suite)
    named = suite.named_tasks(tasks)
    engine: Any = suite.make_engine(list(named), reward="sparse", num_threads=1)
    try:
        if not hasattr(engine, "row_model") or not hasattr(engine, "poses"):
            raise TypeError(f"the engine of suite {suite.name!r} must have the methods row_model and poses")
        found: dict[str, list[dict[str, tuple[str, Array]]]] = {name: [] for name in named}
        for seed in range(episodes):
            observations = engine.reset(range(len(named)), [seed] * len(named))
            for row, (name, task) in enumerate(named.items()):
                shapes = Shapes(engine.row_model(row).model, engine.poses(row))
                found[name].append(_points(task, observations[row], shapes))
    finally:
        engine.close()
    return {name: _with_points(task, found[name]) for name, task in named.items()}


def _points(task: Task, observation: Array, shapes: Shapes) -> dict[str, tuple[str, Array]]:
    """Return, for each object, the kind of its point ("grip" or "side") and the offset from the object's position."""
    hand, *things, goal = task.layout.positions
    found = {}
    for one in task.published.objects[1:]:
        if one.position in [places(part) for part in things]:
            at = observation[[int(number) for number in one.position]]
            if (thing := shapes.nearest(at, observation[hand])) is not None:
                surface = thing[1]
                grip = _grip(surface, -at[2])
                side = grip if grip is not None else _side(surface, observation[goal] - at, -at[2])
                if side is not None:
                    found[one.name] = ("side" if grip is None else "grip", side)
    return found


def _with_points(task: Task, seen: list[dict[str, tuple[str, Array]]]) -> Task:
    points: list[NamedObject] = []
    for one in task.published.objects[1:]:
        told = [point[one.name] for point in seen if one.name in point]
        known = any(typed_position(one.position) == typed_position(other.position) for other in points)
        if len(told) == len(seen) and not known:
            x, y, z = np.median([offset for _, offset in told], 0).round(4).tolist()
            points.append(NamedObject(f"{one.name} {told[0][0]}", one.position, (x, y, z), ours=True))
    return replace(task.published, objects=(*task.published.objects, *points))


def _grip(surface: Array, table: float) -> Array | None:
    """Return the hand position for a grasp, as near to the object's position along x as it fits between the fingers."""
    best: tuple[float, Array] | None = None
    for x in np.arange(surface[:, 0].min(), surface[:, 0].max() + 1e-9, _STEP):
        near = surface[np.abs(surface[:, 0] - x) <= 4 * _STEP]
        if len(near) > 1 and np.ptp(near[:, 1]) <= BETWEEN_FINGERS and (best is None or abs(x) < best[0]):
            middle = (near[:, 1].min() + near[:, 1].max()) / 2
            best = abs(x), np.array([x, middle, max(near[:, 2].max() + PADS - _BELOW_TOP, table + PADS)])
    return None if best is None else best[1]


def _side(surface: Array, way: Array, table: float) -> Array | None:
    """Return the hand position from which to push an object along ``way``, behind its bounding box."""
    length = np.hypot(way[0], way[1])
    if length < _STEP:
        return None
    ahead, low, high = way[:2] / length, surface.min(0), surface.max(0)
    half = (high - low)[:2] / 2
    reach = min(half[k] / abs(ahead[k]) for k in range(2) if abs(ahead[k]) > 1e-6)
    found = (low + high) / 2
    found[:2] -= ahead * (reach + _BESIDE)
    found[2] = max(found[2], table + PADS)
    return np.asarray(found)


class Shapes:
    """Points on the surfaces of a model's bodies, in the frame of ``poses``."""

    def __init__(self, model: Any, poses: BodyPoses) -> None:
        self.model, self.poses = model, poses

    def nearest(self, at: Array, hand: Array, dofs: int = 2) -> tuple[int, Array] | None:
        """Return the body nearest to ``at`` with at least ``dofs`` degrees of freedom, and its surface points (P, 3)
        relative to ``at``."""
        model = self.model
        robot = model.body_rootid[np.linalg.norm(self.poses.position - hand, axis=1)[1:].argmin() + 1]
        best: tuple[float, tuple[int, Array]] | None = None
        for body in sorted({*model.body_weldid[1:].tolist()} - {0}):
            if model.body_rootid[body] == robot or model.body_dofnum[body] < dofs:
                continue
            geoms = [geom for geom in range(model.ngeom) if model.body_weldid[model.geom_bodyid[geom]] == body]
            solid = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
            if parts := [self._surface(geom) - at for geom in solid or geoms]:
                surface = np.concatenate(parts)
                away = float(np.linalg.norm(np.clip(0.0, surface.min(0), surface.max(0))))
                if away <= _NEAR and (best is None or away < best[0]):
                    best = away, (body, surface)
        return None if best is None else best[1]

    def _surface(self, geom: int) -> Array:
        import mujoco  # here, so that importing this module is fast

        model, body = self.model, self.model.geom_bodyid[geom]
        points = _surface_points(model, geom)
        for quaternion, position in (
            (model.geom_quat[geom], model.geom_pos[geom]),
            (self.poses.quaternion[body], self.poses.position[body]),
        ):
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, quaternion)
            points = points @ turn.reshape(3, 3).T + position
        return points


def _surface_points(model: Any, geom: int) -> Array:
    """Return points on a geom in its own frame; for a plane or a height field, only its origin."""
    import mujoco

    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])).name, model.geom_size[geom]
    if kind == "mjGEOM_MESH":
        mesh = model.geom_dataid[geom]
        start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        return np.asarray(model.mesh_vert[start : start + count], np.float64)
    grid = np.stack(np.meshgrid(*[np.linspace(-1.0, 1.0, 9)] * 3), -1).reshape(-1, 3)
    if kind == "mjGEOM_BOX":
        return np.asarray(grid * size)
    if kind == "mjGEOM_CYLINDER":
        around = grid[:, :2] / np.maximum(np.linalg.norm(grid[:, :2], axis=1, keepdims=True), 1e-9)
        return np.concatenate((around * size[0], grid[:, 2:] * size[1]), 1)
    ball = grid / np.maximum(np.linalg.norm(grid, axis=1, keepdims=True), 1e-9)
    if kind == "mjGEOM_SPHERE":
        return np.asarray(ball * size[0])
    if kind == "mjGEOM_ELLIPSOID":
        return np.asarray(ball * size)
    if kind == "mjGEOM_CAPSULE":
        ball = ball * size[0]
        ball[:, 2] += np.sign(ball[:, 2]) * size[1]
        return ball
    return np.zeros((1, 3))
