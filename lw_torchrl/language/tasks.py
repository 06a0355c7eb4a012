"""Tasks: names, descriptions and the objects that queries name. data/tasks.toml holds the 50 Meta-World tasks."""

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

from lw_torchrl._util.checks import (
    check_choice,
    check_keys,
    check_value,
    did_you_mean,
    shown,
    typed,
    typed_fields,
    unknown_name,
)
from lw_torchrl._util.files import AnyPath, read_toml
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.language.layout import METAWORLD, Layout, places
from lw_torchrl.language.objects import GOAL, GRIPPER, NamedObject, read_objects, typed_position, write_objects

if TYPE_CHECKING:
    from torch import Tensor

_NAME = re.compile(r"([a-z][a-z0-9]*(-[a-z0-9]+)*/)?[a-z][a-z0-9]*(-[a-z0-9]+)*")
_OWN_IDS = 2**31 - 50  # number of ids for custom tasks; every id fits in an int32
_MOST_OBJECTS = 64  # the number of base queries grows quadratically


class TaskError(ValueError):
    """The error for a task or a task file that cannot be read or written."""


@typed_fields
@dataclass(frozen=True)
class Task:
    """A manipulation task: its name, its description and its objects.

    The name is Meta-World's name without the version ("drawer-open"), or a custom name of lower-case words joined by
    hyphens. A suite's name and a slash may come first ("fetch/push").
    """

    name: str
    description: str  # one sentence
    objects: tuple[NamedObject, ...]  # at most 64: the robot's gripper first, our added points last
    layout: Layout = METAWORLD

    def __post_init__(self) -> None:
        _check_name(self.name)
        size = self.layout.size
        for named in self.objects:
            for index in (*named.position, named.opening):
                if isinstance(index, int) and not 0 <= index < size:
                    raise ValueError(f"position of {named.name!r} must use obs[0] to obs[{size - 1}], got obs[{index}]")
        names = [named.name for named in self.objects]
        if names[:1] != [GRIPPER] or len({*names}) != len(names) or len(names) > _MOST_OBJECTS:
            raise ValueError(f"objects of {self.name!r} must be 1 to 64, distinct, {GRIPPER!r} first, got {names}")

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """The names of the objects, in the order of ``objects``."""
        return tuple(named.name for named in self.objects)

    @cached_property
    def published(self) -> Task:
        """The task as defined in the paper, without the points and object openings that this package adds."""
        return replace(self, objects=tuple(replace(named, opening=None) for named in self.objects if not named.ours))

    def object(self, name: str) -> NamedObject:
        """Return the object called ``name``; raise a ValueError that suggests the nearest name if there is none."""
        for named in self.objects:
            if named.name == name:
                return named
        raise unknown_name(f"object of task {self.name!r}", name, self.object_names)

    @cached_property
    def openings(self) -> dict[str, int]:
        """The observation index of each object's degree of opening, keyed by object name; the gripper comes first."""
        openings = {named.name: named.opening for named in self.objects if named.opening is not None}
        return {GRIPPER: self.layout.opening, **openings}

    def positions(self, observation: Tensor) -> dict[str, Tensor]:
        """Return each object's position (..., 3) in metres by name, in the dtype of the observation (..., D)."""

        def position(named: NamedObject) -> Tensor:
            xyz = observation[..., [at if isinstance(at, int) else 0 for at in named.position]]
            for axis, (at, shift) in enumerate(zip(named.position, named.offset, strict=True)):
                if not isinstance(at, int):
                    xyz[..., axis] = at
                xyz[..., axis] += shift
            return xyz

        return {named.name: position(named) for named in self.objects}

    def to_json(self) -> dict[str, Any]:
        """Convert the task to a row of tasks.toml; raise a TaskError if such a row cannot express the task."""
        row = {"description": self.description, **write_objects(self.objects)}
        if self.layout != METAWORLD:
            row["layout"] = self.layout.to_json()
        with suppress(TaskError):
            if Task.from_json(self.name, row) == self:
                return {key: value for key, value in row.items() if value}
        raise TaskError(f"a row of tasks.toml cannot express the objects of task {self.name!r}, got {self.objects!r}")

    @classmethod
    def from_json(cls, name: str, row: Any, layout: Layout = METAWORLD) -> Task:
        """Build a task from an entry of tasks.toml, by default with ``layout``; raise a TaskError if the entry is
        invalid.
        """
        try:
            check_keys("the task", row, ("description", "objects", "points", "layout", "mt10"))
            description = row.get("description")
            if not isinstance(description, str) or not description.strip():
                raise ValueError(f"description must be a sentence, got {shown(description)}")
            layout = Layout.from_json(row["layout"]) if "layout" in row else layout
            return cls(name, description, read_objects(row, layout), layout)
        except (ValueError, TypeError) as error:
            raise TaskError(f"task {shown(name)}: {error}") from error


