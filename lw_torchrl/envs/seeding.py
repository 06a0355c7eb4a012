"""Randomness that hangs on what it is for: (task, seed, episode), never on where or when it runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._seeding import episode_generator, episode_hash
from lw_torchrl.language.tasks import Task


def episode_seed(task: str | Task, seed: int, episode: int) -> int:
    """The seed of one episode: a stable hash, so that no two (task, seed, episode) share their randomness.

    Args:
        task: a task's name, "pick-place"; for a task of one's own, the Task.
        seed: the environment's seed, any integer.
        episode: index of the episode, from 0.

    Returns:
        An integer in [0, 2**63), for Meta-World's ``env.seed``.

    Raises:
        ValueError: the task is unknown or the episode negative.

    Example:
        >>> episode_seed("reach", 0, 0) == episode_seed("reach", 0, 0)
        True
        >>> episode_seed("reach", 0, 1) == episode_seed("reach", 1, 0)
        False
    """
    return episode_hash("episode", task, seed, episode)


def action_noise(task: str | Task, seed: int, episode: int, steps: int, hold: int = 1) -> NDArray[np.float32]:
    """Standard normal noise for the actions of one episode, (steps, 4) float32, the same wherever it is drawn; each
    draw is kept for ``hold`` steps."""
    draws = episode_generator("noise", task, seed, episode).standard_normal((-(-steps // hold), 4), dtype=np.float32)
    return draws.repeat(hold, axis=0)[:steps]
