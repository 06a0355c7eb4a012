"""The parts of dense rewards: the numbers of data/rewards.toml as arrays, features, and terms, for all rows at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from math import nan
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld import tables
from lw_torchrl.suites.metaworld.observation import Array, Mask, row_norm
from lw_torchrl.suites.metaworld.tables import FIRST_DISTANCE, POINTS, Cage, Funnel, Held, TaskReward, Term

# Columns of the features: the sensors, then these, of which the first four are constant in an episode.
START, TCP_START, MARK, CONSTANT, GOAL, TCP, GRIP = (
    slice(at.REWARD_WIDTH + 3 * number, at.REWARD_WIDTH + 3 * number + 3) for number in range(7)
)
EPISODE = slice(START.start, CONSTANT.stop)
FEATURES = GRIP.stop

# The columns of each of POINTS but the last, the waypoint.
_COLUMNS = at.HAND, at.OBJECT, at.SECOND, GOAL, TCP, at.LEFT_PAD, GRIP, at.PLACE, START, TCP_START, MARK
COLUMNS = {point: list(range(FEATURES)[columns]) for point, columns in zip(POINTS[:-1], _COLUMNS, strict=True)}

NEAR, PLACED, VIA, ACROSS = range(4)

_DTYPES = {bool: np.bool_, int: np.intp, float: np.float64, tables.Vector: np.float64, tables.Pair: np.float64}
_NO_CAGE = Cage(radius=0.0, pad=0.0, across=0.0)
_NO_FUNNEL = Funnel(over="hand", about=("object",), rim=0.0, slope=0.0, height=0.0)


class Parameters(SimpleNamespace):
    """Arrays over the rows with the numbers of :class:`TaskReward` and of its parts ``cage``, ``funnel`` and ``held``.
    After the row, ``points`` and ``offset`` have the axes [distance or margin][first or second point][term][x, y, z];
    the other arrays of terms have [term]."""

    def of(self, rows: Any) -> Parameters:
        own = vars(self).items()
        return Parameters(**{key: v.of(rows) if isinstance(v, Parameters) else v[rows] for key, v in own})


def make_parameters(rewards: Sequence[TaskReward]) -> Parameters:
    terms = [reward.terms for reward in rewards]

    def of_terms(name: str) -> Array:
        return np.array([[getattr(term, name) for term in four] for four in terms], float)

    cages = [reward.cage or _NO_CAGE for reward in rewards]
    funnels = [reward.funnel or _NO_FUNNEL for reward in rewards]
    return Parameters(
        **_numbers(TaskReward, rewards),
        formula=np.array([reward.formula for reward in rewards]),
        lift=np.array([reward.lift or "" for reward in rewards]),
        points=np.array([_points(reward) for reward in rewards], dtype=np.intp),
        offset=np.stack([of_terms("offset"), of_terms("margin_offset")], axis=1),
        axes=of_terms("axes"),
        within=of_terms("within"),
        less=np.array([[_less(term) for term in four] for four in terms], float),
        gaussian=np.array([[term.curve == "gaussian" for term in four] for four in terms]),
        cage=Parameters(
            **_numbers(Cage, cages),
            used=np.array([reward.cage is not None for reward in rewards]),
            start=np.array([COLUMNS["grip" if cage.signed else cage.start][1] for cage in cages]),
            high=np.array([cage.density == "high" for cage in cages]),
            medium=np.array([cage.density == "medium" for cage in cages]),
        ),
        funnel=Parameters(
            **_numbers(Funnel, funnels),
            used=np.array([reward.funnel is not None for reward in rewards]),
            over=np.array([COLUMNS[funnel.over][2] for funnel in funnels]),
            about=np.array([[COLUMNS[point][:2] for point in (one.about[0], one.about[-1])] for one in funnels]),
        ),
        held=Parameters(**_numbers(Held, [reward.held for reward in rewards])),
    )


def _numbers(kind: Any, parts: Sequence[Any]) -> dict[str, Any]:
    numeric: list[Any] = [one for one in fields(kind) if one.type in _DTYPES]
    return {one.name: np.array([getattr(part, one.name) for part in parts], _DTYPES[one.type]) for one in numeric}


def _points(reward: TaskReward) -> list[list[list[list[int]]]]:
    margins = [term.margin if isinstance(term.margin, tuple) else term.between[:1] * 2 for term in reward.terms]
    pairs = [[term.between for term in reward.terms], margins]
    constant = range(FEATURES)[CONSTANT]
    waypoint = [(COLUMNS[v] if isinstance(v, str) else constant)[axis] for axis, v in enumerate(reward.waypoint)]
    columns = COLUMNS | {"waypoint": waypoint}
    return [[[columns[pair[end]] for pair in kind] for end in (0, 1)] for kind in pairs]


def _less(term: Term) -> float:
    """Return the number subtracted from the distance of the margin's points. A margin that is a number has the same
    point twice, so that this number is the margin."""
    if isinstance(term.margin, tuple):
        return term.less
    if term.margin == FIRST_DISTANCE:
        return nan
    return 0.0 if isinstance(term.margin, str) else term.margin


def gather_features(task: Parameters, sensors: Array, current: Array, goal: Array, episode: Array) -> Array:
    """Return features (rows, FEATURES): sensors and observation, then the points that only rewards use."""
    features = np.empty((len(sensors), FEATURES))
    features[:, : at.REWARD_WIDTH] = sensors
    features[:, at.CURRENT] = current
    features[:, GOAL] = goal
    features[:, EPISODE] = episode
    features[:, TCP] = (sensors[:, at.RIGHT_TIP] + sensors[:, at.LEFT_TIP]) / 2.0
    features[:, GRIP] = current[:, at.OBJECT] + task.cage.offset
    hand = current[:, at.HAND.start]
    slides = np.abs(current[:, at.OBJECT.start] - hand) < task.cage.slide
    np.copyto(features[:, GRIP.start], hand, where=slides)
    return features


Numbers = NDArray[np.floating]
"""Single or double precision: Meta-World uses the action's precision where the gripper's action takes part."""

AT_MARGIN = 0.1  # the value at a distance of one margin
LONG_TAIL = np.sqrt(1 / AT_MARGIN - 1)
GAUSSIAN = np.sqrt(-2 * np.log(AT_MARGIN))


def square(x: Array) -> Array:
    """Return the square by C's ``pow``, as Python and NumPy do for a single number. For an array, NumPy multiplies,
    which gives another last bit in one case out of a thousand."""
    return np.float_power(x, 2.0)


def long_tail(margins: Array) -> Array:
    """Return a curve from 1 at 0 to 0.1 at 1, which then falls slowly."""
    return 1 / (square(margins * LONG_TAIL) + 1)


def gaussian(margins: Array) -> Array:
    """Return a curve from 1 at 0 to 0.1 at 1, which then falls quickly to 0."""
    return np.exp(-0.5 * square(margins * GAUSSIAN))


def tolerance(x: Array, lower: Array | float, upper: Array | float, margin: Array | float) -> Array:
    """Return 1 from ``lower`` to ``upper``, and a long tail outside; a margin of 0 makes a sharp edge."""
    margins = np.where(x < lower, lower - x, x - upper) / margin
    return np.where((lower <= x) & (x <= upper), 1.0, long_tail(margins))


def hamacher_product(a: Numbers, b: Numbers) -> Numbers:
    """Return the fuzzy "and" of two numbers from 0 to 1."""
    product = a * b
    either = a + b - product
    return np.where(either > 0, product / either, product)


def limited(x: Numbers, low: float, high: float) -> Numbers:
    """Clip as ``np.clip``, in a third of its time for few numbers."""
    return np.minimum(np.maximum(x, low), high)


class Proximity(NamedTuple):
    """How close two points are, for every term of every row; all arrays are (rows, 4)."""

    distance: Array
    margin: Array  # the further distance at which the value is 0.1
    value: Array  # 1 if the points are close, less if they are not


class ProximityTerms:
    """Measures how close pairs of points are, for a fixed set of rows."""

    def __init__(self, task: Parameters) -> None:
        row = np.arange(len(task.within)).reshape(-1, 1, 1, 1, 1) * FEATURES
        points = task.points + row
        self._first = np.ascontiguousarray(points[:, :, 0])
        self._second = np.ascontiguousarray(points[:, :, 1])
        self._offset = task.offset
        self._axes = task.axes[:, None]
        self._within = task.within
        self._gaussian = np.nonzero(task.gaussian)

    def __call__(self, features: Array, less: Array) -> Proximity:
        """Measure features (rows, FEATURES). ``less`` (rows, 4) is subtracted from the distance of a margin's points;
        NaN in it is replaced by the present distance, which becomes the margin."""
        numbers = features.reshape(-1)
        difference = numbers.take(self._first)
        difference += self._offset
        difference -= numbers.take(self._second)
        difference *= self._axes
        length = row_norm(difference)
        distance = np.ascontiguousarray(length[:, 0])
        np.copyto(less, distance, where=np.isnan(less))
        margin = np.abs(length[:, 1] - less)
        beyond = (distance - self._within) / margin
        value = long_tail(beyond)
        if self._gaussian[0].size:
            value[self._gaussian] = gaussian(beyond[self._gaussian])
        value[distance <= self._within] = 1.0
        return Proximity(distance, margin, value)


CAGED = 0.97  # above this value, closing the gripper counts
CAGED_FOR_PINCH = 0.95
PADS = np.array([at.LEFT_PAD.start + 1, at.RIGHT_PAD.start + 1])
SIDES = np.array([1.0, -1.0])


class CagingTerm:
    """Measures how well the gripper encloses and grips the object, for a fixed set of rows."""

    def __init__(self, task: Parameters) -> None:
        self._rows = np.flatnonzero(task.cage.used)
        cage = task.cage.of(self._rows)
        row = self._rows * FEATURES
        self._pads = row[:, None] + PADS
        self._object = (row + GRIP.start + 1)[:, None]
        self._start = (row + cage.start)[:, None]
        self._radius, self._pad, self._signed = cage.radius[:, None], cage.pad[:, None], cage.signed[:, None]
        self._high, self._medium = cage.high, cage.medium
        pinching = np.isfinite(cage.pinch)
        self._gripping = ~pinching
        self._pinching = np.flatnonzero(pinching)
        self._pinch = (cage.radius + cage.pinch)[self._pinching][:, None]

    def __call__(self, features: Array, near: Proximity, closed: Numbers, narrow: Mask) -> tuple[Array, Mask]:
        """Return values (rows,) from 0 to 1 for features (rows, FEATURES), and in which rows they have the action's
        precision because ``closed`` takes part. ``closed`` (rows,) is the gripper's closing command in that precision;
        ``narrow`` (rows,) is true if it is a number of the action, not a bound of its range."""
        rows = self._rows
        numbers = features.reshape(-1)
        pads, where = numbers.take(self._pads), numbers.take(self._object)
        sideways = pads - where
        sideways = np.where(self._signed, sideways * SIDES, np.abs(sideways))
        margin = np.abs(np.abs(pads - numbers.take(self._start)) - self._pad)
        left, right = tolerance(sideways, self._radius, self._pad, margin).T
        cage = hamacher_product(hamacher_product(left, right), near.value[rows, ACROSS])
        via = near.value[rows, VIA]

        caged = cage > CAGED
        gripped = np.where(caged & self._gripping, closed[rows], 0.0)
        grasp = self._blend(cage, gripped, via, self._high, self._medium)
        narrow = narrow[rows] & caged & self._gripping
        if narrow.any():
            some, dtype = np.flatnonzero(narrow), closed.dtype
            kinds = self._high[some], self._medium[some]
            grasp[some] = self._blend(cage[some].astype(dtype), closed[rows[some]], via[some].astype(dtype), *kinds)
        if (some := self._pinching).size:
            left, right = tolerance(sideways[some], self._radius[some], self._pinch, margin[some]).T
            pinched = np.where(cage[some] > CAGED_FOR_PINCH, hamacher_product(left, right), 0.0)
            grasp[some] = (cage[some] + pinched) / 2

        all_grasps, all_narrow = np.zeros(len(features)), np.zeros(len(features), dtype=bool)
        all_grasps[rows], all_narrow[rows] = grasp, narrow
        return all_grasps, all_narrow

    @staticmethod
    def _blend(cage: Any, gripped: Any, via: Any, high: Mask, medium: Mask) -> Any:
        both = hamacher_product(cage, gripped)
        other = np.where(high, cage, via)
        return np.where(high | medium, (both + other) / 2, both)


FUNNEL_DEPTH = 0.01  # metres below the floor that still count as above it


class FunnelTerm:
    """Measures whether the hand stays above a funnel's floor, for a fixed set of rows."""

    def __init__(self, task: Parameters) -> None:
        self._rows = np.flatnonzero(task.funnel.used)
        funnel = task.funnel.of(self._rows)
        row = self._rows * FEATURES
        self._height_of = row + funnel.over
        self._from = (row + funnel.over)[:, None, None] + (-2, -1)
        self._about = row[:, None, None] + funnel.about
        self._offset = funnel.offset[:, None, :2]
        self._rim, self._slope, self._height = (one[:, None] for one in (funnel.rim, funnel.slope, funnel.height))
        self._margin = funnel.margin

    def __call__(self, features: Array) -> Array:
        """Return 1 above the floor and less below it, (rows,)."""
        above = np.ones(len(features))
        if self._rows.size:
            numbers = features.reshape(-1)
            radius = row_norm(numbers.take(self._from) - (numbers.take(self._about) + self._offset)) - self._rim
            floor = np.where(radius > 0.0, self._slope * np.log(radius) + self._height, 0.0).min(axis=1)
            margin = np.where(np.isnan(self._margin), floor / 2.0, self._margin)
            z = numbers.take(self._height_of)
            above[self._rows] = np.where(z >= floor, 1.0, tolerance(floor - z, 0.0, FUNNEL_DEPTH, margin))
        return above
