"""The building blocks of dense rewards: features, reward terms, and the parameters from data/rewards.toml as arrays."""

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

# Columns of the feature array: the sensors, then the following points. The first four are constant during an episode.
START, TCP_START, MARK, CONSTANT, GOAL, TCP, GRIP = (
    slice(at.REWARD_WIDTH + 3 * number, at.REWARD_WIDTH + 3 * number + 3) for number in range(7)
)
EPISODE = slice(START.start, CONSTANT.stop)
FEATURES = GRIP.stop

# The columns of each point in POINTS, except the last one (the waypoint).
_COLUMNS = at.HAND, at.OBJECT, at.SECOND, GOAL, TCP, at.LEFT_PAD, GRIP, at.PLACE, START, TCP_START, MARK
COLUMNS = {point: list(range(FEATURES)[columns]) for point, columns in zip(POINTS[:-1], _COLUMNS, strict=True)}

NEAR, PLACED, VIA, ACROSS = range(4)

_DTYPES = {bool: np.bool_, int: np.intp, float: np.float64, tables.Vector: np.float64, tables.Pair: np.float64}
_NO_CAGE = Cage(radius=0.0, pad=0.0, across=0.0)
_NO_FUNNEL = Funnel(over="hand", about=("object",), rim=0.0, slope=0.0, height=0.0)


class Parameters(SimpleNamespace):
    """The numeric fields of :class:`TaskReward`, ``cage``, ``funnel`` and ``held``, as arrays with one entry per row.
    ``points`` has the axes (row, distance or margin, first or second point, term, xyz), ``offset`` the axes (row,
    distance or margin, term, xyz), and the other arrays of terms the axes (row, term)."""

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
            about=np.array(
                [[COLUMNS[point][:2] for point in (funnel.about[0], funnel.about[-1])] for funnel in funnels]
            ),
        ),
        held=Parameters(**_numbers(Held, [reward.held for reward in rewards])),
    )


def _numbers(kind: Any, parts: Sequence[Any]) -> dict[str, Any]:
    numeric: list[Any] = [f for f in fields(kind) if f.type in _DTYPES]
    return {f.name: np.array([getattr(part, f.name) for part in parts], _DTYPES[f.type]) for f in numeric}


def _points(reward: TaskReward) -> list[list[list[list[int]]]]:
    margins = [term.margin if isinstance(term.margin, tuple) else term.between[:1] * 2 for term in reward.terms]
    pairs = [[term.between for term in reward.terms], margins]
    constant = range(FEATURES)[CONSTANT]
    waypoint = [(COLUMNS[v] if isinstance(v, str) else constant)[axis] for axis, v in enumerate(reward.waypoint)]
    columns = COLUMNS | {"waypoint": waypoint}
    return [[[columns[pair[end]] for pair in kind] for end in (0, 1)] for kind in pairs]


def _less(term: Term) -> float:
    """Return ``less`` for a margin ``abs(distance - less)``; a constant margin is ``less``, with distance 0."""
    if isinstance(term.margin, tuple):
        return term.less
    if term.margin == FIRST_DISTANCE:
        return nan
    return 0.0 if isinstance(term.margin, str) else term.margin


def gather_features(task: Parameters, sensors: Array, current: Array, goal: Array, episode: Array) -> Array:
    """Return the features (rows, FEATURES): sensors, observation, and points that only the rewards use."""
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
"""A float32 or float64 array: Meta-World uses the action's precision if a term depends on the gripper action."""

AT_MARGIN = 0.1  # the value of a term whose distance equals the margin
LONG_TAIL = np.sqrt(1 / AT_MARGIN - 1)
GAUSSIAN = np.sqrt(-2 * np.log(AT_MARGIN))


def square(x: Array) -> Array:
    """Return the square computed with C's ``pow``, as Python and NumPy do for scalars. For arrays, NumPy multiplies
    instead, which changes the last bit of one result in a thousand."""
    return np.float_power(x, 2.0)


