"""Meta-World's dense reward for many rows at once, bit-identical to Meta-World: the formulas of the tasks, the lift
functions, which measure a held object's progress to the goal, and the rewards of a step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld import reward_terms as terms
from lw_torchrl.suites.metaworld.observation import Array, Index, Mask, row_norm
from lw_torchrl.suites.metaworld.reward_terms import Numbers, hamacher_product, limited, square, tolerance
from lw_torchrl.suites.metaworld.tables import FIRST_DISTANCE, TaskReward

Cast = Callable[[Any], Any]
"""A function that converts numbers to the precision of a formula: single if the reward depends on a float32 action,
because NumPy keeps single precision when Python numbers are added."""

Formula = Callable[["StepState", Index, Cast], Numbers]  # (state, rows, cast) -> rewards (len(rows),)


@dataclass
class StepState:
    """The quantities from which rewards are computed after a time step, with one entry per row."""

    task: terms.Parameters
    features: Array  # (rows, FEATURES)
    proximity: terms.Proximity
    near: Array  # the values of the terms near, placed and via, from 0 to 1
    placed: Array
    via: Array
    above: Array  # how well the hand stays above the floor of the funnel, from 0 to 1
    lift: Array  # the progress of a held object to the goal
    wide: Mask  # rows in which Meta-World's ``lift`` is a NumPy number, so that single precision becomes double
    grasp: Array  # how well the object is gripped, from 0 to 1
    narrow: Mask  # rows whose reward depends on the action and therefore has the action's precision
    closed: Numbers  # the gripper's closing command, from 0 to 1
    effort: Numbers  # the gripper's action, from 0 (open) to 1 (closed)
    held: Mask  # whether the object counts as held


def _by_name(*functions: Any) -> dict[str, Any]:
    """Return the functions by their names in data/rewards.toml."""
    return {function.__name__.replace("_", " "): function for function in functions}


TO_HANDLE = np.array([-0.05, 0.0, 0.0])
BESIDE_HANDLE = np.array([0.05, 0.03, -0.01])
UPRIGHT = np.array([0.707, 0.0, 0.0, 0.707])


def reach(s: StepState, rows: Index, cast: Cast) -> Array:
    return 10 * s.placed[rows]


def press(s: StepState, rows: Index, cast: Cast) -> Array:
    """Reward approaching with an open gripper (closed if ``shut``) and then pressing, with one weight for each part."""
    opening = s.features[rows, at.GRIPPER]
    opening = np.where(s.task.shut[rows], 1 - opening, opening)
    first, second = s.task.weights[rows].T
    reward = first * hamacher_product(opening, s.near[rows])
    return reward + np.where(s.held[rows], second * s.placed[rows], 0.0)


def press_behind_wall(s: StepState, rows: Index, cast: Cast) -> Array:
    """Reward approaching with a closed gripper, then opening the gripper and pressing."""
    opening = s.features[rows, at.GRIPPER]
    coming = 2 * hamacher_product((1 - opening) / 2.0, s.near[rows])
    return np.where(s.held[rows], 2 + 2 * (1 + opening) + 4 * square(s.placed[rows]), coming)


def weighted_sum(s: StepState, rows: Index, cast: Cast) -> Array:
    """Return the sum of near and placed, weighted by ``weights``, times ``factor``."""
    first, second = s.task.weights[rows].T
    return (first * s.near[rows] + second * s.placed[rows]) * s.task.factor[rows]


def both(s: StepState, rows: Index, cast: Cast) -> Any:
    """Return ``factor`` times the Hamacher product of near and placed (with ``gripper``, also the closing command)."""
    near = cast(s.near[rows])
    near = np.where(s.task.gripper[rows], hamacher_product(near, cast(s.closed[rows])), near)
    return cast(s.task.factor[rows]) * hamacher_product(near, cast(s.placed[rows]))


def slide(s: StepState, rows: Index, cast: Cast) -> Array:
    """Reward approaching, then sliding the object while the hand is low and near."""
    low = s.features[rows, terms.TCP.start + 2] <= 0.03
    return np.where(low & s.held[rows], 2 + 7 * s.placed[rows], 1.5 * s.near[rows])


def door(s: StepState, rows: Index, cast: Cast) -> Array:
    """Reward approaching the handle from above, closing the gripper, and opening the door."""
    features = s.features[rows]
    handle, angle = features[:, at.OBJECT], -features[:, at.JOINT.start]
    near = tolerance(row_norm(features[:, at.HAND] - (handle + TO_HANDLE) - BESIDE_HANDLE), 0.0, 0.06, 0.5)
    ready = hamacher_product(s.above[rows], near)
    turned = tolerance(np.pi / 2.0 + np.pi / 6 - angle, 0.0, 0.5, np.pi / 3.0)
    opened = 0.2 * (-angle < -np.pi / 90.0) + 0.8 * turned
    reward = 2.0 * hamacher_product(ready, s.effort[rows]) + 8.0 * opened
    return np.where(np.abs(handle[:, 0] - features[:, terms.GOAL.start]) <= 0.08, 10.0, reward)


def lid(s: StepState, rows: Index, cast: Cast) -> Array:
    """Reward approaching the lid from above, closing the gripper, lifting the lid and moving the lid over the box while
    keeping the lid upright."""
    ready = hamacher_product(s.above[rows], s.near[rows])
    lifted = 0.2 * (s.features[rows, at.OBJECT.stop - 1] + 0.02 > 0.04) + 0.8 * s.placed[rows]
    reward = 2.0 * hamacher_product(s.effort[rows], ready) + 8.0 * lifted
    reward = np.where(s.proximity.distance[rows, terms.VIA] < 0.08, 10.0, reward)
    return reward * turned_like(s.features[rows, at.QUATERNION], UPRIGHT, 0.2)


def turned_like(quaternion: Array, ideal: Array, margin: float) -> Array:
    """Return 1 for the ideal quaternion, decreasing linearly to 0 at a distance of ``margin``."""
    return np.maximum(1.0 - row_norm(quaternion - ideal) / margin, 0.0)


TALL = np.array([1.0, 1.0, 3.0])
LYING = np.array([1.0, 0.0, 0.0, 0.0])


def carry(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward gripping and placing the object; if the object is held, add 1 and ``bonus`` times the lift."""
    reward = hamacher_product(cast(s.grasp[rows]), cast(s.placed[rows]))
    more = 1.0 + s.task.bonus[rows] * s.lift[rows]
    carried = np.where(s.wide[rows], reward + more, reward + cast(more))
    return np.where(s.held[rows], carried, reward)


