"""Where a hand takes hold of things, or pushes them, found in the shapes of the simulator's model."""

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

BETWEEN_FINGERS = 0.08  # metres, the widest that is taken hold of
PADS = 0.045  # metres, from the hand's position down to the ends of its fingers
_BELOW_TOP = 0.035  # metres of the fingers that go over a thing's top
_BESIDE = 0.015  # metres from the hand's position to the side of closed fingers that pushes
_NEAR = 0.03  # metres, how far a thing's surface may be from the position that observations tell
_STEP = 0.005  # metres between the places that are looked at


@typed
def find_points(tasks: TaskList = "MT50", *, suite: str | Suite | None = None, episodes: Count = 3) -> dict[str, Task]:
    """The tasks without the points that people named on their things, and with those that shapes tell.

    A thing that lies free and fits between the fingers, which close along y, has a point "... grip" above the place
    nearest to its position where it does, near its top and no lower than fingers reach. One that is too wide has
    "... side": where the hand stands to push it to the task's target. Things on hinges or rails keep their positions.

    Policies on canonical plans use a thing's point wherever a step touches it: give these tasks to
    :func:`~lw_torchrl.load_plans`.

    Args:
        tasks: names, :class:`Task` objects, "MT10" or "MT50".
        suite: theirs, whose engine shows its ``model`` and ``poses``; by default that of the names.
        episodes: first states that are looked at, of seeds 0 and up; the median counts.

    Returns:
        Task name to :class:`Task`, its points in metres beside the thing's position.

    Raises:
        ValueError: unknown tasks.
        TypeError: an engine that does not show its model.

    Example:
        >>> from benchmarks.finding_points import find_points
        >>> find_points("push")["push"].objects[-1].name
        'puck grip'

    Source: ours.
    """
    suite = find_suite(tasks, suite)
    named = suite.named_tasks(tasks)
    engine: Any = suite.make_engine(list(named), reward="sparse", num_threads=1)
    try:
        if not hasattr(engine, "model") or not hasattr(engine, "poses"):
            raise TypeError(f"suite {suite.name!r} must have an engine with model and poses, as engines of MuJoCo have")
        found: dict[str, list[dict[str, tuple[str, Array]]]] = {name: [] for name in named}
        for seed in range(episodes):
            observations = engine.reset(range(len(named)), [seed] * len(named))
            for row, (name, task) in enumerate(named.items()):
                shapes = Shapes(engine.model(row).model, engine.poses(row))
                found[name].append(_points(task, observations[row], shapes))
    finally:
        engine.close()
    return {name: _with_points(task, found[name]) for name, task in named.items()}


def _points(task: Task, observation: Array, shapes: Shapes) -> dict[str, tuple[str, Array]]:
    """Thing's name to what its point is called and where it is, from the thing's position."""
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
    """Where the hand closes its fingers: nearest to the thing's position along x, where it fits between them."""
    best: tuple[float, Array] | None = None
    for x in np.arange(surface[:, 0].min(), surface[:, 0].max() + 1e-9, _STEP):
        near = surface[np.abs(surface[:, 0] - x) <= 4 * _STEP]
        if len(near) > 1 and np.ptp(near[:, 1]) <= BETWEEN_FINGERS and (best is None or abs(x) < best[0]):
            middle = (near[:, 1].min() + near[:, 1].max()) / 2
            best = abs(x), np.array([x, middle, max(near[:, 2].max() + PADS - _BELOW_TOP, table + PADS)])
    return None if best is None else best[1]


def _side(surface: Array, way: Array, table: float) -> Array | None:
    """Where the hand pushes a thing along ``way``: behind the box around it."""
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
        """The body at that place that moves in ``dofs`` directions or more, and its surface (P, 3) from ``at``."""
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
        import mujoco  # importing suites should not wait for it

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
    """Points on a geom, in its own frame; of a plane or a height field only its place."""
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
