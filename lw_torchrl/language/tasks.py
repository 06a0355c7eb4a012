"""Tasks: names, descriptions, and the objects that queries name. The table of the 50 is data/tasks.toml."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from hashlib import blake2b
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lw_torchrl._util.checks import check_choice, did_you_mean, shown, typed, typed_fields, unknown_name
from lw_torchrl._util.files import AnyPath, read_toml
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.language.layout import METAWORLD, Layout, places
from lw_torchrl.language.objects import (
    GOAL,
    GRIPPER,
    NamedObject,
    check_inside,
    read_objects,
    typed_position,
    write_objects,
)

if TYPE_CHECKING:
    from torch import Tensor


def role_object(task: Task, name: str) -> NamedObject:
    """Return the object of a role: the task's, or the goal as "target location", which every observation has."""
    if name == GOAL and name not in task.object_names:
        x, y, z = places(task.layout.positions[-1])
        return NamedObject(GOAL, (x, y, z))
    return task.object(name)


def same_object(task: Task, first: str, second: str) -> bool:
    """Return whether two names are of one object, or of points on it."""
    return typed_position(role_object(task, first).position) == typed_position(role_object(task, second).position)


def is_goal(task: Task, name: str) -> bool:
    return same_object(task, name, GOAL)


@lru_cache(maxsize=256)
def whole_objects(task: Task) -> tuple[str, ...]:
    """Return the names of the objects, without the gripper and the points on objects."""
    return tuple(named.name for named in task.objects if named.name != GRIPPER and not any(named.offset))


def first_object(task: Task) -> str | None:
    """Return the object that a task is about, the first of its layout; None for a task with only a goal, like reach."""
    first = typed_position(places(task.layout.positions[1]))
    return next((name for name in whole_objects(task) if typed_position(task.object(name).position) == first), None)


def object_of(task: Task, name: str) -> str:
    """Return the object that a point is on; any other name itself."""
    return next((whole for whole in whole_objects(task) if same_object(task, whole, name)), name)


def point_on(task: Task, name: str) -> str:
    """Return where an object is touched: the first point that the task names on it, else the object itself."""
    if any(role_object(task, name).offset):
        return name
    points = (named.name for named in task.objects if any(named.offset) and same_object(task, named.name, name))
    return next(points, name)


_NAME = re.compile(r"([a-z][a-z0-9]*(-[a-z0-9]+)*/)?[a-z][a-z0-9]*(-[a-z0-9]+)*")
_OWN_IDS = 2**31 - 50  # so that an id is an int32 too
_MOST_OBJECTS = 64  # the base queries are of all pairs of them


class TaskError(ValueError):
    """A task that cannot be read or written, or a file of such tasks."""


