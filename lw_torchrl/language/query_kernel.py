"""The compiled path of :class:`~lw_torchrl.QueryProgram`: one pass over a batch; needs Numba, ``lw_torchrl[fast]``."""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def answer(
    observation: Any,
    row: Any,
    ends: Any,
    places: Any,
    metres: Any,
    bit: Any,
    flipped: Any,
    conjunction: Any,
    care: Any,
    want: Any,
    constants: Any,
    truth: Any,
) -> bool:
    """Write the truth of each row's queries, with the operations of the tables, in their order.

    Args:
        observation: (B, 39) float32 or float64, metres.
        row: (B,) uint64, of the tables that follow, those of :class:`QueryFacts` in its order.
        truth: (B, S) bool, written.

    Returns:
        Whether the observation holds finite numbers.
    """
    size = observation.shape[1]
    numbers = np.empty(size + constants.shape[0], observation.dtype)
    for i in range(constants.shape[0]):
        numbers[size + i] = constants[i]
    finite = True
    for b in range(observation.shape[0]):
        for i in range(size):
            number = observation[b, i]
            numbers[i] = number
            finite &= number - number == 0
        t = row[b]
        facts = np.uint64(0)
        for a in range(ends[t, 0], ends[t, 1]):
            x = numbers[places[a, 0]] - numbers[places[a, 1]] + metres[a, 0]
            y = numbers[places[a, 2]] - numbers[places[a, 3]] + metres[a, 1]
            z = numbers[places[a, 4]] - numbers[places[a, 5]] + metres[a, 2]
            length = sqrt(x * x + y * y + z * z) * metres[a, 3]
            facts |= np.uint64(length < metres[a, 4]) << bit[a]
        for a in range(ends[t, 1], ends[t, 2]):
            coordinate = numbers[places[a, 0]] - numbers[places[a, 1]] + metres[a, 0]
            facts |= np.uint64(coordinate < metres[a, 4]) << bit[a]
        facts ^= flipped[t]
        for c in range(ends[t, 3], ends[t, 4]):
            if facts & conjunction[c, 0] == conjunction[c, 0]:
                facts |= conjunction[c, 1]
        for q in range(care.shape[1]):
            truth[b, q] = facts & care[t, q] == want[t, q]
    return finite
