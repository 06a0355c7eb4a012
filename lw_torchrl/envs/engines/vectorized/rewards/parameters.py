"""The table's numbers as arrays, one entry a row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from math import inf, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.table import FIRST_DISTANCE, TaskReward, Term
from lw_torchrl.envs.engines.vectorized.sensors import HAND, LEFT_PAD, OBJECT, PLACE, REWARD_WIDTH, SECOND
from lw_torchrl.envs.engines.vectorized.simulation_table import NO_OFFSET

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Truth = NDArray[np.bool_]


def _after(place: slice, width: int = 3) -> slice:
    return slice(place.stop, place.stop + width)


# The columns of the facts, after the sensors. The first four of these are settled by the reset.
START = slice(REWARD_WIDTH, REWARD_WIDTH + 3)
TCP_START = _after(START)
MARK = _after(TCP_START)
CONSTANT = _after(MARK)
EPISODE = slice(START.start, CONSTANT.stop)
GOAL = _after(CONSTANT)
TCP = _after(GOAL)
GRIP = _after(TCP)
FACTS = GRIP.stop

COLUMNS = {
    "hand": HAND,
    "object": OBJECT,
    "second": SECOND,
    "goal": GOAL,
    "tcp": TCP,
    "left pad": LEFT_PAD,
    "grip": GRIP,
    "place": PLACE,
    "start": START,
    "tcp at start": TCP_START,
    "mark": MARK,
}

NEAR, PLACED, VIA, ACROSS = range(4)


@dataclass(frozen=True)
class Parameters:
    """Arrays over the rows; what the numbers mean says the head of data/rewards.toml.

    The last axes of ``points`` and ``offset`` are [distance or margin][first point, second point][term][x, y, z], of
    the others the term.
    """

    formula: NDArray[np.str_]
    lift: NDArray[np.str_]
    points: Index
    offset: Array
    axes: Array
    within: Array
    less: Array
    gaussian: Truth
    slide: Array
    grip_offset: Array
    caged: Truth
    radius: Array
    pad: Array
    effort: Array
    cage_start: Index
    signed: Truth
    pinch: Array
    high: Truth
    medium: Truth
    funnelled: Truth
    funnel_over: Index
    funnel_about: Index
    funnel_offset: Array
    rim: Array
    slope: Array
    height: Array
    funnel_margin: Array
    held_near: Array
    held_within: Array
    opened: Array
    opened_from: Array
    opened_under: Array
    lifted: Array
    lifted_column: Index
    moved: Array
    grasps: Truth
    done_under: Array
    done_within: Array
    weights: Array
    factor: Array
    bonus: Array
    shut: Truth
    gripper: Truth

    def of(self, rows: Any) -> Parameters:
        """The same for some of the rows."""
        return Parameters(**{entry.name: getattr(self, entry.name)[rows] for entry in fields(self)})


def _columns(reward: TaskReward, point: str) -> list[int]:
    if point != "waypoint":
        return list(range(FACTS)[COLUMNS[point]])
    return [
        COLUMNS[value].start + axis if isinstance(value, str) else CONSTANT.start + axis
        for axis, value in enumerate(reward.waypoint)
    ]


def waypoint_numbers(reward: TaskReward) -> list[float]:
    """The waypoint's numbers, 0 where it takes a point's."""
    return [0.0 if isinstance(value, str) else value for value in reward.waypoint]


def _less(term: Term) -> float:
    """What is taken from the distance of the margin's points; a margin that is a number has one point twice."""
    if isinstance(term.margin, tuple):
        return term.less
    if term.margin == FIRST_DISTANCE:
        return nan
    return 0.0 if isinstance(term.margin, str) else term.margin