def long_tail(margins: Array) -> Array:
    """Return a long-tailed curve that is 1 at 0 and 0.1 at 1, and then decreases slowly."""
    return 1 / (square(margins * LONG_TAIL) + 1)


def gaussian(margins: Array) -> Array:
    """Return a Gaussian curve that is 1 at 0 and 0.1 at 1, and then decreases quickly to 0."""
    return np.exp(-0.5 * square(margins * GAUSSIAN))


def tolerance(x: Array, lower: Array | float, upper: Array | float, margin: Array | float) -> Array:
    """Return 1 for x in [``lower``, ``upper``]; outside, a value that decays with distance (0 if the margin is 0)."""
    margins = np.where(x < lower, lower - x, x - upper) / margin
    return np.where((lower <= x) & (x <= upper), 1.0, long_tail(margins))


def hamacher_product(a: Numbers, b: Numbers) -> Numbers:
    """Return the Hamacher product, a fuzzy "and", of two numbers from 0 to 1."""
    product = a * b
    either = a + b - product
    return np.where(either > 0, product / either, product)


def limited(x: Numbers, low: float, high: float) -> Numbers:
    """Clip x like ``np.clip``, but three times as fast for small arrays."""
    return np.minimum(np.maximum(x, low), high)


class Proximity(NamedTuple):
    """A measure of how close two points are, for each row and term; all arrays are (rows, 4)."""

    distance: Array
    margin: Array  # distance beyond the limit at which the value falls to 0.1
    value: Array  # 1 if the points are close, otherwise less than 1


class ProximityTerms:
    """A callable that measures how close pairs of points are, for a fixed set of rows."""

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
        """Compute the proximity from features (rows, FEATURES). ``less`` (rows, 4) is subtracted from the distance
        between a margin's points; NaN entries of ``less`` are replaced in place by the current distance."""
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


CAGED = 0.97  # if the cage value is above this threshold, closing the gripper is rewarded
CAGED_FOR_PINCH = 0.95
PADS = np.array([at.LEFT_PAD.start + 1, at.RIGHT_PAD.start + 1])
SIDES = np.array([1.0, -1.0])


class CagingTerm:
    """A callable that measures how well the gripper encloses and grips the object, for a fixed set of rows."""

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
        """Return grasp values (rows,) from 0 to 1 for features (rows, FEATURES), and a mask (rows,) of the values that
        depend on ``closed`` and therefore have the action's precision. ``closed`` (rows,) is the gripper's closing
        command in that precision; ``narrow`` (rows,) is true where the command was not clipped."""
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


FUNNEL_DEPTH = 0.01  # up to this far below the floor (metres), a point still counts as above the floor


class FunnelTerm:
    """A callable that measures whether the hand stays above a funnel's floor, for a fixed set of rows."""

    def __init__(self, task: Parameters) -> None:
        self._rows = np.flatnonzero(task.funnel.used)
        funnel = task.funnel.of(self._rows)
        row = self._rows * FEATURES
        self._height_of = row + funnel.over
        self._from = (row + funnel.over)[:, None, None] + (-2, -1)
        self._about = row[:, None, None] + funnel.about
        self._offset = funnel.offset[:, None, :2]
        self._rim, self._slope, self._height = (array[:, None] for array in (funnel.rim, funnel.slope, funnel.height))
        self._margin = funnel.margin

    def __call__(self, features: Array) -> Array:
        """Return values (rows,): 1 above the floor and up to 1 cm below it, and less than 1 further below."""
        above = np.ones(len(features))
        if self._rows.size:
            numbers = features.reshape(-1)
            radius = row_norm(numbers.take(self._from) - (numbers.take(self._about) + self._offset)) - self._rim
            floor = np.where(radius > 0.0, self._slope * np.log(radius) + self._height, 0.0).min(axis=1)
            margin = np.where(np.isnan(self._margin), floor / 2.0, self._margin)
            z = numbers.take(self._height_of)
            above[self._rows] = np.where(z >= floor, 1.0, tolerance(floor - z, 0.0, FUNNEL_DEPTH, margin))
        return above
