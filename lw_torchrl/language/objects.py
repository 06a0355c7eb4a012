"""Objects and points that queries name, and the numbers of the observation that hold their positions."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from lw_torchrl._util.checks import Finite, Natural, check_choice, shown, typed_fields
from lw_torchrl._util.files import read_toml
from lw_torchrl.language.layout import METAWORLD, Layout, places

WORDS: Mapping[str, Any] = read_toml(files("lw_torchrl.language") / "data" / "words.toml", ValueError)


GRIPPER = "robot's gripper"
GOAL = "target location"
"""The goal, which every observation has, whatever a task calls it."""
Coordinate = int | Finite
"""An int is an index into the observation, a float a fixed number of metres."""
TypedPosition = tuple[tuple[bool, Coordinate], ...]

_SLICE = re.compile(r"obs\[([0-9]{1,4}):([0-9]{1,4})\]")
_INDEX = re.compile(r"obs\[([0-9]{1,4})\]")


def typed_position(position: Sequence[Coordinate]) -> TypedPosition:
    """Return a position that distinguishes the index 1 from 1.0 metres, which are equal numbers in Python."""
    return tuple((isinstance(coordinate, int), coordinate) for coordinate in position)


def coordinate_indices(position: Sequence[Coordinate], constants: list[float], size: int) -> list[int]:
    """Return the index of each coordinate in an observation (of ``size``) followed by ``constants``, which grow."""
    fixed = dict.fromkeys(c for c in position if not isinstance(c, int))
    constants += [c for c in fixed if c not in constants]
    return [c if isinstance(c, int) else size + constants.index(c) for c in position]


@typed_fields
@dataclass(frozen=True)
class NamedObject:
    """An object that queries can name, or a point on one."""

    name: str  # "drawer handle": lower-case words without an article
    position: tuple[Coordinate, Coordinate, Coordinate]  # x, y and z
    offset: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # metres, added to the position of an object: a point on it
    ours: bool = False  # whether it is a point that we named, which the published object list lacks
    opening: Natural | None = None  # index of its opening, from 0 (closed) to 1 (open); None if it cannot open

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9'-]*( [a-z0-9][a-z0-9'-]*)*", self.name):
            raise ValueError(f"name must be lower-case words like 'drawer handle', got {shown(self.name)}")
        if {"and", "is", "not", "the"} & set(self.name.split()):
            raise ValueError(f"name may not contain 'and', 'is', 'not' or 'the', got {shown(self.name)}")
        if self.opening is not None and (self.ours or self.name == GRIPPER):
            raise ValueError(f"opening of {self.name!r} must be None: the layout has the gripper's, points have none")


def _read_coordinate(value: Any) -> Coordinate:
    if isinstance(value, str) and (match := _INDEX.fullmatch(value)):
        return int(match[1])
    if isinstance(value, (int, float)) and type(value) is not bool and abs(value) < 1e9:  # larger integers overflow
        return float(value)
    raise ValueError(f"coordinate must be like 0.1 or 'obs[37]', got {shown(value)}")


def _read_position(value: Any) -> tuple[Coordinate, Coordinate, Coordinate]:
    """Return the position that "obs[4:7]" or [0.1, "obs[37]", 0.0] means in tasks.toml."""
    if isinstance(value, str) and (match := _SLICE.fullmatch(value)):
        start, stop = map(int, match.groups())
        if stop - start == 3:
            return (start, start + 1, start + 2)
    if isinstance(value, list) and len(value) == 3:
        x, y, z = map(_read_coordinate, value)
        return (x, y, z)
    raise ValueError(f"position must be like 'obs[4:7]' or [0.1, 'obs[37]', 0.0], got {shown(value)}")


def _read_object(name: str, row: Any) -> NamedObject:
    """Read an object: a position, or {position = ..., opening = "obs[92]"}."""
    if not isinstance(row, Mapping):
        return NamedObject(name, _read_position(row))
    for key in row:
        check_choice("key", key, ("position", "opening"))
    opening = row.get("opening")
    if "position" not in row or not isinstance(opening, str) or not (match := _INDEX.fullmatch(opening)):
        raise ValueError(f"a position and an opening like 'obs[92]' are needed, got {shown(row)}")
    return NamedObject(name, _read_position(row["position"]), opening=int(match[1]))


def _read_point(name: str, row: Any, objects: Mapping[str, NamedObject]) -> NamedObject:
    """Read a point: a position, or {object = ..., offset = [x, y, z]}."""
    if not isinstance(row, Mapping):
        return NamedObject(name, _read_position(row), ours=True)
    for key in row:
        check_choice("key", key, ("object", "offset"))
    if len(row) != 2 or not isinstance(row["offset"], list):
        raise ValueError(f"object and offset = [x, y, z] are needed, got {shown(row)}")
    owner = objects[check_choice("object", row["object"], [*objects])]
    return NamedObject(name, owner.position, tuple(row["offset"]), ours=True)


def read_objects(row: Mapping[str, Any], layout: Layout = METAWORLD) -> tuple[NamedObject, ...]:
    """Return the gripper, then the objects and the points of a row of tasks.toml."""
    x, y, z = places(layout.positions[0])
    objects = {GRIPPER: NamedObject(GRIPPER, (x, y, z))}
    points = []
    for key in ("objects", "points"):
        table = row.get(key, {})
        if not isinstance(table, Mapping) or not all(isinstance(name, str) for name in table):
            raise ValueError(f"{key} must be a table of names and positions, got {shown(table)}")
        for name, value in table.items():
            try:
                if key == "points":
                    points.append(_read_point(name, value, objects))
                elif name == GRIPPER:
                    raise ValueError("every task has it; leave it out")
                else:
                    objects[name] = _read_object(name, value)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key[:-1]} {name!r}: {error}") from error
    return (*objects.values(), *points)


def write_objects(objects: Sequence[NamedObject]) -> dict[str, dict[str, Any]]:
    """Return the objects and points for a row of tasks.toml; :func:`read_objects` reads them back if a row can."""
    row: dict[str, dict[str, Any]] = {"objects": {}, "points": {}}
    published = {typed_position(named.position): named.name for named in reversed(objects) if not named.ours}
    for named in objects[1:]:
        x, *_ = named.position
        value: Any = [f"obs[{c}]" if isinstance(c, int) else c for c in named.position]
        if isinstance(x, int) and named.position == (x, x + 1, x + 2):
            value = f"obs[{x}:{x + 3}]"
        if any(named.offset):
            value = {"object": published.get(typed_position(named.position), ""), "offset": list(named.offset)}
        elif named.opening is not None:
            value = {"position": value, "opening": f"obs[{named.opening}]"}
        row["points" if named.ours else "objects"][named.name] = value
    return row
