"""What Meta-World's rewards are made of, over arrays, with the bits of its own scalars."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Numbers = NDArray[np.floating]
"""Single or double precision: Meta-World computes with the gripper's action in the action's own."""

AT_MARGIN = 0.1  # what a margin away from the bounds gives
LONG_TAIL = np.sqrt(1 / AT_MARGIN - 1)
GAUSSIAN = np.sqrt(-2 * np.log(AT_MARGIN))


def square(x: Array) -> Array:
    """The square as C's ``pow`` gives it, and so Python and NumPy for a single number; an array's ``x**2`` is
    ``x * x``, which differs in the last bit in one case out of a thousand."""
    return np.float_power(x, 2.0)


def long_tail(margins: Array) -> Array:
    """From 1 at 0 to 0.1 at 1; beyond, slowly on."""
    return 1 / (square(margins * LONG_TAIL) + 1)


def gaussian(margins: Array) -> Array:
    """From 1 at 0 to 0.1 at 1; beyond, fast to 0."""
    return np.exp(-0.5 * square(margins * GAUSSIAN))


def tolerance(x: Array, lower: Array | float, upper: Array | float, margin: Array | float) -> Array:
    """1 from ``lower`` to ``upper``, beyond a long tail; a margin of 0 is a sharp edge."""
    margins = np.where(x < lower, lower - x, x - upper) / margin
    return np.where((lower <= x) & (x <= upper), 1.0, long_tail(margins))


def hamacher_product(a: Numbers, b: Numbers) -> Numbers:
    """Both of two numbers from 0 to 1, as a number from 0 to 1."""
    product = a * b
    either = a + b - product
    return np.where(either > 0, product / either, product)


def limited(x: Numbers, low: float, high: float) -> Numbers:
    """``np.clip`` at a third of its cost for few numbers."""
    return np.minimum(np.maximum(x, low), high)
