"""Objects and points that queries name, and where their positions are in the observation."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

from lw_torchrl._util.checks import Finite, Natural, check_choice, check_keys, shown, typed_fields
from lw_torchrl._util.files import read_toml
from lw_torchrl.language.connectives import CONNECTIVES
from lw_torchrl.language.layout import METAWORLD, Layout, places

WORDS: Mapping[str, Any] = read_toml(files("lw_torchrl.language") / "data" / "words.toml", ValueError)


GRIPPER = "robot's gripper"
GOAL = "target location"
"""The name of the goal in step roles. Every observation has a goal, but a task's own name for the goal may differ."""
Coordinate = int | Finite
"""A coordinate: an int is an index into the observation, a float a fixed value in metres."""
TypedPosition = tuple[tuple[bool, Coordinate], ...]

_SLICE = re.compile(r"obs\[([0-9]{1,4}):([0-9]{1,4})\]")
_INDEX = re.compile(r"obs\[([0-9]{1,4})\]")


def typed_position(position: Sequence[Coordinate]) -> TypedPosition:
    """Tag each coordinate with its kind, so that index 1 and 1.0 m differ (1 == 1.0 in Python)."""
    return tuple((isinstance(coordinate, int), coordinate) for coordinate in position)


def coordinate_indices(position: Sequence[Coordinate], constants: list[float], size: int) -> list[int]:
    """Return indices into ``size`` observation entries followed by ``constants``; append any missing constants."""
    fixed = dict.fromkeys(c for c in position if not isinstance(c, int))
    constants += [c for c in fixed if c not in constants]
    return [c if isinstance(c, int) else size + constants.index(c) for c in position]


@typed_fields
@dataclass(frozen=True)
class NamedObject:
    """An object that queries can name, or a point on an object."""

    name: str  # "drawer handle": lower-case words without an article
    position: tuple[Coordinate, Coordinate, Coordinate]  # x, y and z
    offset: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)  # metres from the object's position to this point
    ours: bool = False  # whether this package adds the point to the paper's object list
    opening: Natural | None = None  # index of the opening, from 0 (closed) to 1 (open); None if the object cannot open

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[a-z][a-z0-9'-]*( [a-z0-9][a-z0-9'-]*)*", self.name):
            raise ValueError(f"name must be lower-case words like 'drawer handle', got {shown(self.name)}")
        if reserved := [word for word in self.name.split() if word in (*CONNECTIVES, "is", "not", "the")]:
            raise ValueError(f"name must not contain {reserved[0]!r}, which is reserved in queries, got {self.name!r}")
        if self.opening is not None and (self.ours or self.name == GRIPPER):
            raise ValueError(f"opening of {self.name!r} must be None: points have none, the layout has the gripper's")


def _read_coordinate(value: Any) -> Coordinate:
    if isinstance(value, str) and (match := _INDEX.fullmatch(value)):
        return int(match[1])
    if isinstance(value, (int, float)) and type(value) is not bool and abs(value) < 1e9:  # larger integers overflow
        return float(value)
    raise ValueError(f"coordinate must have a form like 0.1 or 'obs[37]', got {shown(value)}")


def _read_position(value: Any) -> tuple[Coordinate, Coordinate, Coordinate]:
    """Parse a position from tasks.toml, such as "obs[4:7]" or [0.1, "obs[37]", 0.0]."""
    match = _SLICE.fullmatch(value) if isinstance(value, str) else None
    position = [*range(int(match[1]), int(match[2]))] if match else value
    if not isinstance(position, list) or len(position) != 3:
        raise ValueError(f"position must have a form like 'obs[4:7]' or [0.1, 'obs[37]', 0.0], got {shown(value)}")
    x, y, z = position if match else map(_read_coordinate, position)
    return (x, y, z)


def _read_object(name: str, row: Any) -> NamedObject:
    """Parse an object from tasks.toml: a position, or {position = ..., opening = "obs[92]"}."""
    if not isinstance(row, Mapping):
        return NamedObject(name, _read_position(row))
    check_keys("the object", row, ("position", "opening"), ("position", "opening"))
    if (match := _INDEX.fullmatch(str(row["opening"]))) is None:
        raise ValueError(f"opening must have a form like 'obs[92]', got {shown(row['opening'])}")
    return NamedObject(name, _read_position(row["position"]), opening=int(match[1]))


def _read_point(name: str, row: Any, objects: Mapping[str, NamedObject]) -> NamedObject:
    """Parse a point of tasks.toml: a position, or {object = ..., offset = [x, y, z]}."""
    if not isinstance(row, Mapping):
        return NamedObject(name, _read_position(row), ours=True)
    check_keys("the point", row, ("object", "offset"), ("object", "offset"))
    owner, offset = objects[check_choice("object", row["object"], [*objects])], row["offset"]
    return NamedObject(name, owner.position, tuple(offset) if isinstance(offset, list) else offset, ours=True)


def read_objects(row: Mapping[str, Any], layout: Layout = METAWORLD) -> tuple[NamedObject, ...]:
    """Parse the objects and points of a row of tasks.toml; return the gripper, the objects, then the points."""
    x, y, z = places(layout.positions[0])
    objects = {GRIPPER: NamedObject(GRIPPER, (x, y, z))}
    points = []
    for key in ("objects", "points"):
        table = row.get(key, {})
        if not isinstance(table, Mapping) or not all(isinstance(name, str) for name in table):
            raise ValueError(f"{key} must be a table that maps names to positions, got {shown(table)}")
        for name, value in table.items():
            try:
                if key == "points":
                    points.append(_read_point(name, value, objects))
                elif name == GRIPPER:
                    raise ValueError("every task has the gripper; leave out this row")
                else:
                    objects[name] = _read_object(name, value)
            except (TypeError, ValueError) as error:
                raise ValueError(f"{key[:-1]} {name!r}: {error}") from error
    return (*objects.values(), *points)


def write_objects(objects: Sequence[NamedObject]) -> dict[str, dict[str, Any]]:
    """Convert objects and points to a row of tasks.toml; information that such a row cannot express is lost."""
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
