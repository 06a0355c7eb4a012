"""The engine interface: what :class:`~lw_torchrl.envs.LanguageWorldEnv` asks of a simulator.

An engine holds N rows, each of one task for life, and knows nothing of TorchRL. It works in Meta-World's own
numbers (float64 observations); the environment above converts, counts steps and truncates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.observation import ACTION_SIZE, OBSERVATION_SIZE

__all__ = ["ACTION_SIZE", "OBSERVATION_SIZE", "BodyPoses", "Engine", "EngineStep", "Pictured", "Posed", "RowModel"]


class EngineStep(NamedTuple):
    """What one step of all rows gave. Every array is the caller's to keep: an engine returns fresh ones.

    Attributes:
        observation: (N, 39) float64, Meta-World's vector (metres; gripper opening in [0, 1]; quaternions).
        reward: (N,) float64; Meta-World's dense reward, or the success as 0 and 1.
        success: (N,) bool, Meta-World's success at this step.
        fault: (N,) bool, true where the simulation became unstable; such a row repeats its last stable
            observation and wants a reset.

    Rows that were not active repeat their last observation, with reward 0, success False and fault False.
    """

    observation: NDArray[np.float64]
    reward: NDArray[np.float64]
    success: NDArray[np.bool_]
    fault: NDArray[np.bool_]


class Engine(Protocol):
    """Simulates N rows of Meta-World tasks."""

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> NDArray[np.float64]:
        """Start an episode in each of ``rows``, as ``env.seed(seed); env.reset()`` of Meta-World's own
        environment does, whatever the row did before.

        Returns:
            (len(rows), 39) float64, the first observations.
        """
        ...

    def step(self, action: NDArray[np.float32], active: NDArray[np.bool_]) -> EngineStep:
        """Step the rows where ``active`` (N, bool) with ``action`` (N, 4), each number in [-1, 1].

        The arithmetic is done in the action's own precision, as Meta-World's is.
        """
        ...

    def close(self) -> None:
        """Free the simulators."""
        ...


class Pictured(Engine, Protocol):
    """An engine that can also be looked at, as ``LanguageWorldEnv.render`` wants it."""

    def render(self, rows: Sequence[int], *, camera: str, height: int, width: int) -> NDArray[np.uint8]:
        """Pictures of the rows as they are now: (len(rows), height, width, 3) uint8, the first line on top."""
        ...


class RowModel(NamedTuple):
    """The compiled MuJoCo model of a row, to be looked at.

    Attributes:
        path: its XML file; models of one file have the same geoms and meshes.
        model: the MjModel. Rows share it, so its ``body_pos`` and ``site_pos`` may be another row's.
    """

    path: str
    model: Any


class BodyPoses(NamedTuple):
    """Where the bodies of a row are; the arrays are the caller's to keep.

    Attributes:
        position: (bodies, 3) float64, metres, of the world.
        quaternion: (bodies, 4) float64, w first.
    """

    position: NDArray[np.float64]
    quaternion: NDArray[np.float64]


class Posed(Engine, Protocol):
    """An engine whose bodies can be read, as recordings of the scene want it."""

    def model(self, row: int) -> RowModel:
        """The model of a row."""
        ...

    def poses(self, row: int) -> BodyPoses:
        """Where the bodies of a row are now, those that stand still too."""
        ...
