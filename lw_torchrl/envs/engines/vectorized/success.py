"""Meta-World's success of many rows at once: a point comes close to the goal, or one of the rules below."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from lw_torchrl.envs.engines.vectorized.observation import (
    GRIPPER,
    JOINT,
    LEFT_TIP,
    OBJECT,
    POINT,
    RIGHT_TIP,
    SECOND,
    Array,
    Index,
    Mask,
    row_norm,
)
from lw_torchrl.envs.engines.vectorized.tables import TaskSources


class Scene(NamedTuple):
    """The inputs of a rule, one entry a row: whether the point is as close to the goal as the table asks, the sensors,
    the first 18 numbers of the observations, the goals (rows, 3), and the points (rows, 3) that are to reach them."""

    near: Mask
    sensors: Array
    current: Array
    goal: Array
    point: Array


STICK_LIFT = 0.01  # metres above where the stick lay
STICK_SIDEWAYS = 0.04  # metres between the stick's end and the handle
STICK_UPWARD = 0.06


class SuccessFunction:
    """The success of a fixed set of rows; ``programs`` gives a row's present
    :class:`~lw_torchrl.envs.engines.vectorized.task_programs.TaskProgram`, for the one rule that looks at contacts."""

    def __init__(self, sources: Sequence[TaskSources], programs: Callable[[int], Any]) -> None:
        success = [row.success for row in sources]
        self._programs = programs
        self._offset, self._axes, self._within, self._under, self._above, self._angle = (
            np.array([getattr(row, name) for row in success])
            for name in ("offset", "axes", "within", "under", "above", "angle")
        )
        points = [row.point for row in success]
        self._seconds = np.flatnonzero([point == "second" for point in points])
        self._grippers = np.flatnonzero([point == "gripper" for point in points])
        self._places = np.flatnonzero([point not in ("object", "second", "gripper") for point in points])
        self._at_height = np.flatnonzero([row.goal_height is not None for row in success])
        self._goal_height = np.array([row.goal_height for row in success if row.goal_height is not None])
        rules = [row.rule for row in success]
        self._rules = [
            (getattr(SuccessFunction, "_" + name.replace(" ", "_")), np.flatnonzero([rule == name for rule in rules]))
            for name in sorted({rule for rule in rules if rule is not None})
        ]

    def __call__(self, sensors: Array, current: Array, goal: Array) -> Mask:
        """(rows,) whether each row succeeds, by sensors (rows, WIDTH), observations (rows, 18) and goals (rows, 3)."""
        point = current[:, OBJECT].copy()
        if self._seconds.size:
            point[self._seconds] = current[self._seconds, SECOND]
        if self._grippers.size:
            tips = sensors[self._grippers]
            point[self._grippers] = (tips[:, RIGHT_TIP] + tips[:, LEFT_TIP]) / 2.0
        if self._places.size:
            point[self._places] = sensors[self._places, POINT]
        if self._at_height.size:
            goal = goal.copy()
            goal[self._at_height, 2] = self._goal_height
        distance = row_norm((point + self._offset - goal) * self._axes)
        success = (distance <= self._within) & (distance < self._under)
        scene = Scene(success, sensors, current, goal, point)
        for rule, rows in self._rules:
            success[rows] = rule(self, rows, scene)
        return success

    def _point_below_goal(self, rows: Index, scene: Scene) -> Mask:
        """The ring is over the peg and has sunk below its top."""
        return scene.near[rows] & (scene.goal[rows, 2] - scene.point[rows, 2] > 0.0)

    def _object_above_goal(self, rows: Index, scene: Scene) -> Mask:
        """The object is higher than the goal, wherever it is."""
        return scene.current[rows, OBJECT.stop - 1] > scene.goal[rows, 2]

    def _joint_above(self, rows: Index, scene: Scene) -> Mask:
        """The joint has moved further than ``above``."""
        return scene.sensors[rows, JOINT.start] > self._above[rows]

    def _joint_near(self, rows: Index, scene: Scene) -> Mask:
        """The joint is within ``within`` of ``angle``."""
        return np.abs(scene.sensors[rows, JOINT.start] - self._angle[rows]) <= self._within[rows]

    def _stick_inserted(self, rows: Index, scene: Scene) -> Mask:
        """The container is at the goal, and the stick's end is through its handle."""
        held = scene.near[rows]
        if held.any():
            end, handle = scene.sensors[rows, POINT], scene.current[rows, SECOND]
            aside = np.abs(end - handle)
            held &= end[:, 0] >= handle[:, 0]
            held &= (aside[:, 1] <= STICK_SIDEWAYS) & (aside[:, 2] <= STICK_UPWARD)
        return held

    def _stick_held(self, rows: Index, scene: Scene) -> Mask:
        """The container is at the goal, and the gripper holds the stick up."""
        held = scene.near[rows]
        for k in np.flatnonzero(held):
            current, program = scene.current[rows[k]], self._programs(int(rows[k]))
            lifted = current[OBJECT][2] - STICK_LIFT > program.stick_init_pos[2]
            held[k] = current[GRIPPER] > 0.0 and lifted and both_pads_press(program, "objGeom")
        return held


def both_pads_press(program: Any, geom: str) -> bool:
    """Whether both pads of the gripper push against a geom, by the contact forces Meta-World looks at."""
    model, data = program.model, program.data
    pairs = data.contact.geom
    touched = (pairs == model.geom(geom).id).any(axis=1)
    for pad in ("leftpad_geom", "rightpad_geom"):
        contacts = touched & (pairs == model.geom(pad).id).any(axis=1)
        if not sum(data.efc_force[data.contact.efc_address[contacts]]) > 0:
            return False
    return True
