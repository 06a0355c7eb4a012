"""The Numba kernel of :class:`~lw_torchrl.QueryProgram`, which needs the extra ``lw_torchrl[fast]``."""

from math import sqrt
from typing import Any

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def answer(
    observation: Any, task_id: Any, latches: Any, ids: Any, row_of: Any, ends: Any, places: Any, metres: Any, bit: Any,
    flipped: Any, gates: Any, care: Any, want: Any, constants: Any, truth: Any,
) -> bool:  # fmt: skip
    """Write each row's query results to ``truth`` (B, S) bool, with QueryProgram's operations in the same order.

    ``observation`` is (B, D) float32 or float64, in metres; ``task_id`` is (B,) int64; ``latches`` is (B, L) bool.
    ``ids`` to ``constants`` are the fields of :class:`QueryFacts`. Return False if a task has no queries or a number
    is NaN or infinite.
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
            finite &= number - number == 0  # false for NaN and infinity
        task, row = task_id[b], -1
        if 0 <= task < len(row_of):
            row = row_of[task]
        else:
            nearest = np.searchsorted(ids, task)
            if nearest < len(ids) and ids[nearest] == task:
                row = nearest
        if row < 0:
            return False
        # All integers are unsigned, since Numba promotes a mix of int64 and uint64 to float64.
        t = np.uint64(row)
        facts = np.uint64(0)
        for n in range(latches.shape[1]):
            facts |= np.uint64(latches[b, n]) << np.uint64(n)
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
            if facts & gates[c, 0] == gates[c, 1]:
                facts |= gates[c, 2]
        for q in range(care.shape[1]):
            truth[b, q] = facts & care[t, q] == want[t, q]
    return finite
