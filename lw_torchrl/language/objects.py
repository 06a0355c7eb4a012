"""What queries can name: objects and points, and where the observation tells their positions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from lw_torchrl._util.checks import check_choice, shown
from lw_torchrl._util.files import read_toml
from lw_torchrl.language.layout import METAWORLD, Layout, places

WORDS: Mapping[str, Any] = read_toml(files("lw_torchrl.language") / "data" / "words.toml", ValueError)


GRIPPER = "robot's gripper"
GOAL = "target location"
"""The goal, which every observation has, whatever a task calls it."""
Coordinate = int | float
"""An int is an index into the observation, a float a fixed number of metres."""
TypedPosition = tuple[tuple[bool, Coordinate], ...]

_SLICE = re.compile(r"obs\[([0-9]{1,4}):([0-9]{1,4})\]")
_INDEX = re.compile(r"obs\[([0-9]{1,4})\]")


def is_number(value: object) -> bool:
    """Whether ``value`` is a plausible number of metres, gain or effort: neither bool nor NaN, and below 1e9."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e9


def is_triple(value: object) -> bool:
    return isinstance(value, (list, tuple)) and len(value) == 3 and all(map(is_number, value))


def typed_position(position: Sequence[Coordinate]) -> TypedPosition:
    """A position that tells index 1 from metre 1.0, which are equal numbers."""
    return tuple((isinstance(coordinate, int), coordinate) for coordinate in position)


def coordinate_indices(position: Sequence[Coordinate], constants: list[float], size: int) -> list[int]:
    """Where coordinates stand in the ``size`` numbers of an observation followed by ``constants``, which may grow."""
    fixed = dict.fromkeys(c for c in position if not isinstance(c, int))
    constants += [c for c in fixed if c not in constants]
    return [c if isinstance(c, int) else size + constants.index(c) for c in position]


@dataclass(frozen=True)
class NamedObject:
    """An object that queries can name.

    ``opening`` is the index of a number of the observation, from 0, closed, to 1, open; None for what does not open,
    turn or slide. The gripper's is the layout's.
    """

    name: str  # "drawer handle", in lower case and without an article
    position: tuple[Coordinate, Coordinate, Coordinate]  # x, y and z
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # metres, added to the position; for a point on an object
    ours: bool = False  # a point that we named, which the published object list lacks
    opening: int | None = None

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9'-]*( [a-z0-9][a-z0-9'-]*)*", self.name):
            raise ValueError(f"name must be lower-case words like 'drawer handle', got {shown(self.name)}")
        if {"and", "is", "not", "the"} & set(self.name.split()):
            raise ValueError(f"name may not contain 'and', 'is', 'not' or 'the', got {shown(self.name)}")
        if not is_triple(self.position):
            raise ValueError(f"position of {self.name!r} must hold 3 ints or finite floats, got {shown(self.position)}")
        if not is_triple(self.offset):
            raise ValueError(f"offset of {self.name!r} must be three numbers in metres, got {shown(self.offset)}")
        if self.opening is not None and (type(self.opening) is not int or self.ours or self.name == GRIPPER):
            wanted = f"an index, of an object alone, got {shown(self.opening)}"
            raise ValueError(f"opening of {self.name!r} must be {wanted}")


def read_position(name: str, at: Any) -> tuple[Coordinate, Coordinate, Coordinate]:
    """The position that "obs[4:7]" or [0.1, "obs[37]", 0.0] means in tasks.toml."""
    if isinstance(at, str) and (match := _SLICE.fullmatch(at)):
        start, stop = map(int, match.groups())
        if stop - start == 3:
            return (start, start + 1, start + 2)
    if isinstance(at, list) and len(at) == 3:
        found = [int(match[1]) if isinstance(c, str) and (match := _INDEX.fullmatch(c)) else c for c in at]
        if all(map(is_number, found)):
            x, y, z = (c if isinstance(o, str) else float(c) for c, o in zip(found, at, strict=True))
            return (x, y, z)
    raise ValueError(f"position of {name!r} must be like 'obs[4:7]' or [0.1, 'obs[37]', 0.0], got {shown(at)}")


