"""The numbers of data/rewards.toml as arrays, one entry a row, and the features that rewards are computed from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from math import nan
from types import SimpleNamespace
from typing import Any

import numpy as np

from lw_torchrl.envs.engines.vectorized.observation import (
    CURRENT,
    HAND,
    LEFT_PAD,
    LEFT_TIP,
    OBJECT,
    PLACE,
    REWARD_WIDTH,
    RIGHT_TIP,
    SECOND,
    Array,
)
from lw_torchrl.envs.engines.vectorized.tables import FIRST_DISTANCE, POINTS, Cage, Funnel, Held, TaskReward, Term

# The columns of the features: first the sensors, then these. The first four are constant within an episode.
START, TCP_START, MARK, CONSTANT, GOAL, TCP, GRIP = (
    slice(REWARD_WIDTH + 3 * number, REWARD_WIDTH + 3 * number + 3) for number in range(7)
)
EPISODE = slice(START.start, CONSTANT.stop)
FEATURES = GRIP.stop

# The columns of each of POINTS but the last, the waypoint.
_COLUMNS = HAND, OBJECT, SECOND, GOAL, TCP, LEFT_PAD, GRIP, PLACE, START, TCP_START, MARK
COLUMNS = dict(zip(POINTS[:-1], _COLUMNS, strict=True))

NEAR, PLACED, VIA, ACROSS = range(4)

_DTYPES = {"bool": np.bool_, "int": np.intp, "float": np.float64, "Vector": np.float64, "Pair": np.float64}
_NO_CAGE = Cage(radius=0.0, pad=0.0, across=0.0)
_NO_FUNNEL = Funnel(over="hand", about=("object",), rim=0.0, slope=0.0, height=0.0)


class Parameters(SimpleNamespace):
    """Arrays over the rows: the numbers of :class:`TaskReward`, and of its parts ``cage``, ``funnel`` and ``held``. The
    last axes of ``points`` and ``offset`` are [distance or margin][first point, second point][term][x, y, z], of the
    other arrays of terms the term."""

    def of(self, rows: Any) -> Parameters:
        return Parameters(
            **{key: own.of(rows) if isinstance(own, Parameters) else own[rows] for key, own in vars(self).items()}
        )


def make_parameters(rewards: Sequence[TaskReward]) -> Parameters:
    kinds = list({id(reward): reward for reward in rewards}.values())
    place = {id(reward): number for number, reward in enumerate(kinds)}
    return _parameters(kinds).of(np.array([place[id(reward)] for reward in rewards]))


def _parameters(rewards: Sequence[TaskReward]) -> Parameters:
    terms = [reward.terms for reward in rewards]

    def of_terms(name: str) -> Array:
        return np.array([[getattr(term, name) for term in four] for four in terms])

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
        less=np.array([[_less(term) for term in four] for four in terms]),
        gaussian=of_terms("curve") == "gaussian",
        cage=Parameters(
            **_numbers(Cage, cages),
            used=np.array([reward.cage is not None for reward in rewards]),
            start=np.array([COLUMNS["grip" if cage.signed else cage.start].start + 1 for cage in cages]),
            high=np.array([cage.density == "high" for cage in cages]),
            medium=np.array([cage.density == "medium" for cage in cages]),
        ),
        funnel=Parameters(
            **_numbers(Funnel, funnels),
            used=np.array([reward.funnel is not None for reward in rewards]),
            over=np.array([COLUMNS[funnel.over].start + 2 for funnel in funnels]),
            about=np.array([_about(funnel) for funnel in funnels]),
        ),
        held=Parameters(**_numbers(Held, [reward.held for reward in rewards])),
    )


def _numbers(kind: Any, parts: Sequence[Any]) -> dict[str, Any]:
    return {
        one.name: np.array([getattr(part, one.name) for part in parts], dtype=_DTYPES[one.type])
        for one in fields(kind)
        if one.type in _DTYPES
    }


def _points(reward: TaskReward) -> list[list[list[list[int]]]]:
    margins = [term.margin if isinstance(term.margin, tuple) else term.between[:1] * 2 for term in reward.terms]
    pairs = [[term.between for term in reward.terms], margins]
    return [[[_columns(reward, pair[end]) for pair in kind] for end in (0, 1)] for kind in pairs]


def _columns(reward: TaskReward, point: str) -> list[int]:
    if point != "waypoint":
        return list(range(FEATURES)[COLUMNS[point]])
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


def _about(funnel: Funnel) -> list[list[int]]:
    """The columns of x and y of two points, which may be the same."""
    return [[COLUMNS[point].start, COLUMNS[point].start + 1] for point in (funnel.about[0], funnel.about[-1])]


def gather_features(task: Parameters, sensors: Array, current: Array, goal: Array, episode: Array) -> Array:
    """(rows, FEATURES): sensors and observation, then the points that only rewards use."""
    features = np.empty((len(sensors), FEATURES))
    features[:, :REWARD_WIDTH] = sensors
    features[:, CURRENT] = current
    features[:, GOAL] = goal
    features[:, EPISODE] = episode
    features[:, TCP] = (sensors[:, RIGHT_TIP] + sensors[:, LEFT_TIP]) / 2.0
    features[:, GRIP] = current[:, OBJECT] + task.cage.offset
    hand = current[:, HAND.start]
    slides = np.abs(current[:, OBJECT.start] - hand) < task.cage.slide
    np.copyto(features[:, GRIP.start], hand, where=slides)
    return features