def role_object(task: Task, name: str) -> NamedObject:
    """Return the object that a role names; "target location" is the goal in every task."""
    if name == GOAL and name not in task.object_names:
        x, y, z = places(task.layout.positions[-1])
        return NamedObject(GOAL, (x, y, z))
    return task.object(name)


def same_object(task: Task, first: str, second: str) -> bool:
    """Return whether two names refer to the same object or to points on the same object."""
    return typed_position(role_object(task, first).position) == typed_position(role_object(task, second).position)


def is_goal(task: Task, name: str) -> bool:
    """Return whether a name refers to the goal of a task."""
    return same_object(task, name, GOAL)


@lru_cache(maxsize=256)
def whole_objects(task: Task) -> tuple[str, ...]:
    """Return the names of a task's objects, without the gripper and without points on objects."""
    return tuple(named.name for named in task.objects if named.name != GRIPPER and not any(named.offset))


def first_object(task: Task) -> str | None:
    """Return the first object in a task's layout; None for a task with only a goal, such as reach."""
    first = typed_position(places(task.layout.positions[1]))
    return next((name for name in whole_objects(task) if typed_position(task.object(name).position) == first), None)


def object_of(task: Task, name: str) -> str:
    """Return the name of the object that a point belongs to; any other name is returned unchanged."""
    return next((whole for whole in whole_objects(task) if same_object(task, whole, name)), name)


def point_on(task: Task, name: str) -> str:
    """Return the point where the gripper touches an object: the object's first named point, else the object itself."""
    if any(role_object(task, name).offset):
        return name
    points = (named.name for named in task.objects if any(named.offset) and same_object(task, named.name, name))
    return next(points, name)


def _check_name(name: str) -> str:
    if not _NAME.fullmatch(name):
        raise ValueError(f"task must be lower-case words joined by hyphens, like 'drawer-open', got {shown(name)}")
    return name


_TABLE = dict(sorted(read_toml(files("lw_torchrl.language") / "data" / "tasks.toml", TaskError).items()))
Tasks = Mapping[str, Task]
TaskList = str | Task | Iterable[str | Task]


class _Shipped(dict[str, Task]):
    """A dictionary with a short ``repr``, since ``help`` prints it as the default of arguments."""

    def __repr__(self) -> str:
        return f"lw.TASKS, the {len(self)} tasks from {min(self)} to {max(self)}"


TASKS: Tasks = ReadOnlyDict(_Shipped((name, Task.from_json(name, row)) for name, row in _TABLE.items()))
"""The 50 Meta-World tasks by name, sorted."""
MT10: tuple[str, ...] = tuple(name for name, row in _TABLE.items() if row.get("mt10"))
"""The names of the ten MT10 tasks."""
MT50: tuple[str, ...] = tuple(TASKS)
"""The names of Meta-World's 50 tasks, sorted."""
_SETS = {"MT10": MT10, "MT50": MT50}
_RANK = {name: rank for rank, name in enumerate(MT50)}


def check_task(name: Any, tasks: Tasks = TASKS) -> str:
    """Return ``name`` if ``tasks`` has this task; else raise a ValueError that suggests the nearest name."""
    if check_value("task", name, str) not in tasks:
        raise _unknown_task("task", name, tasks)
    return name


def _unknown_task(argument: str, name: str, tasks: Tasks) -> ValueError:
    """Build the error for an unknown task name, with a hint about custom tasks if only the 50 tasks are known."""
    if "," in name and all(part in tasks for part in re.split(r",\s*", name)):
        return ValueError(f"{argument} must be separate names, got {name!r}; use spaces in a shell, a list in Python")
    error = unknown_name(argument, name, tasks if argument == "task" else (*_SETS, *tasks))
    if tasks is not TASKS:
        return error
    message = str(error) if str(error).endswith("?") else f"{error}."
    return ValueError(f"{message} For a custom task, pass a Task and an engine=; see docs/your-robot.md#a-custom-task")


@typed
def task_id(name: str) -> int:
    """Return a task's integer id.

    The ids of the 50 Meta-World tasks are their ranks (from 0) among the sorted names. Any other name has an id from 50
    to 2³¹ - 1 that depends only on the name, so even a misspelled name has an id.

    Example:
        >>> task_id("assembly"), task_id("window-open"), task_id("stack-blocks")
        (0, 49, 650718257)
    """
    if name in _RANK:
        return _RANK[name]
    digest = blake2b(_check_name(name).encode(), digest_size=8).digest()
    return len(MT50) + int.from_bytes(digest, "big") % _OWN_IDS


def task_ids(names: Iterable[str]) -> dict[str, int]:
    """Map each task name to the task's id."""
    return {name: task_id(name) for name in names}


