"""The engine interface: a batched simulator behind :class:`~lw_torchrl.envs.LanguageWorldEnv`.

An engine simulates N rows, each of a fixed task, without TorchRL. Observations are float64, as in Meta-World; the
environment converts them to float32, counts time steps and truncates episodes.
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


class RowModel(NamedTuple):
    """A row's compiled MuJoCo model (read-only) and the ``path`` of the XML file. Models of the same file have the same
    meshes. Rows may share a model, so ``body_pos`` and ``site_pos`` may be those of another row."""

    path: str
    model: Any


class BodyPoses(NamedTuple):
    """Positions (bodies, 3) float64, metres in the world frame, and quaternions (bodies, 4) in w, x, y, z order."""

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]
