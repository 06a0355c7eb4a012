"""The engine interface: what :class:`~lw_torchrl.envs.LanguageWorldEnv` asks of a simulator.

An engine holds N rows, each of a fixed task, and does not use TorchRL. Its numbers are Meta-World's own (float64
observations); the environment converts them, counts steps and truncates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray


class EngineStep(NamedTuple):
    """The result of one step of all rows, in fresh arrays; rows that were not active repeat their last observation,
    with reward 0, success False and fault False."""

    observation: NDArray[np.float64]  # (N, D), as the layout says
    reward: NDArray[np.float64]  # (N,)
    success: NDArray[np.bool_]  # (N,)
    fault: NDArray[np.bool_]  # (N,) unstable: such a row repeats its last stable observation until it is reset


@runtime_checkable
class Engine(Protocol):
    """Simulates N rows of tasks. With the ``render`` of :class:`~lw_torchrl.suites.cameras.SeenRows` it also gives
    pictures, with its ``model`` and ``poses`` recordings of the scene."""

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode in each of ``rows``, as Meta-World's own ``env.seed(seed); env.reset()`` does, whatever the
        row did before; returns the first observations, (len(rows), D) float64."""

    def step(self, action: NDArray[np.float32], active: NDArray[np.bool_]) -> EngineStep:
        """Step the rows where ``active`` (N, bool) with ``action`` (N, A) in [-1, 1], in the action's own precision."""

    def close(self) -> None:
        """Free the simulators."""


def seeds_of_rows(rows: Sequence[int], seeds: Sequence[int]) -> tuple[NDArray[np.intp], dict[int, int]]:
    """The rows to reset, as an array, and the seed of each; :class:`ValueError` if these are not as many."""
    index = np.asarray(rows, dtype=np.intp).reshape(-1)
    if len(index) != len(seeds):
        raise ValueError(f"seeds must be as many as rows, {len(index)}, got {len(seeds)}")
    return index, dict(zip(index.tolist(), map(int, seeds), strict=True))


def checked_step(
    action: Any, active: Any, started: NDArray[np.bool_], size: int
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """The actions (N, size) and the mask (N,) bool of a step, as arrays; an error for other shapes, or for a row that
    has not ``started``."""
    action, active, n = np.asarray(action), np.asarray(active, dtype=bool), len(started)
    if action.shape != (n, size) or active.shape != (n,):
        raise ValueError(
            f"action must be of shape {(n, size)} and active of {(n,)}, got {action.shape} and {active.shape}"
        )
    if not started[active].all():
        row = int(np.flatnonzero(active & ~started)[0])
        raise RuntimeError(f"row {row} must be reset before it is stepped")
    return action, active


class RowModel(NamedTuple):
    """The compiled MuJoCo model of a row, to read, and the ``path`` of its XML file; models of one file have the same
    meshes. Rows share a model, so its ``body_pos`` and ``site_pos`` may be another row's."""

    path: str
    model: Any


class BodyPoses(NamedTuple):
    """Where the bodies are: (bodies, 3) float64, metres, in the world's frame, and (bodies, 4) float64, w first."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
