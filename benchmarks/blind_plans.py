"""Plans made without reading text: one motion for all tasks, or a motion chosen from the geometry of initial states."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.finding_points import Shapes
from lw_torchrl.language.canonical import canonical_plan, fallback_plan, plan_of_motion
from lw_torchrl.language.objects import GOAL, GRIPPER
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.roles import StepRole
from lw_torchrl.language.tasks import Task, first_object, get_task
from lw_torchrl.suites.suite import find_suite

Array = NDArray[np.float64]
Blind = Literal["default", "carried", "chooser"]
BLIND: tuple[Blind, ...] = get_args(Blind)
_LEVEL = 0.03  # metres, the maximum difference in height between a goal and an object that is slid to it
_OVER_TABLE = 0.03  # metres above object and goal at which to look for a wall between them


def blind_plans(how: Blind, tasks: Iterable[str | Task]) -> Plans:
    """Make plans for tasks without reading their texts, with the same fallback steps as all other plans.

    "default" grasps the first object and slides it to the goal; "carried" lifts it first. "chooser" selects a motion by
    the initial states of three episodes. An object on a hinge or rail is pressed if it must move down, pulled if it
    must move up or toward the robot, and otherwise pushed to the goal. A free object is slid to a goal at the same
    height if nothing is in between, and otherwise carried.

    Example:
        >>> from benchmarks.blind_plans import blind_plans
        >>> [step.role.verb for step in blind_plans("chooser", ["push-wall"])["push-wall"].steps][:4]
        ['approach', 'descend', 'close', 'carry']
    """
    known = [get_task(task) for task in tasks]
    names = [task.name for task in known]
    motions = _choose(names) if how == "chooser" else dict.fromkeys(names, "carry" if how == "carried" else "move")
    return Plans([canonical_plan(_plan(task, motions[task.name]), fallback=True) for task in known])


def _plan(task: Task, motion: str) -> ConditionalPlan:
    held = first_object(task)
    if held is None:
        return fallback_plan(task)
    roles = {
        "move": StepRole("move", held, GOAL, "grasp"),
        "carry": StepRole("carry", held, GOAL, "grasp"),
        "press": StepRole("push", GRIPPER, held, "press", "down"),
        "push": StepRole("push", GRIPPER, held, "push", "goal"),
    }
    return plan_of_motion(task, roles[motion])


def _choose(tasks: list[str]) -> dict[str, str]:
    """Return the motion of each task: "move", "carry", "push" or "press"."""
    engine: Any = find_suite(tasks).make_engine(tasks, reward="sparse", num_threads=1)
    seen: dict[str, list[str]] = {task: [] for task in tasks}
    for seed in range(3):
        observations = engine.reset(range(len(tasks)), [seed] * len(tasks))
        for row, task in enumerate(tasks):
            (_, model), data = engine._seen(row)
            seen[task].append(_motion(observations[row], model, data, Shapes(model, engine.poses(row))))
    engine.close()
    return {task: max(motions, key=motions.count) for task, motions in seen.items()}


def _motion(observation: Array, model: Any, data: Any, shapes: Shapes) -> str:
    at, second, goal = observation[4:7], observation[11:14], observation[36:39]
    body = shapes.nearest(at, observation[:3], dofs=1)
    if body is None:
        return "move"
    way, first = goal - at, model.body_jntadr[body[0]]
    if model.jnt_type[first] == mujoco.mjtJoint.mjJNT_FREE:
        level = abs(way[2]) <= _LEVEL and not second.any()
        return "move" if level and not _between(model, data, body[0], at, goal) else "carry"
    if model.body_dofnum[body[0]] == 1:  # on a hinge or a rail; a plate moves on two rails
        turns = model.jnt_type[first] == mujoco.mjtJoint.mjJNT_HINGE
        along = np.cross(data.xaxis[first], at - data.xanchor[first]) if turns else data.xaxis[first]
        way = along * np.sign(along @ way)
    axis = int(np.abs(way).argmax())
    if axis == 2:
        return "press" if way[2] < 0 else "move"
    return "move" if axis == 1 and way[1] < 0 else "push"


def _between(model: Any, data: Any, body: int, at: Array, goal: Array) -> bool:
    """Return whether a ray from slightly above an object to slightly above the goal hits something else."""
    start, end = (place + np.array([0.0, 0.0, _OVER_TABLE]) for place in (at, goal))
    geom = np.zeros(1, np.int32)
    for _ in range(10):  # skip the object's own geoms
        share = mujoco.mj_ray(model, data, start, end - start, None, 1, -1, geom)
        if not 0 <= share < 1:
            return False
        if model.body_weldid[model.geom_bodyid[geom[0]]] != body:
            return True
        start = start + (share + 1e-3) * (end - start)
    return False
