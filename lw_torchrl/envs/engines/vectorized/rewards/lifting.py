"""How well a held object is on its way to the goal, where there is more to it than the distance."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.rewards.moment import Index, Moment
from lw_torchrl.envs.engines.vectorized.rewards.parameters import GOAL
from lw_torchrl.envs.engines.vectorized.rewards.terms import hamacher_product, limited
from lw_torchrl.envs.engines.vectorized.sensors import CORNERS, OBJECT, PLACE

Array = NDArray[np.float64]


def over_funnel(m: Moment, rows: Index) -> None:
    """The hand is to come from above, and to stay so."""
    m.lift[rows] = hamacher_product(m.above[rows], m.placed[rows])


def into_box(m: Moment, rows: Index) -> None:
    """The peg's head counts as less placed within two corners of the box, where it would collide."""
    facts = m.facts[rows]
    head = facts[:, PLACE]
    zero_1, one_1, zero_2, one_2 = facts[:, CORNERS].reshape(-1, 4, 3).transpose(1, 0, 2)
    (first, in_first), (second, in_second) = _within_prism(head, zero_1, one_1), _within_prism(head, zero_2, one_2)
    m.placed[rows] = m.lift[rows] = hamacher_product(m.placed[rows], hamacher_product(second, first))
    m.narrow[rows] &= ~(in_first | in_second)  # a NumPy number then, to which single precision gives way


def _within_prism(point: Array, zero: Array, one: Array) -> tuple[Array, Any]:
    """Within a box, the product of how far the point is along each axis; 1 outside. And whether it is within."""
    inside = ((np.minimum(zero, one) <= point) & (point <= np.maximum(zero, one))).all(axis=1)
    x, y, z = ((point - zero) / (one - zero)).T
    return np.where(inside, x * y * z, 1.0), inside


def onto_shelf(m: Moment, rows: Index) -> None:
    """In front of the shelf and below its board the object counts as less placed, under the board as not at all."""
    facts = m.facts[rows]
    thing, goal, placed = facts[:, OBJECT], facts[:, GOAL], m.placed[rows]
    x, y, z = thing.T
    low = (z > 0.0) & (z < 0.24) & (goal[:, 0] - 0.15 < x) & (x < goal[:, 0] + 0.15)
    edge = goal[:, 1] - 3 * 0.05
    before, under = low & (edge < y) & (y < goal[:, 1]), low & (y > goal[:, 1])
    loss = hamacher_product((y - edge) / (3 * 0.05), (0.24 - z) / 0.24)
    lift = np.where(before, limited(placed - loss, 0.0, 1.0), placed)
    m.lift[rows] = np.where(under, 0.0, lift)
    m.wide[rows] = before


LIFTS: dict[str, Callable[[Moment, Index], None]] = {
    "over funnel": over_funnel,
    "into box": into_box,
    "onto shelf": onto_shelf,
}
