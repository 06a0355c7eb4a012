"""Data classes for the task tables data/simulation.toml (observations, success) and data/rewards.toml (rewards)."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from math import inf, nan
from typing import Any, Literal

from lw_torchrl._util.registry import ReadOnlyDict

Vector = tuple[float, float, float]
Pair = tuple[float, float]

NO_OFFSET: Vector = (-0.0, -0.0, -0.0)
"""An offset of -0.0, which leaves every number bit-identical; adding 0.0 would turn -0.0 into 0.0."""


@dataclass(frozen=True)
class SuccessSources:
    """A task's success condition; data/simulation.toml explains the fields."""

    within: float = inf
    under: float = inf
    point: str = "object"
    offset: Vector = NO_OFFSET
    axes: Vector = (1.0, 1.0, 1.0)
    goal_height: float | None = None
    rule: str | None = None
    joint: str | None = None
    angle: float = 0.0
    above: float = 0.0
    stick_end: str | None = None


@dataclass(frozen=True)
class TaskSources:
    """The MuJoCo bodies, geoms, sites and joints that a task's observation is read from; data/simulation.toml explains
    the fields."""

    object: str
    quaternion: str
    success: SuccessSources
    offset: Vector = NO_OFFSET
    dial: str | None = None
    second: str | None = None
    second_offset: Vector = NO_OFFSET
    second_quaternion: str = "zeros"


POINTS = (
    "hand", "object", "second", "goal", "tcp", "left pad", "grip", "place", "start", "tcp at start", "mark", "waypoint",
)  # fmt: skip
FIRST_DISTANCE = "first distance"


@dataclass(frozen=True)
class Term:
    """A reward term that measures how close two points are; data/rewards.toml explains the fields."""

    between: tuple[str, str] = ("object", "object")
    offset: Vector = NO_OFFSET
    axes: Vector = (1.0, 1.0, 1.0)
    within: float = inf
    margin: tuple[str, str] | float | str = 1.0
    margin_offset: Vector = NO_OFFSET
    less: float = 0.0
    curve: Literal["long tail", "gaussian"] = "long tail"


@dataclass(frozen=True)
class Cage:
    """A reward term that measures how well the gripper encloses the object; data/rewards.toml explains the fields."""

    radius: float
    pad: float
    across: float
    effort: float = 1.0
    density: Literal["sparse", "high", "medium"] = "sparse"
    start: str = "start"
    slide: float = 0.0
    offset: Vector = NO_OFFSET
    signed: bool = False
    pinch: float = inf


@dataclass(frozen=True)
class Funnel:
    """A reward term for keeping a point above a funnel-shaped floor; data/rewards.toml explains the fields."""

    over: str
    about: tuple[str, ...]
    rim: float
    slope: float
    height: float
    margin: float = nan
    offset: Vector = NO_OFFSET


@dataclass(frozen=True)
class Held:
    """The conditions for an object to count as held, by default always true; data/rewards.toml explains the fields."""

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
    """The dense reward of one task; data/rewards.toml explains the fields."""

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
    weights: Pair = (1.0, 1.0)
    factor: float = 1.0
    bonus: float = 5.0
    shut: bool = False
    gripper: bool = False
    lift: str | None = None

    @property
    def terms(self) -> tuple[Term, Term, Term, Term]:
        """The terms near, placed and via, and the term for the distance between tcp and object along x and z."""
        across = Term()
        if (cage := self.cage) is not None:
            margin = cage.start, "tcp at start"
            across = Term(("tcp", "grip"), axes=(1.0, 0.0, 1.0), within=cage.across, margin=margin, less=cage.across)
        return self.near, self.placed, self.via, across


def _read(file: str, task: Any, parts: Mapping[str, Any]) -> Mapping[str, Any]:
    """Read a TOML file and return a mapping from task names to ``task`` objects; ``parts`` maps the key of each nested
    table to the table's class."""

    def plain(table: Mapping[str, Any]) -> dict[str, Any]:
        return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}

    text = (files("lw_torchrl.suites.metaworld") / "data" / file).read_text(encoding="utf-8")
    tasks = {}
    for name, entry in tomllib.loads(text).items():
        own_parts = {key: parts[key](**plain(entry.pop(key))) for key in parts.keys() & entry.keys()}
        tasks[name] = task(**plain(entry), **own_parts)
    return ReadOnlyDict(tasks)


@cache
def simulation_table() -> Mapping[str, TaskSources]:
    return _read("simulation.toml", TaskSources, {"success": SuccessSources})


@cache
def reward_table() -> Mapping[str, TaskReward]:
    parts = {"near": Term, "placed": Term, "via": Term, "cage": Cage, "funnel": Funnel, "held": Held}
    return _read("rewards.toml", TaskReward, parts)
