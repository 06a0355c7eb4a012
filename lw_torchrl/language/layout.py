"""Layouts: the meaning of each number in a suite's observations and actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any, Literal

from lw_torchrl._util.checks import Count, Natural, Positive, check_keys, typed_fields
from lw_torchrl._util.registry import ReadOnlyDict


@typed_fields
@dataclass(frozen=True)
class Slot:
    """The entries of an observation that describe one object."""

    position: Natural  # index of the x coordinate; y and z follow
    quaternion: Natural | None = None  # index of the first of four numbers; None without an orientation

    @property
    def xyz(self) -> slice:
        """The slice of the position (x, y, z)."""
        return slice(self.position, self.position + 3)

    @property
    def numbers(self) -> tuple[slice, ...]:
        """The slices of the position and, if the object has one, of the orientation."""
        return (self.xyz,) if self.quaternion is None else (self.xyz, slice(self.quaternion, self.quaternion + 4))


@typed_fields
@dataclass(frozen=True)
class Layout:
    """The meaning of each number in observations and actions, shared by all tasks of a suite.

    Positions are in metres (x to the right, y away from the robot, z up from the table). The index of a position is
    that of its x; y and z follow.
    Scripted skills, ``RandomYaw`` and ``TransferredActor`` need a layout with a ``displacement`` of the hand. In
    scripted skills an effort of 1 closes the gripper; in actions and data, ``closes`` is the sign of the closing
    effort.

    Example:
        >>> METAWORLD.positions
        (slice(0, 3, None), slice(4, 7, None), slice(11, 14, None), slice(36, 39, None))

    Source: ours; Meta-World's layout follows ``SawyerXYZEnv._get_obs``.
    """

    name: str
    size: Count  # the length D of an observation
    hand: Natural  # index of the gripper's x
    opening: Natural  # index of the gripper's opening, from 0 (closed) to 1 (open)
    things: tuple[Slot, ...]  # a task's objects in order; the numbers of an object that the task lacks are zero
    goal: Natural  # index of the target's x; observations have no previous position of the target
    past: Natural | None = None  # offset from a number's index to its value in the previous time step
    action_size: Count = 4  # the length A of an action; each number is in [-1, 1]
    displacement: Natural | None = 0  # index of the hand's displacement along x; None if actions have no displacement
    reach: Positive = 0.01  # metres that the moving hand travels per time step at a displacement of 1
    gripper: Natural | None = 3  # index of the gripper's effort; None without a gripper
    closes: Literal[1, -1] = 1  # sign of the effort that closes the gripper
    binary_gripper: bool = False  # whether the gripper only opens or closes fully, within a few time steps
    closes_above: float = 0.3  # effort above which a binary gripper closes
    thresholds: Mapping[str, float] = field(default_factory=dict, hash=False)  # the suite's threshold (m) by relation

    def __post_init__(self) -> None:
        layout = f"layout {self.name!r}"
        if not self.things:
            raise ValueError(f"things of {layout} must hold at least one Slot")
        present = (*self.present, *self._past(self.present))
        if max(part.stop for part in (*present, *self.positions)) > self.size:
            raise ValueError(f"{layout} has an index outside the {self.size} numbers of an observation")
        used = [number for part in present for number in places(part)]
        if twice := sorted(number for number in used if used.count(number) > 1):
            raise ValueError(f"{layout} uses index {twice[0]} of the observation more than once")
        moved = () if self.displacement is None else places(self.displaced(layout))
        acting = (*moved, *places(self.effort))
        if len({*acting}) < len(acting) or max(acting, default=0) >= self.action_size:
            parts = f"displacement {self.displacement} and gripper {self.gripper} of {layout}"
            raise ValueError(f"{parts} must be distinct indices from 0 to {self.action_size - 1}")
        object.__setattr__(self, "thresholds", ReadOnlyDict(dict(self.thresholds)))
        for name in ("present", "positions", "all_positions", "parts"):
            getattr(self, name)  # computed eagerly, since torch.compile cannot trace the lock of a cached_property

    @cached_property
    def present(self) -> tuple[slice, ...]:
        """The slices of the hand, the opening and the objects in the current time step, without the goal."""
        opening = slice(self.opening, self.opening + 1)
        return (slice(self.hand, self.hand + 3), opening, *(part for thing in self.things for part in thing.numbers))

    @cached_property
    def positions(self) -> tuple[slice, ...]:
        """The slices of the current positions: hand, objects, goal."""
        starts = (self.hand, *(thing.position for thing in self.things), self.goal)
        return tuple(slice(start, start + 3) for start in starts)

    @cached_property
    def all_positions(self) -> tuple[slice, ...]:
        """The slices of all positions in the current and the previous time step."""
        return (*self.positions, *self._past(self.positions[:-1]))

    @cached_property
    def parts(self) -> tuple[tuple[slice, ...], ...]:
        """The slices of each object in the current and the previous time step, then the slice of the goal."""
        things = [(*thing.numbers, *self._past(thing.numbers)) for thing in self.things]
        return (*things, (self.positions[-1],))

    @property
    def effort(self) -> slice:
        """The slice of the gripper's effort in an action; empty without a gripper."""
        return slice(0, 0) if self.gripper is None else slice(self.gripper, self.gripper + 1)

    def displaced(self, user: str) -> slice:
        """Return the slice of the hand's displacement in actions; raise a ValueError for ``user`` if there is none."""
        if self.displacement is None:
            raise ValueError(f"{user}: actions must have a displacement of the hand, got layout {self.name!r}")
        return slice(self.displacement, self.displacement + 3)

    def a_step_before(self, part: slice) -> slice:
        """Return the slice of the same numbers in the previous time step."""
        if self.past is None:
            raise ValueError(f"layout {self.name!r} has no values of the previous time step")
        return slice(part.start + self.past, part.stop + self.past)

    def _past(self, parts: tuple[slice, ...]) -> tuple[slice, ...]:
        """Return the slices of the same numbers in the previous time step; empty if ``past`` is None."""
        return () if self.past is None else tuple(map(self.a_step_before, parts))

    def to_json(self) -> dict[str, Any]:
        """Convert the layout to JSON."""
        things = [[thing.position, thing.quaternion] for thing in self.things]
        values = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**values, "things": things, "thresholds": dict(self.thresholds)}

    @classmethod
    def from_json(cls, row: Any) -> Layout:
        """Rebuild the layout from :meth:`to_json`; raise a ValueError if ``row`` is not such JSON."""
        names = [each.name for each in fields(cls)]
        check_keys("layout", row, names, names)
        try:
            return cls(**{**row, "things": tuple(Slot(*pair) for pair in row["things"])})
        except TypeError as error:
            raise ValueError(f"layout: {error}") from error


def places(part: slice) -> tuple[int, ...]:
    """Convert a slice to indices, such as (36, 37, 38) for Meta-World's goal."""
    return tuple(range(part.start, part.stop))


METAWORLD = Layout("metaworld", 39, hand=0, opening=3, things=(Slot(4, 7), Slot(11, 14)), goal=36, past=18, reach=0.01)
"""Meta-World's layout with 39-dimensional observations. In one-object tasks, the second object's entries are 0."""
