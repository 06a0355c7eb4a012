"""The numbers of each task's dense reward: data/rewards.toml, read and checked."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from math import inf
from types import MappingProxyType
from typing import Any

from lw_torchrl._checks import check_choice
from lw_torchrl.envs.engines.vectorized.simulation_table import NO_OFFSET, Vector

POINTS = (
    "hand", "object", "second", "goal", "tcp", "left pad", "grip", "place", "start", "tcp at start", "mark", "waypoint",
)  # fmt: skip
CURVES = ("long tail", "gaussian")
DENSITIES = ("sparse", "high", "medium")
FIRST_DISTANCE = "first distance"


def _check_points(points: tuple[str, ...]) -> None:
    if len(points) != 2:
        raise ValueError(f"two points are needed, got {', '.join(points)}")
    for point in points:
        check_choice("a point", point, POINTS)


@dataclass(frozen=True)
class Term:
    """How close two points are; see the head of data/rewards.toml for each field."""

    between: tuple[str, str] = ("object", "object")
    offset: Vector = NO_OFFSET
    axes: Vector = (1.0, 1.0, 1.0)
    within: float = inf
    margin: tuple[str, str] | float | str = 1.0
    margin_offset: Vector = NO_OFFSET
    less: float = 0.0
    curve: str = "long tail"

    def __post_init__(self) -> None:
        _check_points(self.between)
        if isinstance(self.margin, tuple):
            _check_points(self.margin)
        check_choice("curve", self.curve, CURVES)


@dataclass(frozen=True)
class Cage:
    """How the gripper is to enclose the object."""

    radius: float
    pad: float
    across: float
    effort: float = 1.0
    density: str = "sparse"
    start: str = "start"
    slide: float = 0.0
    offset: Vector = NO_OFFSET
    signed: bool = False
    pinch: float | None = None

    def __post_init__(self) -> None:
        check_choice("cage.density", self.density, DENSITIES)
        check_choice("cage.start", self.start, POINTS)


@dataclass(frozen=True)
class Funnel:
    """Above what a point is to stay on its way."""

    over: str
    about: tuple[str, ...]
    rim: float
    slope: float
    height: float
    margin: float | None = None
    offset: Vector = NO_OFFSET

    def __post_init__(self) -> None:
        if not 1 <= len(self.about) <= 2:
            raise ValueError(f"funnel.about must be one or two points, got {', '.join(self.about)}")
        for point in (self.over, *self.about):
            check_choice("a point", point, POINTS)


@dataclass(frozen=True)
class Held:
    """When the object counts as held; without limits, always."""

    near: float = inf
    within: float = inf
    opened: float = -inf
    opened_from: float = -inf
    opened_under: float = inf
    lifted: float = -inf
    lifted_axis: int = 2
    moved: float = -inf
    grasps: bool = False


@dataclass(frozen=True)
class TaskReward:
    """One task's dense reward."""

    formula: str
    near: Term = field(default_factory=Term)
    placed: Term = field(default_factory=Term)
    via: Term = field(default_factory=Term)
    cage: Cage | None = None
    funnel: Funnel | None = None
    held: Held = field(default_factory=Held)
    done_under: float = -inf
    done_within: float = -inf
    start: str = "obj_init_pos"
    mark: str | None = None
    place: str | None = None
    waypoint: tuple[float | str, float | str, float | str] = (0.0, 0.0, 0.0)
    corners: tuple[str, ...] = ()
    joint: str | None = None
    weights: tuple[float, float] = (1.0, 1.0)
    factor: float = 1.0
    bonus: float = 5.0
    shut: bool = False
    gripper: bool = False
    lift: str | None = None

    @property
    def terms(self) -> tuple[Term, Term, Term, Term]:
        """near, placed and via, and how close the gripper is across the object."""
        across = Term()
        if self.cage is not None:
            across = Term(
                between=("tcp", "grip"),
                axes=(1.0, 0.0, 1.0),
                within=self.cage.across,
                margin=(self.cage.start, "tcp at start"),
                less=self.cage.across,
            )
        return self.near, self.placed, self.via, across


def _plain(table: Mapping[str, Any]) -> dict[str, Any]:
    """TOML's lists as tuples and its whole numbers as floats, everything else as it is."""

    def number(value: Any) -> Any:
        return float(value) if type(value) is int else value

    return {
        key: tuple(map(number, value)) if isinstance(value, list) else value if key == "lifted_axis" else number(value)
        for key, value in table.items()
    }


def parse_reward_table(text: str) -> dict[str, TaskReward]:
    """Read the table from TOML.

    Raises:
        ValueError: an entry that is not understood; the message names the task.
    """
    kinds: dict[str, Any] = {"near": Term, "placed": Term, "via": Term, "cage": Cage, "funnel": Funnel, "held": Held}
    rewards = {}
    for name, entry in tomllib.loads(text).items():
        try:
            parts = {key: kinds[key](**_plain(entry.pop(key))) for key in kinds.keys() & entry.keys()}
            rewards[name] = TaskReward(**_plain(entry), **parts)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"reward table, task {name!r}: {error}") from error
    return rewards


@cache
def reward_table() -> Mapping[str, TaskReward]:
    """The rewards of all 50 tasks, by task name."""
    text = (files("lw_torchrl.envs.engines.vectorized") / "data/rewards.toml").read_text(encoding="utf-8")
    return MappingProxyType(parse_reward_table(text))