@typed_fields
@dataclass(frozen=True)
class Task:
    """One manipulation task in words.

    Its name is "drawer-open", Meta-World's without its version; or your own, lower-case words joined by hyphens, after
    a suite's name and a slash if it is one of a suite: "fetch/push".
    """

    name: str
    description: str  # one sentence
    objects: tuple[NamedObject, ...]  # at most 64: the robot's gripper first, the points that we named last
    layout: Layout = METAWORLD

    def __post_init__(self) -> None:
        if not isinstance(self.objects, tuple) or not all(isinstance(one, NamedObject) for one in self.objects):
            raise TypeError(f"objects of task {self.name!r} must be a tuple of NamedObject, got {shown(self.objects)}")
        _check_name(self.name)
        if not isinstance(self.layout, Layout):
            raise TypeError(f"layout of task {self.name!r} must be a Layout, got {shown(self.layout)}")
        for named in self.objects:
            check_inside(named, self.layout.size)
        if len(self.objects) > _MOST_OBJECTS:
            count = f"at most {_MOST_OBJECTS}, the gripper included, got {len(self.objects)}"
            raise ValueError(f"objects of task {self.name!r} must be {count}")
        names = [named.name for named in self.objects]
        if names[:1] != [GRIPPER] or len({*names}) != len(names):
            what = f"begin with {GRIPPER!r} and have different names"
            raise ValueError(f"objects of task {self.name!r} must {what}, got {names}")

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """The names of the objects, in their order."""
        return tuple(named.name for named in self.objects)

    @cached_property
    def published(self) -> Task:
        """The task without the points that we named and without openings but the gripper's."""
        return replace(self, objects=tuple(replace(named, opening=None) for named in self.objects if not named.ours))

    def object(self, name: str) -> NamedObject:
        """The object called ``name``; :class:`ValueError` names the nearest if there is none."""
        for named in self.objects:
            if named.name == name:
                return named
        raise unknown_name(f"object of task {self.name!r}", name, self.object_names)

    @cached_property
    def openings(self) -> dict[str, int]:
        """The index of the opening of each object that has one, the gripper first."""
        found = {named.name: named.opening for named in self.objects if named.opening is not None}
        return {GRIPPER: self.layout.opening, **found}

    def positions(self, observation: Tensor) -> dict[str, Tensor]:
        """Where each object is: (..., D) float, metres, to name -> (..., 3) of the same dtype, metres."""

        def position(named: NamedObject) -> Tensor:
            xyz = observation[..., [at if isinstance(at, int) else 0 for at in named.position]]
            for axis, (at, shift) in enumerate(zip(named.position, named.offset, strict=True)):
                if not isinstance(at, int):
                    xyz[..., axis] = at
                xyz[..., axis] += shift
            return xyz

        return {named.name: position(named) for named in self.objects}

    def to_json(self) -> dict[str, Any]:
        """Return the task as a row of tasks.toml; a :class:`TaskError` if a row cannot hold it."""
        row = {"description": self.description, **write_objects(self.objects)}
        if self.layout != METAWORLD:
            row["layout"] = self.layout.to_json()
        with suppress(TaskError):
            if Task.from_json(self.name, row) == self:
                return {key: value for key, value in row.items() if value}
        raise TaskError(f"task {self.name!r} cannot be written as a row of tasks.toml, it holds {self.objects!r}")

    @classmethod
    def from_json(cls, name: str, row: Any, layout: Layout = METAWORLD) -> Task:
        """The task of a row of tasks.toml, by default of ``layout``; any other value is a :class:`TaskError`."""
        try:
            if not isinstance(row, Mapping):
                raise ValueError(f"must be a table, got {shown(row)}")
            for key in row:
                check_choice("key", key, ("description", "objects", "points", "layout", "mt10"))
            description = row.get("description")
            if not isinstance(description, str) or not description.strip():
                raise ValueError(f"description must be a sentence, got {shown(description)}")
            layout = Layout.from_json(row["layout"]) if "layout" in row else layout
            return cls(name, description, read_objects(row, layout), layout)
        except (ValueError, TypeError) as error:
            raise TaskError(f"task {shown(name)}: {error}") from error


def _check_name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(f"task must be lower-case words joined by hyphens, like 'drawer-open', got {shown(name)}")
    return name


_TABLE = dict(sorted(read_toml(files("lw_torchrl.language") / "data" / "tasks.toml", TaskError).items()))
Tasks = Mapping[str, Task]
TaskList = str | Task | Iterable[str | Task]


class _Shipped(dict[str, Task]):
    """Shown by its name: as the default of an argument it stands in what ``help`` prints."""

    def __repr__(self) -> str:
        return f"lw.TASKS, the {len(self)} tasks from {min(self)} to {max(self)}"


TASKS: Tasks = ReadOnlyDict(_Shipped((name, Task.from_json(name, row)) for name, row in _TABLE.items()))
MT10: tuple[str, ...] = tuple(name for name, row in _TABLE.items() if row.get("mt10"))
"""TASKS maps the 50 names, sorted, to their :class:`Task`; MT10 names the ten of the MT10 set."""
MT50: tuple[str, ...] = tuple(TASKS)
_SETS = {"MT10": MT10, "MT50": MT50}
_RANK = {name: rank for rank, name in enumerate(MT50)}


def check_task(name: object, tasks: Tasks = TASKS) -> str:
    """Return ``name`` if it names one of ``tasks``, else raise :class:`ValueError` with the nearest name."""
    if not isinstance(name, str):
        raise TypeError(f"task must be a task's name, got {shown(name)} ({type(name).__name__})")
    if name not in tasks:
        raise _unknown_task("task", name, tasks)
    return name


def _unknown_task(argument: str, name: str, tasks: Tasks) -> ValueError:
    """The error for a name that is none of ``tasks``; where these are the 50, it says how other tasks are given."""
    error = unknown_name(argument, name, tasks if argument == "task" else (*_SETS, *tasks))
    if tasks is not TASKS:
        return error
    said = str(error) if str(error).endswith("?") else f"{error}."
    return ValueError(f"{said} A task of your own is a Task with an engine=, see docs/training.md#a-task-of-your-own")