def make_parameters(rewards: Sequence[TaskReward]) -> Parameters:
    """The arrays of these rows."""

    def array(number: Callable[[TaskReward], Any], dtype: Any = np.float64) -> Any:
        kinds = {id(reward): reward for reward in rewards}
        values = {key: number(reward) for key, reward in kinds.items()}
        return np.array([values[id(reward)] for reward in rewards], dtype=dtype)

    def cage(name: str, without: Any, dtype: Any = np.float64) -> Any:
        return array(lambda reward: without if reward.cage is None else getattr(reward.cage, name), dtype)

    def funnel(name: str, without: Any) -> Any:
        return array(lambda reward: without if reward.funnel is None else getattr(reward.funnel, name))

    def points(reward: TaskReward) -> list[list[list[list[int]]]]:
        margins = [term.margin if isinstance(term.margin, tuple) else term.between[:1] * 2 for term in reward.terms]
        pairs = [[term.between for term in reward.terms], margins]
        return [[[_columns(reward, pair[end]) for pair in kind] for end in (0, 1)] for kind in pairs]

    return Parameters(
        formula=array(lambda reward: reward.formula, np.str_),
        lift=array(lambda reward: reward.lift or "", np.str_),
        points=array(points, np.intp),
        offset=array(
            lambda reward: [[term.offset for term in reward.terms], [term.margin_offset for term in reward.terms]]
        ),
        axes=array(lambda reward: [term.axes for term in reward.terms]),
        within=array(lambda reward: [term.within for term in reward.terms]),
        less=array(lambda reward: [_less(term) for term in reward.terms]),
        gaussian=array(lambda reward: [term.curve == "gaussian" for term in reward.terms], np.bool_),
        slide=cage("slide", 0.0),
        grip_offset=cage("offset", NO_OFFSET),
        caged=array(lambda reward: reward.cage is not None, np.bool_),
        radius=cage("radius", 0.0),
        pad=cage("pad", 0.0),
        effort=cage("effort", 1.0),
        cage_start=array(_cage_start, np.intp),
        signed=cage("signed", False, np.bool_),
        pinch=array(lambda reward: inf if reward.cage is None or reward.cage.pinch is None else reward.cage.pinch),
        high=array(lambda reward: reward.cage is not None and reward.cage.density == "high", np.bool_),
        medium=array(lambda reward: reward.cage is not None and reward.cage.density == "medium", np.bool_),
        funnelled=array(lambda reward: reward.funnel is not None, np.bool_),
        funnel_over=array(lambda reward: COLUMNS[reward.funnel.over if reward.funnel else "hand"].start + 2, np.intp),
        funnel_about=array(_funnel_about, np.intp),
        funnel_offset=funnel("offset", NO_OFFSET)[:, :2],
        rim=funnel("rim", 0.0),
        slope=funnel("slope", 0.0),
        height=funnel("height", 0.0),
        funnel_margin=array(lambda reward: reward.funnel.margin if reward.funnel and reward.funnel.margin else nan),
        held_near=array(lambda reward: reward.held.near),
        held_within=array(lambda reward: reward.held.within),
        opened=array(lambda reward: reward.held.opened),
        opened_from=array(lambda reward: reward.held.opened_from),
        opened_under=array(lambda reward: reward.held.opened_under),
        lifted=array(lambda reward: reward.held.lifted),
        lifted_column=array(lambda reward: OBJECT.start + reward.held.lifted_axis, np.intp),
        moved=array(lambda reward: reward.held.moved),
        grasps=array(lambda reward: reward.held.grasps, np.bool_),
        done_under=array(lambda reward: reward.done_under),
        done_within=array(lambda reward: reward.done_within),
        weights=array(lambda reward: reward.weights),
        factor=array(lambda reward: reward.factor),
        bonus=array(lambda reward: reward.bonus),
        shut=array(lambda reward: reward.shut, np.bool_),
        gripper=array(lambda reward: reward.gripper, np.bool_),
    )


def _cage_start(reward: TaskReward) -> int:
    """The column of the y that a pad's margin is taken from."""
    if reward.cage is None:
        return GRIP.start + 1
    return COLUMNS["grip" if reward.cage.signed else reward.cage.start].start + 1


def _funnel_about(reward: TaskReward) -> list[list[int]]:
    """The columns of x and y of two points, which may be the same."""
    about = reward.funnel.about if reward.funnel else ("object",)
    return [[COLUMNS[point].start, COLUMNS[point].start + 1] for point in (about[0], about[-1])]
