"""Layout: what the numbers of a suite's observations and actions mean."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from lw_torchrl._util.checks import shown, typed_fields
from lw_torchrl._util.registry import ReadOnlyDict


@typed_fields
@dataclass(frozen=True)
class Slot:
    """The numbers of an observation that describe one object."""

    position: int  # index of its x; y and z follow
    quaternion: int | None = None  # index of the first of its four numbers; None without an orientation

    @property
    def xyz(self) -> slice:
        """The numbers of the position."""
        return slice(self.position, self.position + 3)

    @property
    def numbers(self) -> tuple[slice, ...]:
        """The numbers of the position and, where it is told, of the orientation."""
        return (self.xyz,) if self.quaternion is None else (self.xyz, slice(self.quaternion, self.quaternion + 4))


@typed_fields
@dataclass(frozen=True)
class Layout:
    """The meaning of the numbers of observations and actions, for all tasks of a suite.

    Positions are in metres: x to the right, y away from the robot, z above the table. Where an index is of an x, y and
    z follow. Without a ``displacement`` of the hand, scripted skills, ``RandomYaw`` and ``TransferredActor`` refuse an
    action. Scripted skills say 1 to close everywhere; actions and data have the sign of ``closes``.

    Example:
        >>> METAWORLD.positions
        (slice(0, 3, None), slice(4, 7, None), slice(11, 14, None), slice(36, 39, None))

    Source: ours; Meta-World's numbers are those of ``SawyerXYZEnv._get_obs``.
    """

    name: str
    size: int  # D, how many numbers an observation has
    hand: int  # index of the gripper's x
    opening: int  # index of the gripper's opening, from 0, closed, to 1, open
    things: tuple[Slot, ...]  # in the order in which tasks have them; all but the first may be absent: zeros
    goal: int  # index of the x of the task's target, which has no past
    past: int | None = None  # the previous step's numbers are at their index + past; after a reset, the current ones
    action_size: int = 4  # A, how many numbers an action has, each in [-1, 1]
    displacement: int | None = 0  # index of the x of the hand's displacement; None if actions are something else
    reach: float = 0.01  # metres that the hand moves in a step at a displacement of 1, once it moves
    gripper: int | None = 3  # index of the gripper's effort
    closes: int = 1  # the effort's sign that closes, 1 or -1
    binary_gripper: bool = False  # it opens or closes fully in a few steps, so an effort is mapped to open or closed
    closes_above: float = 0.3  # the effort above which such a gripper closes
    thresholds: Mapping[str, float] = field(default_factory=dict, hash=False)  # metres, by relation, of this suite

    def __post_init__(self) -> None:
        layout = f"layout {self.name!r}"
        if not self.things or not all(isinstance(thing, Slot) for thing in self.things):
            raise ValueError(f"things of {layout} must be at least one Slot, got {self.things!r}")
        used = [*self.present, *self.positions]
        if min(part.start for part in used) < 0 or max(part.stop for part in used) > self.size:
            raise ValueError(f"{layout} has an index outside the {self.size} numbers of an observation")
        told = [number for part in (*self.present, *self._past(self.present)) for number in places(part)]
        if twice := sorted({number for number in told if told.count(number) > 1}):
            raise ValueError(f"{layout} uses number {twice[0]} of an observation for two purposes")
        for name, index, width in (("displacement", self.displacement, 3), ("gripper", self.gripper, 1)):
            if index is not None and not 0 <= index <= self.action_size - width:
                raise ValueError(f"{name} of {layout} must be within {self.action_size} numbers, got {index}")
        if self.displacement is not None and self.gripper in range(self.displacement, self.displacement + 3):
            raise ValueError(f"gripper of {layout} must not be an index of the displacement, got {self.gripper}")
        if self.closes not in (1, -1):
            raise ValueError(f"closes of {layout} must be 1 or -1, got {shown(self.closes)}")
        if self.reach <= 0:
            raise ValueError(f"reach of {layout} must be above 0 metres, got {shown(self.reach)}")
        for relation, threshold in self.thresholds.items():
            if not isinstance(relation, str) or type(threshold) is not float or abs(threshold) > 1e3:
                raise ValueError(f"thresholds of {layout} must map relations to metres, got {relation!r}")
        object.__setattr__(self, "thresholds", ReadOnlyDict(dict(self.thresholds)))
        for name in ("present", "positions", "all_positions", "parts"):
            getattr(self, name)  # computed here: torch.compile cannot trace the lock of a cached_property

    @cached_property
    def present(self) -> tuple[slice, ...]:
        """The numbers of this step that may have a past: the hand, its opening, those of each thing."""
        opening = slice(self.opening, self.opening + 1)
        return (slice(self.hand, self.hand + 3), opening, *(part for thing in self.things for part in thing.numbers))

    @cached_property
    def positions(self) -> tuple[slice, ...]:
        """The positions of this step: of the hand, of each thing, of the goal."""
        starts = (self.hand, *(thing.position for thing in self.things), self.goal)
        return tuple(slice(start, start + 3) for start in starts)

    @cached_property
    def all_positions(self) -> tuple[slice, ...]:
        """All positions, also those of the step before."""
        return (*self.positions, *self._past(self.positions[:-1]))

    @cached_property
    def parts(self) -> tuple[tuple[slice, ...], ...]:
        """The numbers of each thing, now and a step before, then those of the goal."""
        things = [(*thing.numbers, *self._past(thing.numbers)) for thing in self.things]
        return (*things, (self.positions[-1],))

    @property
    def effort(self) -> slice:
        """The gripper's effort among the numbers of an action; none of them where there is none."""
        return slice(0, 0) if self.gripper is None else slice(self.gripper, self.gripper + 1)

    def displaced(self, what: str) -> slice:
        """The hand's displacement among the numbers of an action; :class:`ValueError` names ``what`` needs one."""
        if self.displacement is None:
            lacks = f"an action of layout {self.name!r} has no displacement of the hand, which it needs"
            raise ValueError(f"{what}: {lacks}")
        return slice(self.displacement, self.displacement + 3)

    def a_step_before(self, part: slice) -> slice:
        """Where the same numbers stand of the step before."""
        if self.past is None:
            raise ValueError(f"layout {self.name!r} has no numbers of the step before")
        return slice(part.start + self.past, part.stop + self.past)

    def _past(self, parts: tuple[slice, ...]) -> tuple[slice, ...]:
        """Return the same parts of the previous step; empty in a layout without a past."""
        return () if self.past is None else tuple(map(self.a_step_before, parts))

    def to_json(self) -> dict[str, Any]:
        """What :meth:`from_json` reads back."""
        things = [[thing.position, thing.quaternion] for thing in self.things]
        own = {each.name: getattr(self, each.name) for each in fields(self)}
        return {**own, "things": things, "thresholds": dict(self.thresholds)}

    @classmethod
    def from_json(cls, found: Any) -> Layout:
        """The layout of :meth:`to_json`; any other value is a ValueError."""
        names = [each.name for each in fields(cls)]
        if not isinstance(found, Mapping) or set(found) != set(names):
            raise ValueError(f"layout must be a table of {', '.join(names)}, got {shown(found)}")
        things = found["things"]
        if not isinstance(things, list) or not all(isinstance(one, list) and len(one) == 2 for one in things):
            raise ValueError(f"things of a layout must be pairs of indices, got {shown(things)}")
        try:
            return cls(**{**found, "things": tuple(Slot(*one) for one in things)})
        except TypeError as error:
            raise ValueError(f"layout: {error}") from error


def places(part: slice) -> tuple[int, ...]:
    """The numbers' indices: (36, 37, 38) for Meta-World's goal."""
    return tuple(range(part.start, part.stop))


METAWORLD = Layout("metaworld", 39, hand=0, opening=3, things=(Slot(4, 7), Slot(11, 14)), goal=36, past=18, reach=0.01)
"""Meta-World's 39 numbers; the second thing is zeros in a task with one."""
