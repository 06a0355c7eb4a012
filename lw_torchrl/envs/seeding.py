"""Randomness that hangs on what it is for: (task, seed, episode), never on where or when it runs."""

from __future__ import annotations

from hashlib import blake2b

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._checks import check_int
from lw_torchrl.language.tasks import Task, get_task


def _hash(purpose: str, task: str | Task, seed: int, episode: int) -> int:
    name = get_task(task).name
    text = f"lw_torchrl/{purpose}/{name}/{check_int('seed', seed)}/{check_int('episode', episode, minimum=0)}"
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


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
    return _hash("episode", task, seed, episode)


def episode_generator(purpose: str, task: str | Task, seed: int, episode: int) -> np.random.Generator:
    """A generator of an episode's own for a purpose, at its beginning; other purposes draw from others."""
    return np.random.Generator(np.random.Philox(_hash(purpose, task, seed, episode)))


def action_noise(task: str | Task, seed: int, episode: int, steps: int, hold: int = 1) -> NDArray[np.float32]:
    """Standard normal noise for the actions of one episode, (steps, 4) float32, the same wherever it is drawn; each
    draw is kept for ``hold`` steps."""
    draws = episode_generator("noise", task, seed, episode).standard_normal((-(-steps // hold), 4), dtype=np.float32)
    return draws.repeat(hold, axis=0)[:steps]
