"""The engine interface: a batched simulator behind :class:`~lw_torchrl.envs.LanguageWorldEnv`.

An engine simulates N rows, each of a fixed task, without TorchRL. Its observations are float64 as Meta-World's; the
environment converts them, counts steps and truncates episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class EngineStep(NamedTuple):
    """The result of one step of all rows, in new arrays. Rows that were not active repeat their last observation, with
    reward 0, success False and fault False."""

    observation: NDArray[np.float64]  # (N, D), as the layout says
    reward: NDArray[np.float64]  # (N,)
    success: NDArray[np.bool_]  # (N,)
    fault: NDArray[np.bool_]  # (N,) unstable simulations, which repeat their last stable observation until a reset


@runtime_checkable
class Engine(Protocol):
    """A simulator of N rows. Camera images need the ``render`` of :class:`~lw_torchrl.suites.cameras.SeenRows` too, and
    recordings of the scene its ``model`` and ``poses``."""

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode in each of ``rows``, which depends only on the seed; return the first observations,
        (len(rows), D) float64."""

    def step(self, action: NDArray[np.float32], active: NDArray[np.bool_]) -> EngineStep:
        """Step the rows that are ``active``, (N,) bool, with ``action`` (N, A) in [-1, 1], in the action's dtype."""

    def close(self) -> None:
        """Free the simulators."""


def seeds_of_rows(rows: Sequence[int], seeds: Sequence[int]) -> tuple[NDArray[np.intp], dict[int, int]]:
    """Return the rows to reset as an array, and the seed of each row; raise :class:`ValueError` if lengths differ."""
    index = np.asarray(rows, dtype=np.intp).reshape(-1)
    if len(index) != len(seeds):
        raise ValueError(f"seeds must be as many as rows, {len(index)}, got {len(seeds)}")
    return index, dict(zip(index.tolist(), map(int, seeds), strict=True))


def checked_step(
    action: Any, active: Any, started: NDArray[np.bool_], size: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Return the actions (N, size) and the mask (N,) bool of a step as arrays; raise for other shapes, or for an active
    row that has not ``started``."""
    action, active, n = np.asarray(action), np.asarray(active, dtype=bool), len(started)
    if action.shape != (n, size) or active.shape != (n,):
        raise ValueError(f"action must have shape {(n, size)} and active {(n,)}, got {action.shape}, {active.shape}")
    if not started[active].all():
        row = int(np.flatnonzero(active & ~started)[0])
        raise RuntimeError(f"row {row} must be reset before it is stepped")
    return action, active


class RowModel(NamedTuple):
    """The compiled MuJoCo model of a row, for reading, and the ``path`` of its XML file; models of one file have the
    same meshes. Rows may share a model, so its ``body_pos`` and ``site_pos`` may be those of another row."""

    path: str
    model: Any


class BodyPoses(NamedTuple):
    """Positions of bodies, (bodies, 3) float64, metres in the world's frame; quaternions, (bodies, 4), w first."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
