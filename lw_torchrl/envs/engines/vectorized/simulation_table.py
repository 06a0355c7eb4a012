"""Where each task finds its observation and its success: data/simulation.toml, read and checked."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from types import MappingProxyType
from typing import Any

Vector = tuple[float, float, float]

PLACES = ("body", "geom", "site")
RULES = (
    "point below goal",
    "object above goal",
    "joint above",
    "joint near",
    "stick inserted",
    "stick held",
)

NO_OFFSET: Vector = (-0.0, -0.0, -0.0)
"""Adding -0.0 leaves every number as it is, 0.0 and -0.0 included; adding 0.0 does not."""


@dataclass(frozen=True)
class Place:
    """A named part of the model.

    Attributes:
        kind: "body", "geom" or "site".
        name: its name in the model.
    """

    kind: str
    name: str

    @classmethod
    def parse(cls, text: str) -> Place:
        """Read "site goal"; :class:`ValueError` for anything else."""
        kind, _, name = text.partition(" ")
        if kind not in PLACES or not name:
            raise ValueError(f"a place is 'body NAME', 'geom NAME' or 'site NAME', got {text!r}")
        return cls(kind, name)


@dataclass(frozen=True)
class SuccessSources:
    """What makes a task a success; see the head of data/simulation.toml for each field."""

    within: float = float("inf")
    under: float = float("inf")
    point: str = "object"
    offset: Vector = NO_OFFSET
    axes: Vector = (1.0, 1.0, 1.0)
    goal_height: float | None = None
    rule: str | None = None
    joint: str | None = None
    angle: float = 0.0
    above: float = 0.0
    stick_end: str | None = None

    def __post_init__(self) -> None:
        if self.rule is not None and self.rule not in RULES:
            raise ValueError(f"success.rule must be one of {', '.join(RULES)}, got {self.rule!r}")
        if self.point not in ("object", "second", "gripper"):
            Place.parse(self.point)


@dataclass(frozen=True)
class TaskSources:
    """Where one task's observation comes from; see the head of data/simulation.toml for each field."""

    object: str
    quaternion: str
    offset: Vector = NO_OFFSET
    dial: str | None = None
    second: str | None = None
    second_offset: Vector = NO_OFFSET
    second_quaternion: str = "zeros"
    success: SuccessSources = field(default_factory=SuccessSources)


def _vectors(table: Mapping[str, Any]) -> dict[str, Any]:
    """TOML's lists as tuples of floats, everything else as it is."""
    return {key: tuple(map(float, value)) if isinstance(value, list) else value for key, value in table.items()}


def parse_simulation_table(text: str) -> dict[str, TaskSources]:
    """Read the table from TOML.

    Raises:
        ValueError: an entry that is not understood; the message names the task.
    """
    tasks = {}
    for name, entry in tomllib.loads(text).items():
        try:
            success = SuccessSources(**_vectors(entry.pop("success")))
            tasks[name] = TaskSources(**_vectors(entry), success=success)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"simulation table, task {name!r}: {error}") from error
    return tasks


@cache
def simulation_table() -> Mapping[str, TaskSources]:
    """The sources of all 50 tasks, by task name."""
    text = (files("lw_torchrl.envs.engines.vectorized") / "data/simulation.toml").read_text(encoding="utf-8")
    return MappingProxyType(parse_simulation_table(text))