def _by_way(s: StepState, rows: Index, cast: Cast, gripped: Any) -> Any:
    """Add a reward for moving a held object first to a point at the wall, then, beyond the wall, to the goal."""
    coming = gripped + 1.0 + cast(4.0 * s.via[rows])
    going = gripped + 1.0 + 4.0 + cast(3.0 * s.placed[rows])
    carried = np.where(s.features[rows, at.OBJECT.start + 1] > 0.75, going, coming)
    return np.where(s.held[rows], carried, gripped)


def carry_over_wall(s: StepState, rows: Index, cast: Cast) -> Any:
    return _by_way(s, rows, cast, hamacher_product(cast(s.grasp[rows]), cast(s.via[rows])))


def push_round_wall(s: StepState, rows: Index, cast: Cast) -> Any:
    return _by_way(s, rows, cast, 2 * cast(s.grasp[rows]))


def push(s: StepState, rows: Index, cast: Cast) -> Any:
    reward = 2 * cast(s.grasp[rows])
    return np.where(s.held[rows], reward + (1.0 + reward + cast(5.0 * s.placed[rows])), reward)


def unplug(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward gripping the plug and, once the plug has moved 1.5 cm, pulling the plug to the goal."""
    reward = 2 * cast(s.grasp[rows])
    moved = s.features[rows, at.OBJECT.start] - s.features[rows, terms.START.start] > 0.015
    return np.where(s.held[rows] & moved, 1 + reward + cast(5 * s.placed[rows]), reward)


def sweep(s: StepState, rows: Index, cast: Cast) -> Any:
    grasp = s.grasp[rows]
    return 2 * grasp + 6 * hamacher_product(grasp, s.placed[rows])


def soccer(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward gripping and placing the ball, with a penalty if the ball crosses the goal line outside the goal."""
    ball, goal = s.features[rows, at.OBJECT], s.features[rows, terms.GOAL]
    placed, line = s.placed[rows], goal[:, 1] - 0.1
    missed = (ball[:, 1] > line) & (np.abs(ball[:, 0] - goal[:, 0]) > 0.1)
    beyond = 2 * ((ball[:, 1] - line) / (1 - line))
    placed = np.where(missed, limited(placed - beyond, 0.0, 1.0), placed)
    return 3 * s.grasp[rows] + 6.5 * placed


def _with_tool(s: StepState, rows: Index, cast: Cast, placed: Array, upright: Array) -> Any:
    """Reward gripping and placing a tool, scaled by how well the tool is oriented."""
    turned = turned_like(s.features[rows, at.QUATERNION], upright, 0.4)
    return (2.0 * cast(s.grasp[rows]) + cast(6.0 * placed)) * cast(turned)


def peg(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward moving the ring over the peg from above, then down."""
    ring = s.features[rows, at.PLACE]
    error = s.features[rows, terms.GOAL] - ring
    radius = row_norm(error[:, :2])
    on_peg = (radius < 0.02) & (error[:, 2] > 0.0)
    rim = np.where(on_peg, 0.02, 0.01)
    height = np.where(radius > rim, 0.02 * np.log(radius - rim) + 0.2, 0.0)
    error[:, 2] = height - ring[:, 2]
    lifted = (ring[:, 2] > 0.02) | (radius < rim)
    placed = 0.1 * lifted + 0.9 * tolerance(row_norm(error * TALL), 0.0, 0.02, 0.4)
    return np.where(on_peg, 10.0, _with_tool(s, rows, cast, placed, UPRIGHT))


def unpeg(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward lifting the ring off the peg."""
    features = s.features[rows]
    placed = 0.1 * (features[:, at.PLACE.start + 2] > 0.02) + 0.9 * s.placed[rows]
    off_peg = features[:, at.OBJECT.start + 2] > features[:, terms.GOAL.start + 2]
    return np.where(off_peg, 10.0, _with_tool(s, rows, cast, placed, UPRIGHT))


def hammer(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward moving the hammer's head to the nail and driving in the nail."""
    features = s.features[rows]
    placed = 0.1 * (features[:, at.OBJECT.start + 2] > 0.02) + 0.9 * s.placed[rows]
    reward = _with_tool(s, rows, cast, placed, LYING)
    return np.where((features[:, at.JOINT.start] > 0.09) & (reward > 5.0), 10.0, reward)


def stick_push(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward gripping the stick and pushing the container to the goal with the stick."""
    carried = 2.0 + 5.0 * s.via[rows] + 3.0 * s.placed[rows]
    carried = np.where(s.proximity.distance[rows, terms.PLACED] <= 0.12, 10.0, carried)
    return np.where(s.held[rows], carried, cast(s.grasp[rows]))


def stick_pull(s: StepState, rows: Index, cast: Cast) -> Any:
    """Reward gripping the stick, putting the stick through the handle, and pulling the container to the goal."""
    features = s.features[rows]
    stick, handle = features[:, at.OBJECT], features[:, at.SECOND]
    end, goal = features[:, at.PLACE], features[:, terms.GOAL]
    gripped = hamacher_product(cast(s.grasp[rows]), cast(s.via[rows]))
    reward = np.where(s.held[rows], 1.0 + gripped + cast(5.0 * s.via[rows]), gripped)
    aside = np.abs(end - handle)
    through = s.held[rows] & (end[:, 0] >= handle[:, 0]) & (aside[:, 1] <= 0.04) & (aside[:, 2] <= 0.06)
    if not through.any():
        return reward
    at_goal = tolerance(row_norm(stick - goal), 0.0, 0.05, row_norm(features[:, terms.START] - goal))
    pulled = 1.0 + gripped + 5.0 + 2.0 * at_goal + 1.0 * s.placed[rows]
    pulled = np.where(row_norm(handle - goal) <= 0.12, 10.0, pulled)
    return np.where(through, pulled, reward)


FORMULAS: dict[str, Formula] = {
    "sum": weighted_sum,
    **_by_name(
        *(reach, press, press_behind_wall, both, slide, door, lid, carry, carry_over_wall, push, push_round_wall),
        *(unplug, sweep, soccer, peg, unpeg, hammer, stick_push, stick_pull),
    ),
}


def over_funnel(s: StepState, rows: Index) -> None:
    """Set the lift so that the hand must approach from above and stay above the funnel's floor."""
    s.lift[rows] = hamacher_product(s.above[rows], s.placed[rows])


def into_box(s: StepState, rows: Index) -> None:
    """Reduce the lift while the peg's head is in one of two regions of the box where the head would collide."""
    features = s.features[rows]
    head = features[:, at.PLACE]
    zero_1, one_1, zero_2, one_2 = features[:, at.CORNERS].reshape(-1, 4, 3).transpose(1, 0, 2)
    (first, in_first), (second, in_second) = _within_prism(head, zero_1, one_1), _within_prism(head, zero_2, one_2)
    s.placed[rows] = s.lift[rows] = hamacher_product(s.placed[rows], hamacher_product(second, first))
    s.narrow[rows] &= ~(in_first | in_second)  # in Meta-World, a NumPy number makes these rewards double precision


def _within_prism(point: Array, zero: Array, one: Array) -> tuple[Array, Any]:
    """Return the product of a point's relative positions along the axes of a box (1 if outside), and whether the point
    is inside the box."""
    inside = ((np.minimum(zero, one) <= point) & (point <= np.maximum(zero, one))).all(axis=1)
    x, y, z = ((point - zero) / (one - zero)).T
    return np.where(inside, x * y * z, 1.0), inside


def onto_shelf(s: StepState, rows: Index) -> None:
    """Reduce the lift if the object is in front of the shelf and below the board; set the lift to 0 under the board."""
    features = s.features[rows]
    goal, placed = features[:, terms.GOAL], s.placed[rows]
    x, y, z = features[:, at.OBJECT].T
    low = (z > 0.0) & (z < 0.24) & (goal[:, 0] - 0.15 < x) & (x < goal[:, 0] + 0.15)
    edge = goal[:, 1] - 3 * 0.05
    before, under = low & (edge < y) & (y < goal[:, 1]), low & (y > goal[:, 1])
    loss = hamacher_product((y - edge) / (3 * 0.05), (0.24 - z) / 0.24)
    lift = np.where(before, limited(placed - loss, 0.0, 1.0), placed)
    s.lift[rows] = np.where(under, 0.0, lift)
    s.wide[rows] = before


LIFTS: dict[str, Callable[[StepState, Index], None]] = _by_name(over_funnel, into_box, onto_shelf)


FULL_REWARD = 10.0


class EpisodeStarts:
    """The values from the first state of each row's episode that the rewards depend on."""

    def __init__(self, rewards: Sequence[TaskReward]) -> None:
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
        features = terms.gather_features(task, sensors, observation[:, at.CURRENT], goal, points)
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
        near, opening = proximity.distance[:, terms.NEAR], features[:, at.GRIPPER]
        height = features[np.arange(len(features)), at.OBJECT.start + task.held.lifted_axis]
        moved = proximity.margin[:, terms.PLACED] - proximity.distance[:, terms.PLACED]
        held = (near < task.held.near) & (near <= task.held.within)
        held &= (opening > task.held.opened) & (opening >= task.held.opened_from) & (opening < task.held.opened_under)
        return held & (height - task.held.lifted > features[:, terms.START.stop - 1]) & (moved > task.held.moved)
