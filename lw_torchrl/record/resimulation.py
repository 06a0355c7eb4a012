"""A rollout simulated again: what its actions did to the bodies, which no rollout holds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.envs.engines.vectorized.engine import VectorizedEngine
from lw_torchrl.envs.seeding import episode_seed
from lw_torchrl.record.mujoco_scene import Motion


class Difference(NamedTuple):
    """Where a rollout and its simulation first differ.

    Attributes:
        step: the step of the episode, from 0.
        entry: which number of the observation is furthest off there.
        by: how far.
    """

    step: int
    entry: int
    by: float


def simulate_again(
    task: str, seed: int, episode: int, action: NDArray[np.float32], observation: NDArray[np.float32]
) -> Motion | Difference:
    """The motion of all bodies in an episode, of T + 1 rows, or where it turns out to be another episode.

    The simulation depends on the seed and the actions alone, so equal observations, bit for bit, mean equal motion.

    Args:
        task: one of the 50.
        seed, episode: the environment's seed and the episode's index.
        action: T×4 float32 in [-1, 1], as executed.
        observation: T×39 float32, each row that from which its action was taken.

    Example:
        >>> found = simulate_again("reach", 0, 0, np.zeros((1, 4), np.float32), np.zeros((1, 39), np.float32))
        >>> found.step
        0
    """
    engine = VectorizedEngine([task], num_threads=1)
    try:
        first = engine.reset([0], [episode_seed(task, seed, episode)])[0]
        poses = engine.poses(0)
        length = len(action)
        positions = np.empty((length + 1, *poses.position.shape), np.float32)
        quaternions = np.empty((length + 1, *poses.quaternion.shape), np.float32)
        seen = first.astype(np.float32)
        active = np.ones(1, bool)
        for step in range(length):
            if not np.array_equal(seen, observation[step]):
                off = np.abs(seen.astype(np.float64) - observation[step])
                return Difference(step, int(off.argmax()), float(off.max()))
            positions[step], quaternions[step] = poses
            seen = engine.step(action[step : step + 1], active).observation[0].astype(np.float32)
            poses = engine.poses(0)
        positions[length], quaternions[length] = poses
        return Motion(engine.model(0), positions, quaternions)
    finally:
        engine.close()