def resolve_tasks(names: str | Iterable[str], *, tasks: Tasks = TASKS) -> tuple[str, ...]:
    """Return the sorted names of the tasks that ``names`` selects.

    Args:
        names: "MT10", "MT50", a task's name, or an iterable of names.
        tasks: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.

    Example:
        >>> resolve_tasks(["push", "door-open"])
        ('door-open', 'push')
    """
    check_value("tasks", tasks, Mapping)
    check_value("tasks", names, str | Iterable[str])
    if isinstance(names, str):
        if names not in tasks and names not in _SETS:
            raise _unknown_task("tasks", names, tasks)
        names = _SETS.get(names, (names,))
    checked = [check_task(name, tasks) for name in names]
    if not checked or len({*checked}) < len(checked):
        raise ValueError(f"tasks must name at least one task, without duplicates, got {shown(checked)}")
    return tuple(sorted(checked))


def named_tasks(tasks: TaskList, *, known: Tasks = TASKS) -> dict[str, Task]:
    """Return the selected tasks as a dict from name to :class:`Task`, sorted by name.

    Args:
        tasks: names as for :func:`resolve_tasks`, or :class:`Task` objects, which replace known tasks with the same
            name. A mapping of plans selects the tasks of the plans.
        known: the known tasks by name, as from :func:`~lw_torchrl.load_tasks`.
    """
    names: Any = [tasks] if isinstance(tasks, Task) else tasks
    if isinstance(names, Mapping):
        names = [getattr(value, "definition", value) for value in names.values()]
    if not isinstance(names, str) and isinstance(names, Iterable):
        listed = list(names)
        own = {task.name: task for task in listed if isinstance(task, Task)}
        known, names = {**known, **own} if own else known, [getattr(task, "name", task) for task in listed]
    return {name: known[name] for name in resolve_tasks(names, tasks=known)}


def get_task(task: str | Task, tasks: Tasks = TASKS) -> Task:
    """Return the :class:`Task` with a given name in ``tasks``; return a Task unchanged."""
    return task if isinstance(task, Task) else tasks[check_task(task, tasks)]


def lists_by_task(argument: str, lists: Mapping[str | Task, Any]) -> dict[Task, list[Any]]:
    """Return lists keyed by :class:`Task`; raise a ValueError if there are none, one is empty or a task is repeated."""
    check_value(argument, lists, Mapping)
    tasks = (name if isinstance(name, Task) else TASKS[check_choice(argument, name, TASKS)] for name in lists)
    by_task = dict(zip(tasks, lists.values(), strict=True))
    is_full = bool(by_task) and all(isinstance(listed, list | tuple) and listed for listed in by_task.values())
    if not is_full or len({task.name for task in by_task}) < len(lists):
        raise ValueError(f"{argument} must map one or more distinct tasks to non-empty lists, got {shown(lists)}")
    return by_task


def one_layout(tasks: Iterable[Task]) -> Layout:
    """Return the layout that all tasks share; raise a ValueError if their layouts differ."""
    layouts = {task.layout: task.name for task in tasks}
    if len(layouts) != 1:
        listed = ", ".join(f"{layout.name!r} ({name})" for layout, name in layouts.items())
        raise ValueError(f"tasks must share one layout, got {listed}; use one program, buffer or policy per suite")
    return next(iter(layouts))


@typed
def load_tasks(path: AnyPath) -> Tasks:
    """Load tasks from a file, and return them with the 50 Meta-World tasks, by name.

    A task in the file replaces a Meta-World task with the same name.

    Pass one of the returned tasks wherever a task is accepted, or the whole mapping as the ``tasks`` of
    :func:`~lw_torchrl.load_plans` and :func:`~lw_torchrl.resolve_tasks`.

    Args:
        path: a file in the format of data/tasks.toml. A new task must list its objects.

    Raises:
        TaskError: the file is malformed; the message names the task.

    Example:
        >>> row = "[push]\\ndescription = 'Push the disc.'\\nobjects.disc = 'obs[4:7]'"
        >>> _ = Path("mine.toml").write_text(row)
        >>> load_tasks("mine.toml")["push"].object_names
        ("robot's gripper", 'disc')
    """
    file = Path(path)
    tasks = dict(TASKS)
    for name, row in read_toml(file, TaskError).items():
        try:
            tasks[name] = Task.from_json(name, row)
            if name not in TASKS and len(tasks[name].objects) == 1:
                hint = did_you_mean(name, TASKS)
                raise TaskError(f"task {name!r} is not a Meta-World task, so its row must list objects{hint}")
        except TaskError as error:
            raise TaskError(f"{file}, {error}") from error
    return ReadOnlyDict(dict(sorted(tasks.items())))
