"""Describe rows for the Numba kernel: the addresses in MuJoCo's states that the kernel reads and writes."""

import os
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from threading import get_ident
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.suites.metaworld.observation import REWARD_WIDTH, Array, Index, Mask

ROW = np.dtype(
    [
        ("model", np.int64),  # addresses of MuJoCo's mjModel and mjData
        ("data", np.int64),
        ("substeps", np.int64),
        ("looks_ahead", np.int64),  # whether the next step may reuse this step's mj_forward
        ("looked", np.int64),  # whether mj_forward was called on the current state
        ("looks", np.int64),  # whether a step ends with mj_forward
        ("has_matrix", np.int64),  # whether to compute the outputs QUATERNION from the outputs MATRIX
        ("inputs", np.int64),  # number of inputs, which are written before the first substep
        ("zeros", np.int64),  # number of values that are set to zero after the last substep
        ("outputs", np.int64),  # number of outputs, which are read at the end
        ("warnings", np.int64),  # number of warning counts; a changed count means that the simulation is unstable
        ("inputs_at", np.int64, 9),  # addresses of float64
        ("zeros_at", np.int64, 2),
        ("outputs_at", np.int64, REWARD_WIDTH),
        ("warnings_at", np.int64, 3),  # addresses of int32
        ("seconds", np.float64),  # the time that the last step took
    ]
)
"""The dtype of a row's record, which the compiled kernel reads."""


def addresses_of(*arrays: NDArray[Any]) -> list[int]:
    """Return the address of each element of the arrays."""
    found: list[int] = []
    for array in arrays:
        interface = array.__array_interface__
        step = (interface["strides"] or (array.itemsize,))[0]
        found += range(interface["data"][0], interface["data"][0] + step * len(array), step)
    return found


@cache
def find_row_kernel() -> ModuleType | None:
    """Return the module of the Numba kernel. If it cannot be compiled here, warn and return None."""
    try:
        if os.environ.get("NUMBA_DISABLE_JIT", "0") != "0":
            raise ImportError("NUMBA_DISABLE_JIT is set")
        from lw_torchrl.suites.metaworld import row_kernel
    except Exception as error:  # too new a Numba can raise any error; the results are the same without Numba
        warnings.warn(
            f"engine: the simulation runs in Python threads, which are slower than compiled code, because Numba cannot "
            f"be used ({type(error).__name__}: {error}); pip install 'lw_torchrl[fast]', and set NUMBA_CACHE_DIR to a "
            "writable folder if no cache folder is found",
            stacklevel=2,
        )
        return None
    return row_kernel


class CompiledRows:
    """The rows of an engine, simulated by the Numba kernel.

    Args:
        kernel: the module :mod:`~lw_torchrl.suites.metaworld.row_kernel`.
        rows: objects whose ``describe()`` returns a dict with the fields of :data:`ROW`. ``model`` is the MjModel, and
            ``places`` are the row's own positions of bodies and sites, if they differ from the model's.
        groups: lists of rows that should run one after another, because they read the same model.
    """

    def __init__(self, kernel: Any, rows: Sequence[Any], groups: Sequence[Sequence[int]]) -> None:
        self._kernel, self._rows = kernel, list(rows)
        self._models: list[NDArray[np.int64]] = []
        self._group = np.zeros(len(rows), np.intp)
        for number, group in enumerate(groups):
            self._group[list(group)] = number
        self._table = np.zeros(len(rows), ROW)
        for row, described in zip(rows, self._table, strict=True):
            fields = row.describe()
            model, places = fields.pop("model"), fields.pop("places", None)
            described["model"] = model._address
            if places is not None:
                self._models.append(kernel.model_with_places(model, places))
                described["model"] = self._models[-1].ctypes.data
            for name in ("inputs", "zeros", "outputs", "warnings"):
                addresses = fields.pop(f"{name}_at")
                described[f"{name}_at"][: len(addresses)] = addresses
                described[name] = len(addresses)
            for name, value in fields.items():
                described[name] = value

    def forget(self, rows: Index) -> None:
        """Prevent the next step of these rows, which were reset, from reusing the last step's ``mj_forward``."""
        self._table["looked"][rows] = False

    def simulate(
        self, rows: Index, inputs: Array, outputs: Array, run: Callable[[Callable[[], object], int], None]
    ) -> Mask:
        """Simulate rows with inputs (rows, K); fill outputs (rows, W) and return whether the rows are stable (rows,).

        ``run(call, helpers)`` runs ``call`` in this thread and in at most ``helpers`` other threads. In this thread,
        ``call`` returns when all rows are done.
        """
        group = self._group[rows]
        seconds = np.bincount(group, self._table["seconds"][rows]) / np.maximum(np.bincount(group), 1)
        order = np.argsort(-seconds[group], kind="stable")  # the slowest group first
        stable, counts = np.zeros(len(rows), dtype=bool), np.zeros(2, np.int64)
        handler, caller = self._kernel.leave_mujoco.address, get_ident()

        def simulate() -> None:  # refers to self, which keeps MuJoCo's states alive for busy threads
            waits = get_ident() == caller
            self._kernel.simulate(handler, self._table, rows, order, counts, inputs, outputs, stable, waits)

        run(simulate, len(rows) - 1)
        return stable
