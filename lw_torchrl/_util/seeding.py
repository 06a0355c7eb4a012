"""Random numbers of an episode: a function of (purpose, task, seed, episode), for every room."""

from hashlib import blake2b

import numpy as np

from lw_torchrl._util.checks import Natural, check_value
from lw_torchrl.language.tasks import Task, get_task


def episode_hash(purpose: str, task: str | Task, seed: int, episode: int) -> int:
    """A stable number in [0, 2**63), different for each purpose, task, seed and episode."""
    name = task if isinstance(task, str) and "/" in task else get_task(task).name  # another suite's need not be here
    text = f"lw_torchrl/{purpose}/{name}/{check_value('seed', seed, int)}/{check_value('episode', episode, Natural)}"
    return int.from_bytes(blake2b(text.encode(), digest_size=8).digest(), "little") >> 1


def episode_generator(purpose: str, task: str | Task, seed: int, episode: int) -> np.random.Generator:
    """A new generator of an episode, for one purpose."""
    return np.random.Generator(np.random.Philox(episode_hash(purpose, task, seed, episode)))
