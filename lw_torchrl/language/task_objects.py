"""The objects of a task by the part that they play: the first object, the goal, points on an object."""

from __future__ import annotations

from functools import lru_cache

from lw_torchrl.language.layout import places
from lw_torchrl.language.named_objects import GOAL, GRIPPER, NamedObject, typed
from lw_torchrl.language.tasks import Task


def role_object(task: Task, name: str) -> NamedObject:
    """Return the object of a role: the task's, or the goal as "target location", which every observation has."""
    if name == GOAL and name not in task.object_names:
        x, y, z = places(task.layout.positions[-1])
        return NamedObject(GOAL, (x, y, z))
    return task.object(name)


def same_object(task: Task, first: str, second: str) -> bool:
    """Return whether two names are of one object, or of points on it."""
    return typed(role_object(task, first).position) == typed(role_object(task, second).position)


def is_goal(task: Task, name: str) -> bool:
    return same_object(task, name, GOAL)


@lru_cache(maxsize=256)
def whole_objects(task: Task) -> tuple[str, ...]:
    """Return the names of the objects, without the gripper and the points on objects."""
    return tuple(named.name for named in task.objects if named.name != GRIPPER and not any(named.offset))


def first_object(task: Task) -> str | None:
    """Return the object that a task is about, the first of its layout; None for a task with only a goal, like reach."""
    first = typed(places(task.layout.positions[1]))
    return next((name for name in whole_objects(task) if typed(task.object(name).position) == first), None)


def object_of(task: Task, name: str) -> str:
    """Return the object that a point is on; any other name itself."""
    return next((whole for whole in whole_objects(task) if same_object(task, whole, name)), name)


def point_on(task: Task, name: str) -> str:
    """Return where an object is touched: the first point that the task names on it, else the object itself."""
    if any(role_object(task, name).offset):
        return name
    points = (named.name for named in task.objects if any(named.offset) and same_object(task, named.name, name))
    return next(points, name)
