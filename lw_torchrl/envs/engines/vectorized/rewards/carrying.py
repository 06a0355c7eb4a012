"""The rewards of tasks in which an object is gripped."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.observation import row_norm
from lw_torchrl.envs.engines.vectorized.rewards.moment import Formula, Index, Moment, Weak
from lw_torchrl.envs.engines.vectorized.rewards.parameters import GOAL, PLACED, START
from lw_torchrl.envs.engines.vectorized.rewards.reaching import UPRIGHT, turned_like
from lw_torchrl.envs.engines.vectorized.rewards.terms import hamacher_product, limited, tolerance
from lw_torchrl.envs.engines.vectorized.sensors import JOINT, OBJECT, PLACE, QUATERNION, SECOND

Array = NDArray[np.float64]

TALL = np.array([1.0, 1.0, 3.0])
LYING = np.array([1.0, 0.0, 0.0, 0.0])


def carry(m: Moment, rows: Index, weak: Weak) -> Any:
    """Grip and place; where held, 1 more, and ``bonus`` times the lift."""
    reward = hamacher_product(weak(m.grasp[rows]), weak(m.placed[rows]))
    more = 1.0 + m.task.bonus[rows] * m.lift[rows]
    carried = np.where(m.wide[rows], reward + more, reward + weak(more))
    return np.where(m.held[rows], carried, reward)


def carry_over_wall(m: Moment, rows: Index, weak: Weak) -> Any:
    """By way of a point above the wall; what is beyond the wall, to the goal."""
    gripped = hamacher_product(weak(m.grasp[rows]), weak(m.via[rows]))
    rising = gripped + 1.0 + weak(4.0 * m.via[rows])
    sinking = gripped + 1.0 + 4.0 + weak(3.0 * m.placed[rows])
    carried = np.where(m.facts[rows, OBJECT.start + 1] > 0.75, sinking, rising)
    return np.where(m.held[rows], carried, gripped)


def push(m: Moment, rows: Index, weak: Weak) -> Any:
    reward = 2 * weak(m.grasp[rows])
    return np.where(m.held[rows], reward + (1.0 + reward + weak(5.0 * m.placed[rows])), reward)


def push_round_wall(m: Moment, rows: Index, weak: Weak) -> Any:
    """By way of a point beside the wall; what is beyond it, to the goal."""
    reward = 2 * weak(m.grasp[rows])
    coming = reward + 1.0 + weak(4.0 * m.via[rows])
    going = reward + 1.0 + 4.0 + weak(3.0 * m.placed[rows])
    pushed = np.where(m.facts[rows, OBJECT.start + 1] > 0.75, going, coming)
    return np.where(m.held[rows], pushed, reward)


def unplug(m: Moment, rows: Index, weak: Weak) -> Any:
    """Grip; once the plug has moved a little, pull it to the goal."""
    reward = 2 * weak(m.grasp[rows])
    moved = m.facts[rows, OBJECT.start] - m.facts[rows, START.start] > 0.015
    return np.where(m.held[rows] & moved, 1 + reward + weak(5 * m.placed[rows]), reward)


def sweep(m: Moment, rows: Index, weak: Weak) -> Any:
    grasp = m.grasp[rows]
    return 2 * grasp + 6 * hamacher_product(grasp, m.placed[rows])


def soccer(m: Moment, rows: Index, weak: Weak) -> Any:
    """Less where the ball comes to the goal line beside the goal."""
    ball, goal = m.facts[rows, OBJECT], m.facts[rows, GOAL]
    placed, line = m.placed[rows], goal[:, 1] - 0.1
    missed = (ball[:, 1] > line) & (np.abs(ball[:, 0] - goal[:, 0]) > 0.1)
    beyond = 2 * ((ball[:, 1] - line) / (1 - line))
    placed = np.where(missed, limited(placed - beyond, 0.0, 1.0), placed)
    return 3 * m.grasp[rows] + 6.5 * placed


def peg(m: Moment, rows: Index, weak: Weak) -> Any:
    """Bring the ring over the peg: far away high up, then down."""
    facts = m.facts[rows]
    ring = facts[:, PLACE]
    error = facts[:, GOAL] - ring
    radius = row_norm(error[:, :2])
    on_peg = (radius < 0.02) & (error[:, 2] > 0.0)
    rim = np.where(on_peg, 0.02, 0.01)
    height = np.where(radius > rim, 0.02 * np.log(radius - rim) + 0.2, 0.0)
    error[:, 2] = height - ring[:, 2]
    lifted = (ring[:, 2] > 0.02) | (radius < rim)
    placed = 0.1 * lifted + 0.9 * tolerance(row_norm(error * TALL), 0.0, 0.02, 0.4)
    reward = _with_tool(m, rows, weak, placed, turned_like(facts[:, QUATERNION], UPRIGHT, 0.4))
    return np.where(on_peg, 10.0, reward)


def unpeg(m: Moment, rows: Index, weak: Weak) -> Any:
    """Lift the ring from the peg."""
    facts = m.facts[rows]
    placed = 0.1 * (facts[:, PLACE.start + 2] > 0.02) + 0.9 * m.placed[rows]
    reward = _with_tool(m, rows, weak, placed, turned_like(facts[:, QUATERNION], UPRIGHT, 0.4))
    return np.where(facts[:, OBJECT.start + 2] > facts[:, GOAL.start + 2], 10.0, reward)


def hammer(m: Moment, rows: Index, weak: Weak) -> Any:
    """Bring the hammer's head to the nail, and drive it in."""
    facts = m.facts[rows]
    placed = 0.1 * (facts[:, OBJECT.start + 2] > 0.02) + 0.9 * m.placed[rows]
    reward = _with_tool(m, rows, weak, placed, turned_like(facts[:, QUATERNION], LYING, 0.4))
    return np.where((facts[:, JOINT.start] > 0.09) & (reward > 5.0), 10.0, reward)