@typed
def task_id(name: str) -> int:
    """Return the integer of a task: of the 50, the rank among the sorted names, from 0; of any other, a number from
    50 to 2³¹ - 1 that depends only on the name. A misspelt name has an id too.

    Example:
        >>> task_id("assembly"), task_id("window-open"), task_id("stack-blocks")
        (0, 49, 650718257)
    """
    if name in _RANK:
        return _RANK[name]
    digest = blake2b(_check_name(name).encode(), digest_size=8).digest()
    return len(MT50) + int.from_bytes(digest, "big") % _OWN_IDS


def task_ids(names: Iterable[str]) -> dict[str, int]:
    """Return the id of each task by its name."""
    return {name: task_id(name) for name in names}


def resolve_tasks(names: str | Iterable[str], *, tasks: Tasks = TASKS) -> tuple[str, ...]:
    """Return the names of a set, a task, or a list of tasks, sorted.

    Args:
        names: "MT10", "MT50", one task's name, or an iterable of names.
        tasks: the tasks there are, by name, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> resolve_tasks(["push", "door-open"])
        ('door-open', 'push')
    """
    if not isinstance(tasks, Mapping):
        raise TypeError(f"tasks must map names to Task, got {shown(tasks)} ({type(tasks).__name__})")
    if isinstance(names, str):
        if names not in tasks and names not in _SETS:
            raise _unknown_task("tasks", names, tasks)
        names = _SETS.get(names, (names,))
    if not isinstance(names, Iterable):
        raise TypeError(f"tasks must be 'MT10', 'MT50', a task's name or a list of names, got {shown(names)}")
    found = [check_task(name, tasks) for name in names]
    if not found:
        raise ValueError("tasks must name at least one task, got an empty list")
    if len(set(found)) != len(found):
        repeated = sorted({name for name in found if found.count(name) > 1})
        raise ValueError(f"tasks must name each task once, got {', '.join(repeated)} more than once")
    return tuple(sorted(found))


def named_tasks(tasks: TaskList, *, known: Tasks = TASKS) -> dict[str, Task]:
    """Return the tasks of a set, a name, a Task, or a list of names and Tasks, by name, sorted.

    Args:
        tasks: as for :func:`resolve_tasks`; a :class:`Task` counts for itself, whatever else has its name. Plans stand
            for the tasks that they are for.
        known: the tasks that names stand for, as from :func:`~lw_torchrl.load_tasks`.
    """
    names: Any = [tasks] if isinstance(tasks, Task) else tasks
    if isinstance(names, Mapping):
        names = [getattr(one, "definition", one) for one in names.values()]
    if not isinstance(names, str) and isinstance(names, Iterable):
        listed = list(names)
        own = {task.name: task for task in listed if isinstance(task, Task)}
        known, names = {**known, **own} if own else known, [getattr(task, "name", task) for task in listed]
    return {name: known[name] for name in resolve_tasks(names, tasks=known)}


def get_task(task: str | Task, tasks: Tasks = TASKS) -> Task:
    """The :class:`Task` of a name among ``tasks``; a Task is returned as it is."""
    return task if isinstance(task, Task) else tasks[check_task(task, tasks)]


def one_layout(tasks: Iterable[Task]) -> Layout:
    """The layout of tasks that are used together; :class:`ValueError` if they have different ones."""
    found = {task.layout: task.name for task in tasks}
    if len(found) != 1:
        told = ", ".join(f"{layout.name!r} ({name})" for layout, name in found.items())
        raise ValueError(f"tasks must be of one layout, got {told}; use a program, buffer or policy for each suite")
    return next(iter(found))


@typed
def load_tasks(path: AnyPath) -> Tasks:
    """Return all 50 tasks and those of your file, by name: some of the 50 with other objects or words, or new tasks.

    Pass one wherever a task is accepted, or all of them to :func:`~lw_torchrl.load_plans` and
    :func:`~lw_torchrl.resolve_tasks`.

    Args:
        path: a file in the format of data/tasks.toml, else a :class:`TaskError`. A new task must name its objects.

    Example:
        >>> row = "[push]\\ndescription = 'Push the disc.'\\nobjects.disc = 'obs[4:7]'"
        >>> _ = Path("mine.toml").write_text(row)
        >>> load_tasks("mine.toml")["push"].object_names
        ("robot's gripper", 'disc')
    """
    file = Path(path)
    found = dict(TASKS)
    for name, row in read_toml(file, TaskError).items():
        try:
            found[name] = Task.from_json(name, row)
            if name not in TASKS and len(found[name].objects) == 1:
                near = did_you_mean(name, TASKS)
                raise TaskError(f"task {name!r}: is none of the 50, so it must name its objects{near}")
        except TaskError as error:
            raise TaskError(f"{file}, {error}") from error
    return ReadOnlyDict(dict(sorted(found.items())))
