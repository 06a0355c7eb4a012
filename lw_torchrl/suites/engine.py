"""The engine interface: a batched simulator behind :class:`~lw_torchrl.envs.LanguageWorldEnv`.

An engine simulates N environment rows, each of a fixed task, and does not use TorchRL. Observations are float64, as in
Meta-World; the environment converts them to float32, counts time steps and truncates episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class EngineStep(NamedTuple):
    """The result of one time step of all rows, in new arrays. Inactive rows repeat their last observation, with reward
    0, success False and fault False."""

    observation: NDArray[np.float64]  # (N, D), described by the layout
    reward: NDArray[np.float64]  # (N,)
    success: NDArray[np.bool_]  # (N,)
    fault: NDArray[np.bool_]  # (N,) unstable rows, which repeat their last stable observation until they are reset


@runtime_checkable
class Engine(Protocol):
    """A simulator of N parallel environments, called rows. To support camera images, an engine also implements
    ``render`` as in :class:`~lw_torchrl.suites.cameras.SeenRows`. To support recordings of the scene, it implements
    ``row_model`` and ``poses``."""

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode in each of ``rows`` and return the first observations (len(rows), D) float64. The initial
        state depends only on the task and the seed."""

    def step(self, action: NDArray[np.float32], active: NDArray[np.bool_]) -> EngineStep:
        """Step the ``active`` rows (N,) bool with ``action`` (N, A) in [-1, 1], without changing the action's dtype."""

    def close(self) -> None:
        """Free the simulators."""


def seeds_of_rows(rows: Sequence[int], seeds: Sequence[int]) -> tuple[NDArray[np.intp], dict[int, int]]:
    """Return the rows to reset as an array, and a dict from row to seed; raise a :class:`ValueError` if there are not
    as many seeds as rows."""
    index = np.asarray(rows, dtype=np.intp).reshape(-1)
    if len(index) != len(seeds):
        raise ValueError(f"seeds must hold one seed per row ({len(index)} rows), got {len(seeds)} seeds")
    return index, dict(zip(index.tolist(), map(int, seeds), strict=True))


def checked_step(
    action: Any, active: Any, started: NDArray[np.bool_], size: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Convert the actions (N, size) and the mask (N,) bool of a step to arrays. Raise a ValueError for wrong shapes,
    and a RuntimeError if an active row has not ``started``."""
    action, active, n = np.asarray(action), np.asarray(active, dtype=bool), len(started)
    if action.shape != (n, size) or active.shape != (n,):
        raise ValueError(f"action must have shape {(n, size)} and active {(n,)}, got {action.shape}, {active.shape}")
    if not started[active].all():
        row = int(np.flatnonzero(active & ~started)[0])
        raise RuntimeError(f"row {row} must be reset before the first step, and after a step that was interrupted")
    return action, active


class RowModel(NamedTuple):
    """A row's compiled MuJoCo model (read-only) and the ``path`` of the XML file. Models of the same file have the same
    meshes. Rows may share a model, so ``body_pos`` and ``site_pos`` may be those of another row."""

    path: str
    model: Any


class BodyPoses(NamedTuple):
    """Positions (bodies, 3) float64, metres in the world frame, and quaternions (bodies, 4) in w, x, y, z order."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
