"""Meta-World's dense reward for many rows at once, bit-identical to Meta-World."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import check_choice
from lw_torchrl.suites.metaworld import reward_terms as terms
from lw_torchrl.suites.metaworld.observation import CURRENT, GRIPPER, OBJECT, Array, Index, Mask
from lw_torchrl.suites.metaworld.reward_formulas import FORMULAS, LIFTS, StepState
from lw_torchrl.suites.metaworld.tables import FIRST_DISTANCE, TaskReward

FULL_REWARD = 10.0


class EpisodeStarts:
    """The values from each row's first state of the episode that the row's reward depends on."""

    def __init__(self, rewards: Sequence[TaskReward]) -> None:
        for reward in rewards:
            check_choice("formula", reward.formula, FORMULAS)
            if reward.lift is not None:
                check_choice("lift", reward.lift, LIFTS)
        self.rewards = tuple(rewards)
        self.task = terms.make_parameters(rewards)
        self.points = np.zeros((len(rewards), terms.EPISODE.stop - terms.EPISODE.start))
        self.less = self.task.less.copy()

    def begin(self, row: int, program: Any) -> None:
        reward = self.rewards[row]
        features = np.zeros(terms.FEATURES)
        features[terms.CONSTANT] = [0.0 if isinstance(value, str) else value for value in reward.waypoint]
        for columns, name in ((terms.START, reward.start), (terms.TCP_START, "init_tcp"), (terms.MARK, reward.mark)):
            if name is not None:
                features[columns] = getattr(program, name)
        self.points[row] = features[terms.EPISODE]
        self.less[row] = self.task.less[row]
        for number, term in enumerate(reward.terms):
            if isinstance(term.margin, str) and term.margin != FIRST_DISTANCE:
                self.less[row, number] = getattr(program, term.margin)


class DenseReward:
    """A callable that computes the rewards of a fixed set of rows; ``starts`` covers all rows of the engine."""

    def __init__(self, starts: EpisodeStarts, rows: Index) -> None:
        self._starts, self._rows = starts, rows
        self._task = task = starts.task.of(rows)
        self._proximity = terms.ProximityTerms(task)
        self._caging = terms.CagingTerm(task)
        self._funnels = terms.FunnelTerm(task)
        self._lifts = [(LIFTS[name], np.flatnonzero(task.lift == name)) for name in np.unique(task.lift) if name]
        self._formulas = [(FORMULAS[name], np.flatnonzero(task.formula == name)) for name in np.unique(task.formula)]

    @np.errstate(all="ignore")  # unstable rows and unused branches may hold arbitrary numbers
    def __call__(self, sensors: Array, observation: Array, goal: Array, action: NDArray[Any]) -> Array:
        """Compute rewards (rows,) as Meta-World's ``compute_reward`` does, from sensors (rows, REWARD_WIDTH),
        observations (rows, 39), goals (rows, 3) and actions (rows, 4) in the environment's action dtype."""
        task, less, points = self._task, self._starts.less[self._rows], self._starts.points[self._rows]
        features = terms.gather_features(task, sensors, observation[:, CURRENT], goal, points)
        proximity = self._proximity(features, less)
        self._starts.less[self._rows] = less
        precision = np.result_type(action.dtype, 1.0)
        action = action[:, 3].astype(precision)
        effort = task.cage.effort.astype(precision)
        closed = np.minimum(np.maximum(action, 0), effort) / effort
        narrow = (action > 0) & (action <= effort) & (precision != np.float64)
        grasp, narrow_grasp = self._caging(features, proximity, closed, narrow)
        held = self._held(features, proximity)
        perfect = held & task.held.grasps
        grasp[perfect] = 1.0
        near, placed, via, _ = proximity.value.T.copy()
        state = StepState(
            task=task,
            features=features,
            proximity=proximity,
            near=near,
            placed=placed,
            via=via,
            above=self._funnels(features),
            lift=placed.copy(),
            wide=np.zeros(len(features), dtype=bool),
            grasp=grasp,
            narrow=(narrow_grasp & ~perfect) | (narrow & task.gripper),
            closed=closed,
            effort=(terms.limited(action, -1, 1) + 1.0) / 2.0,
            held=held,
        )
        for lift, rows in self._lifts:
            lift(state, rows)
        reward = np.empty(len(features))
        for formula, rows in self._formulas:
            reward[rows] = formula(state, rows, lambda numbers: numbers)
        if state.narrow.any():
            for formula, rows in self._formulas:
                if (some := rows[state.narrow[rows]]).size:
                    reward[some] = formula(state, some, lambda numbers: numbers.astype(precision))
        distance = proximity.distance[:, terms.PLACED]
        reward[(distance < task.done_under) | (distance <= task.done_within)] = FULL_REWARD
        return reward

    def _held(self, features: Array, proximity: terms.Proximity) -> Mask:
        task = self._task
        near, opening = proximity.distance[:, terms.NEAR], features[:, GRIPPER]
        height = features[np.arange(len(features)), OBJECT.start + task.held.lifted_axis]
        moved = proximity.margin[:, terms.PLACED] - proximity.distance[:, terms.PLACED]
        held = (near < task.held.near) & (near <= task.held.within)
        held &= (opening > task.held.opened) & (opening >= task.held.opened_from) & (opening < task.held.opened_under)
        return held & (height - task.held.lifted > features[:, terms.START.stop - 1]) & (moved > task.held.moved)
