"""The 50 tasks: names, descriptions, and the objects that queries name. The table itself is data/tasks.toml."""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import unknown_name
from lw_torchrl.language.observation import OBSERVATION_SIZE

GRIPPER = "robot's gripper"
Coordinate = int | float
"""An int is an index into the observation, a float a fixed number of metres."""

_SLICE = re.compile(r"obs\[(\d+):(\d+)\]")
_INDEX = re.compile(r"obs\[(\d+)\]")


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9


def coordinate_index(coordinate: Coordinate, constants: list[float]) -> int:
    """Where a coordinate stands in the 39 numbers of an observation followed by ``constants``, which grow at need."""
    if isinstance(coordinate, int):
        return coordinate
    if coordinate not in constants:
        constants.append(coordinate)
    return OBSERVATION_SIZE + constants.index(coordinate)


@dataclass(frozen=True)
class NamedObject:
    """An object that queries can name.

    Attributes:
        name: "drawer handle", in lower case and without an article.
        position: where x, y and z are found: an int is an index into the 39 numbers of the observation,
            a float is a fixed place in metres.
        offset: added to it, metres; a point beside an object has one.
        ours: a point that we named, and the published object list has not.

    Raises:
        ValueError: the name is not plain lower-case words, or a coordinate lies outside the observation.
    """

    name: str
    position: tuple[Coordinate, Coordinate, Coordinate]
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ours: bool = False

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9'-]*( [a-z0-9][a-z0-9'-]*)*", self.name):
            raise ValueError(f"name must be lower-case words like 'drawer handle', got {self.name!r}")
        if {"and", "is", "not", "the"} & set(self.name.split()):
            raise ValueError(f"name may not contain 'and', 'is', 'not' or 'the', got {self.name!r}")
        if len(self.position) != 3:
            raise ValueError(f"position of {self.name!r} must have 3 coordinates, got {self.position!r}")
        for coordinate in self.position:
            if not _is_number(coordinate):
                raise ValueError(f"position of {self.name!r} must hold ints and finite floats, got {self.position!r}")
            if isinstance(coordinate, int) and not 0 <= coordinate < OBSERVATION_SIZE:
                raise ValueError(f"position of {self.name!r}: obs[{coordinate}] is outside the 39 numbers, 0 to 38")
        if len(self.offset) != 3 or not all(map(_is_number, self.offset)):
            raise ValueError(f"offset of {self.name!r} must be three numbers in metres, got {self.offset!r}")


@dataclass(frozen=True)
class Task:
    """One manipulation task in words.

    Attributes:
        name: "drawer-open", Meta-World's name without its version.
        description: one sentence that says what is to be done.
        objects: the named objects, the robot's gripper first; then the points that we named.

    Raises:
        ValueError: two objects have the same name, or the first is not the gripper.
    """

    name: str
    description: str
    objects: tuple[NamedObject, ...]

    def __post_init__(self) -> None:
        names = [named.name for named in self.objects]
        if not names or names[0] != GRIPPER:
            raise ValueError(f"objects of task {self.name!r} must begin with {GRIPPER!r}, got {names}")
        if len(set(names)) != len(names):
            raise ValueError(f"objects of task {self.name!r} must have different names, got {names}")

    @cached_property
    def object_names(self) -> tuple[str, ...]:
        """The names of the objects, in the table's order."""
        return tuple(named.name for named in self.objects)

    @cached_property
    def published(self) -> Task:
        """The task without the points that we named."""
        return Task(self.name, self.description, tuple(named for named in self.objects if not named.ours))

    def object(self, name: str) -> NamedObject:
        """The object called ``name``; :class:`ValueError` names the nearest if there is none."""
        for named in self.objects:
            if named.name == name:
                return named
        raise unknown_name(f"object of task {self.name!r}", name, self.object_names)

    def positions(self, observation: Tensor) -> dict[str, Tensor]:
        """Where each object is: (..., 39) float, metres, to name -> (..., 3) of the same dtype, metres."""
        return {
            named.name: torch.stack(
                [
                    (observation[..., c] if isinstance(c, int) else torch.full_like(observation[..., 0], c)) + shift
                    for c, shift in zip(named.position, named.offset, strict=True)
                ],
                -1,
            )
            for named in self.objects
        }


def _position(name: str, at: Any) -> tuple[Coordinate, Coordinate, Coordinate]:
    if isinstance(at, str) and (match := _SLICE.fullmatch(at)):
        start, stop = map(int, match.groups())
        if stop - start == 3:
            return (start, start + 1, start + 2)
    if isinstance(at, list) and len(at) == 3:
        found = [int(match[1]) if isinstance(c, str) and (match := _INDEX.fullmatch(c)) else c for c in at]
        if all(map(_is_number, found)):
            x, y, z = (c if isinstance(o, str) else float(c) for c, o in zip(found, at, strict=True))
            return (x, y, z)
    raise ValueError(f"position of {name!r} must be like 'obs[4:7]' or [0.1, 'obs[37]', 0.0], got {at!r}")


class TaskError(ValueError):
    """A file of tasks that cannot be read."""


_KEYS = ("description", "objects", "points", "mt10")


def _point(name: str, at: Any, objects: Mapping[str, NamedObject]) -> NamedObject:
    if not isinstance(at, Mapping):
        return NamedObject(name, _position(name, at), ours=True)
    for key in at:
        if key not in ("object", "offset"):
            raise unknown_name(f"key of point {name!r}", key, ("object", "offset"))
    if set(at) != {"object", "offset"}:
        raise ValueError(f"point {name!r} must have object and offset, got {', '.join(at) or 'neither'}")
    if at["object"] not in list(objects):
        raise unknown_name(f"object of point {name!r}", at["object"], objects)
    offset = at["offset"]
    if not isinstance(offset, list) or len(offset) != 3 or not all(map(_is_number, offset)):
        raise ValueError(f"offset of {name!r} must be three numbers in metres, got {offset!r}")
    return NamedObject(name, objects[at["object"]].position, (offset[0], offset[1], offset[2]), ours=True)


