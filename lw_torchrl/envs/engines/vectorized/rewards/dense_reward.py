"""Meta-World's dense reward of many rows at once, in the bits of its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._checks import check_choice
from lw_torchrl.envs.engines.vectorized.rewards.caging import Caging
from lw_torchrl.envs.engines.vectorized.rewards.carrying import CARRYING
from lw_torchrl.envs.engines.vectorized.rewards.closeness import Closeness, Distances
from lw_torchrl.envs.engines.vectorized.rewards.facts import gather_facts
from lw_torchrl.envs.engines.vectorized.rewards.funnels import Funnels
from lw_torchrl.envs.engines.vectorized.rewards.lifting import LIFTS
from lw_torchrl.envs.engines.vectorized.rewards.moment import Moment
from lw_torchrl.envs.engines.vectorized.rewards.parameters import (
    CONSTANT,
    EPISODE,
    FACTS,
    MARK,
    NEAR,
    PLACED,
    START,
    TCP_START,
    make_parameters,
    waypoint_numbers,
)
from lw_torchrl.envs.engines.vectorized.rewards.reaching import REACHING
from lw_torchrl.envs.engines.vectorized.rewards.table import FIRST_DISTANCE, TaskReward
from lw_torchrl.envs.engines.vectorized.rewards.terms import limited
from lw_torchrl.envs.engines.vectorized.sensors import CURRENT, GRIPPER

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Truth = NDArray[np.bool_]

FORMULAS = REACHING | CARRYING
FULL_REWARD = 10.0


class EpisodeNotes:
    """What the rewards of an episode need to know of its beginning, one entry a row.

    Args:
        rewards: each row's task.

    Raises:
        ValueError: a formula or a lift that does not exist.
    """

    def __init__(self, rewards: Sequence[TaskReward]) -> None:
        for reward in rewards:
            check_choice("formula", reward.formula, FORMULAS)
            if reward.lift is not None:
                check_choice("lift", reward.lift, LIFTS)
        self.rewards = tuple(rewards)
        self.task = make_parameters(rewards)
        self.points = np.zeros((len(rewards), EPISODE.stop - EPISODE.start))
        self.less = self.task.less.copy()

    def begin(self, row: int, program: Any) -> None:
        """Note the start of a row's episode from Meta-World's program, just reset."""
        reward = self.rewards[row]
        facts = np.zeros(FACTS)
        facts[CONSTANT] = waypoint_numbers(reward)
        for columns, name in ((START, reward.start), (TCP_START, "init_tcp"), (MARK, reward.mark)):
            if name is not None:
                facts[columns] = getattr(program, name)
        self.points[row] = facts[EPISODE]
        self.less[row] = self.task.less[row]
        for number, term in enumerate(reward.terms):
            if isinstance(term.margin, str) and term.margin != FIRST_DISTANCE:
                self.less[row, number] = getattr(program, term.margin)


class DenseReward:
    """Rewards a fixed set of rows.

    Args:
        notes: of all rows.
        rows: the set.
    """

    def __init__(self, notes: EpisodeNotes, rows: Index) -> None:
        self._notes, self._rows = notes, rows
        self._task = task = notes.task.of(rows)
        self._distances = Distances(task)
        self._caging = Caging(task)
        self._funnels = Funnels(task)
        self._every_row = np.arange(len(rows))
        self._lifts = [(LIFTS[name], np.flatnonzero(task.lift == name)) for name in np.unique(task.lift) if name]
        self._formulas = [(FORMULAS[name], np.flatnonzero(task.formula == name)) for name in np.unique(task.formula)]

    def __call__(self, sensors: Array, observation: Array, goal: Array, action: NDArray[Any]) -> Array:
        """(rows,) the rewards, as Meta-World's ``compute_reward``.

        Args:
            sensors: (rows, REWARD_WIDTH) what was read from the states.
            observation: (rows, 39).
            goal: (rows, 3) the goals.
            action: (rows, 4) what was done, in the action's own precision.
        """
        # Rows whose simulation broke, and branches that are not taken, may hold anything.
        with np.errstate(all="ignore"):
            less = self._notes.less[self._rows]
            points = self._notes.points[self._rows]
            facts = gather_facts(self._task, sensors, observation[:, CURRENT], goal, points)
            close = self._distances(facts, less)
            self._notes.less[self._rows] = less
            return self._reward(facts, close, action[:, 3])

    def _reward(self, facts: Array, close: Closeness, action: NDArray[Any]) -> Array:
        task = self._task
        precision = np.result_type(action.dtype, 1.0)
        action = action.astype(precision)
        effort = task.effort.astype(precision)
        closed = np.minimum(np.maximum(action, 0), effort) / effort
        narrow = (action > 0) & (action <= effort) & (precision != np.float64)
        grasp, narrow_grasp = self._caging(facts, close, closed, narrow)
        held = self._held(facts, close)
        perfect = held & task.grasps
        grasp[perfect] = 1.0
        near, placed, via, _ = close.value.T.copy()
        moment = Moment(
            task=task,
            facts=facts,
            close=close,
            near=near,
            placed=placed,
            via=via,
            above=self._funnels(facts),
            lift=placed.copy(),
            wide=np.zeros(len(facts), dtype=bool),
            grasp=grasp,
            narrow=(narrow_grasp & ~perfect) | (narrow & task.gripper),
            closed=closed,
            effort=(limited(action, -1, 1) + 1.0) / 2.0,
            held=held,
        )
        for lift, rows in self._lifts:
            lift(moment, rows)
        reward = np.empty(len(facts))
        for formula, rows in self._formulas:
            reward[rows] = formula(moment, rows, lambda numbers: numbers)
        if moment.narrow.any():
            for formula, rows in self._formulas:
                if (some := rows[moment.narrow[rows]]).size:
                    reward[some] = formula(moment, some, lambda numbers: numbers.astype(precision))
        distance = close.distance[:, PLACED]
        reward[(distance < task.done_under) | (distance <= task.done_within)] = FULL_REWARD
        return reward

    def _held(self, facts: Array, close: Closeness) -> Truth:
        task = self._task
        near, opening = close.distance[:, NEAR], facts[:, GRIPPER]
        height = facts[self._every_row, task.lifted_column]
        moved = close.margin[:, PLACED] - close.distance[:, PLACED]
        held = (near < task.held_near) & (near <= task.held_within)
        held &= (opening > task.opened) & (opening >= task.opened_from) & (opening < task.opened_under)
        return held & (height - task.lifted > facts[:, START.stop - 1]) & (moved > task.moved)