def read_object(name: str, at: Any) -> NamedObject:
    """An object of tasks.toml: a position, or {position = ..., opening = "obs[92]"}."""
    if not isinstance(at, Mapping):
        return NamedObject(name, read_position(name, at))
    for key in at:
        check_choice(f"key of object {name!r}", key, ("position", "opening"))
    stated = at.get("opening")
    if "position" not in at or not isinstance(stated, str) or not (match := _INDEX.fullmatch(stated)):
        raise ValueError(f"object {name!r} must have a position and an opening like 'obs[92]', got {shown(at)}")
    return NamedObject(name, read_position(name, at["position"]), opening=int(match[1]))


def read_point(name: str, at: Any, objects: Mapping[str, NamedObject]) -> NamedObject:
    """A point of tasks.toml: a position, or {object = ..., offset = [x, y, z]}."""
    if not isinstance(at, Mapping):
        return NamedObject(name, read_position(name, at), ours=True)
    for key in at:
        check_choice(f"key of point {name!r}", key, ("object", "offset"))
    if len(at) != 2:
        raise ValueError(f"point {name!r} must have object and offset, got {', '.join(at) or 'neither'}")
    check_choice(f"object of point {name!r}", at["object"], objects)
    if not is_triple(at["offset"]):
        raise ValueError(f"offset of {name!r} must be three numbers in metres, got {shown(at['offset'])}")
    return NamedObject(name, objects[at["object"]].position, tuple(at["offset"]), ours=True)


def check_inside(named: NamedObject, size: int) -> None:
    """Raise :class:`ValueError` if a position's index is outside the ``size`` numbers of an observation."""
    for coordinate in (*named.position, 0 if named.opening is None else named.opening):
        if isinstance(coordinate, int) and not 0 <= coordinate < size:
            numbers = f"the {size} numbers, 0 to {size - 1}"
            raise ValueError(f"position of {named.name!r}: obs[{coordinate}] is outside {numbers}")


def read_objects(row: Mapping[str, Any], layout: Layout = METAWORLD) -> tuple[NamedObject, ...]:
    """The gripper, then the objects and the points of a row of tasks.toml."""

    def table(key: str) -> Mapping[str, Any]:
        found = row.get(key, {})
        if not isinstance(found, Mapping) or not all(isinstance(name, str) for name in found):
            raise ValueError(f"{key} must be a table of names and positions, got {shown(found)}")
        return found

    x, y, z = places(layout.positions[0])
    objects = {GRIPPER: NamedObject(GRIPPER, (x, y, z))}
    for named, at in table("objects").items():
        if named in objects:
            raise ValueError(f"objects may not name {named!r}, which every task has")
        objects[named] = read_object(named, at)
    points = [read_point(named, at, objects) for named, at in table("points").items()]
    return (*objects.values(), *points)


def write_objects(objects: Sequence[NamedObject]) -> dict[str, dict[str, Any]]:
    """What :func:`read_objects` reads back, if a row can hold it."""
    row: dict[str, dict[str, Any]] = {"objects": {}, "points": {}}
    published = {typed_position(named.position): named.name for named in reversed(objects) if not named.ours}
    for named in objects[1:]:
        x, *_ = named.position
        at: Any = [f"obs[{c}]" if isinstance(c, int) else c for c in named.position]
        if isinstance(x, int) and named.position == (x, x + 1, x + 2):
            at = f"obs[{x}:{x + 3}]"
        if any(named.offset):
            at = {"object": published.get(typed_position(named.position), ""), "offset": list(named.offset)}
        elif named.opening is not None:
            at = {"position": at, "opening": f"obs[{named.opening}]"}
        row["points" if named.ours else "objects"][named.name] = at
    return row