def _table(key: str, row: Mapping[str, Any]) -> Mapping[str, Any]:
    found = row.get(key, {})
    if not isinstance(found, Mapping):
        raise ValueError(f"{key} must be a table of names and positions, got {found!r}")
    return found


def _task(name: str, row: Any) -> Task:
    if not isinstance(row, Mapping):
        raise ValueError(f"must be a table, got {row!r}")
    for key in row:
        if key not in _KEYS:
            raise unknown_name("key", key, _KEYS)
    description = row.get("description")
    if not isinstance(description, str) or not description.strip():
        raise ValueError(f"description must be a sentence, got {description!r}")
    objects = {GRIPPER: NamedObject(GRIPPER, (0, 1, 2))}
    for named, at in _table("objects", row).items():
        if named in objects:
            raise ValueError(f"objects may not name {named!r}, which every task has")
        objects[named] = NamedObject(named, _position(named, at))
    points = [_point(named, at, objects) for named, at in _table("points", row).items()]
    return Task(name, description, (*objects.values(), *points))


def _load() -> tuple[Mapping[str, Task], tuple[str, ...]]:
    table = tomllib.loads((files("lw_torchrl.language") / "data" / "tasks.toml").read_text("utf-8"))
    tasks = {name: _task(name, row) for name, row in sorted(table.items())}
    return MappingProxyType(tasks), tuple(sorted(name for name, row in table.items() if row.get("mt10")))


TASKS, MT10 = _load()
"""TASKS maps the 50 names, sorted, to their :class:`Task`; MT10 names the ten of the MT10 set."""
MT50: tuple[str, ...] = tuple(TASKS)
_RANK = {name: rank for rank, name in enumerate(MT50)}


def check_task(name: object) -> str:
    """Return ``name`` if it names one of the 50 tasks, else raise :class:`ValueError` with the nearest name."""
    if not isinstance(name, str):
        raise TypeError(f"task must be a task's name, got {name!r} ({type(name).__name__})")
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return name


def task_id(name: str) -> int:
    """The integer of a task: the rank of its name among the 50 sorted names, from 0.

    Example:
        >>> task_id("assembly"), task_id("window-open")
        (0, 49)
    """
    return _RANK[check_task(name)]


def resolve_tasks(tasks: str | Iterable[str], *, known=None) -> tuple[str, ...]:
    """The names behind a set, a task, or a list of tasks, sorted by name.

    Args:
        tasks: "MT10", "MT50", one task's name, or an iterable of names.

    Returns:
        10, 50, 1 or n names.

    Raises:
        ValueError: a name is unknown (with the nearest allowed ones), repeated, or the list is empty.
        TypeError: something other than strings was given.

    Example:
        >>> resolve_tasks(["push", "door-open"])
        ('door-open', 'push')
    """
    if isinstance(tasks, str):
        if tasks in ("MT10", "MT50"):
            return MT10 if tasks == "MT10" else MT50
        if tasks not in TASKS:
            raise unknown_name("tasks", tasks, ("MT10", "MT50", *TASKS))
        return (tasks,)
    if not isinstance(tasks, Iterable):
        raise TypeError(f"tasks must be 'MT10', 'MT50', a task's name or a list of names, got {tasks!r}")
    names = [check_task(name) for name in tasks]
    if not names:
        raise ValueError("tasks must name at least one task, got an empty list")
    if len(set(names)) != len(names):
        repeated = sorted({name for name in names if names.count(name) > 1})
        raise ValueError(f"tasks must name each task once, got {', '.join(repeated)} more than once")
    return tuple(sorted(names))


def get_task(task: str | Task) -> Task:
    """The :class:`Task` of a name; a Task is returned as it is."""
    return task if isinstance(task, Task) else TASKS[check_task(task)]


def load_tasks(path: str | os.PathLike[str]) -> Mapping[str, Task]:
    """All 50 tasks, some of them as a file of one's own has them: other objects, points or words.

    Args:
        path: a file in the format of data/tasks.toml. The simulator knows 50 tasks, so the names are theirs.

    Returns:
        Task name to :class:`Task`; pass one wherever a task is asked for, or all of them to
        :func:`~lw_torchrl.load_plans`.

    Raises:
        FileNotFoundError: there is no such file.
        TaskError: (a ValueError) it is no TOML, names an unknown task, or a task in it is malformed.

    Example:
        >>> import os, tempfile
        >>> folder = tempfile.TemporaryDirectory()
        >>> path = os.path.join(folder.name, "mine.toml")
        >>> lines = ["[push]", "description = 'Push the disc.'", "objects.disc = 'obs[4:7]'"]
        >>> with open(path, "w") as file:
        ...     print(*lines, sep=os.linesep, file=file)
        >>> load_tasks(path)["push"].object_names
        ("robot's gripper", 'disc')
        >>> folder.cleanup()
    """
    file = Path(path)
    try:
        table = tomllib.loads(file.read_text("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise TaskError(f"{file}: {error}") from error
    found = dict(TASKS)
    for name, row in table.items():
        try:
            found[check_task(name)] = _task(name, row)
        except ValueError as error:
            raise TaskError(f"{file}, task {name!r}: {error}") from error
    return MappingProxyType(found)