def _with_tool(m: Moment, rows: Index, weak: Weak, placed: Array, turned: Array) -> Any:
    return (2.0 * weak(m.grasp[rows]) + weak(6.0 * placed)) * weak(turned)


def stick_push(m: Moment, rows: Index, weak: Weak) -> Any:
    """Grip the stick; held, bring it and with it the container to the goal."""
    carried = 2.0 + 5.0 * m.via[rows] + 3.0 * m.placed[rows]
    carried = np.where(m.close.distance[rows, PLACED] <= 0.12, 10.0, carried)
    return np.where(m.held[rows], carried, weak(m.grasp[rows]))


def stick_pull(m: Moment, rows: Index, weak: Weak) -> Any:
    """Grip the stick, bring it to the handle; once through it, pull the container to the goal."""
    facts = m.facts[rows]
    stick, handle, end, goal = facts[:, OBJECT], facts[:, SECOND], facts[:, PLACE], facts[:, GOAL]
    gripped = hamacher_product(weak(m.grasp[rows]), weak(m.via[rows]))
    reward = np.where(m.held[rows], 1.0 + gripped + weak(5.0 * m.via[rows]), gripped)
    aside = np.abs(end - handle)
    through = m.held[rows] & (end[:, 0] >= handle[:, 0]) & (aside[:, 1] <= 0.04) & (aside[:, 2] <= 0.06)
    if not through.any():
        return reward
    at_goal = tolerance(row_norm(stick - goal), 0.0, 0.05, row_norm(facts[:, START] - goal))
    pulled = 1.0 + gripped + 5.0 + 2.0 * at_goal + 1.0 * m.placed[rows]
    pulled = np.where(row_norm(handle - goal) <= 0.12, 10.0, pulled)
    return np.where(through, pulled, reward)


CARRYING: dict[str, Formula] = {
    "carry": carry,
    "carry over wall": carry_over_wall,
    "push": push,
    "push round wall": push_round_wall,
    "unplug": unplug,
    "sweep": sweep,
    "soccer": soccer,
    "peg": peg,
    "unpeg": unpeg,
    "hammer": hammer,
    "stick push": stick_push,
    "stick pull": stick_pull,
}
