"""The episode that each row runs next, and random numbers of episodes, which depend only on (task, seed, episode)."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lw_torchrl._util.checks import Natural, check_value, shown
from lw_torchrl._util.files import parse_json
from lw_torchrl._util.reproducibility import episode_generator, episode_hash
from lw_torchrl.language.tasks import Task


def episode_seed(task: str | Task, seed: int, episode: int) -> int:
    """Return an episode's seed for Meta-World's ``env.seed``, in [0, 2**63): a stable hash of (task, seed, episode).

    The task is a name, such as "pick-place", or a custom :class:`Task`.

    Example:
        >>> episode_seed("reach", 0, 1) == episode_seed("reach", 1, 0)
        False
    """
    return episode_hash("episode", task, seed, episode)


def action_noise(
    task: str | Task, seed: int, episode: int, steps: int, hold: int = 1, size: int = 4
) -> NDArray[np.float32]:
    """Return standard normal noise for an episode's actions, (steps, size) float32, held for ``hold`` time steps."""
    generator = episode_generator("noise", task, seed, episode)
    draws = generator.standard_normal((-(-steps // hold), size), dtype=np.float32)
    return draws.repeat(hold, axis=0)[:steps]


Rows = NDArray[np.intp]
Episodes = NDArray[np.int64]


class EpisodeCounter:
    """Counters of the episodes that the rows of a :class:`LanguageWorldEnv` run, in worker w of W (``worker``)."""

    def __init__(self, tasks: Sequence[Task], seed: int, worker: tuple[int, int]) -> None:
        self.tasks = tuple(tasks)
        self.names = [task.name for task in tasks]
        n = len(set(self.names))
        self.seed = seed
        self.resets = np.zeros(len(tasks), dtype=np.int64)
        rows = np.arange(len(tasks))
        # The r-th of a task's R rows in worker w of W runs the episodes w·R + r, then every (W·R)-th after it.
        self._rank, copies = rows // n, np.bincount(rows % n)[rows % n]
        self._first, self._stride = worker[0] * copies + self._rank, worker[1] * copies

    def start_again(self, seed: int | None) -> None:
        """Restart at the first episode, with a new seed unless ``seed`` is None."""
        if seed is not None:
            self.seed = seed
        self.resets[:] = 0

    def next(self, rows: Rows) -> Episodes:
        return (self.resets * self._stride + self._first)[rows]

    def requested(self, episode: int | Tensor, rows: Rows) -> Episodes:
        """Return the requested episodes of ``rows``; ``episode`` is an integer for all rows or an int64 tensor (N,)."""
        n = len(self.names)
        if isinstance(episode, Tensor):
            if episode.shape not in ((), (n,)) or episode.dtype not in (torch.int64, torch.int32):
                got = f"{episode.dtype} of shape {tuple(episode.shape)}"
                raise ValueError(f"episode must be an integer, or int64 of shape ({n},), one for each row, got {got}")
        elif check_value("episode", episode, Natural) >= 2**63:
            raise ValueError(f"episode must be below 2**63, got {shown(episode)}")
        episodes = torch.as_tensor(episode).expand(n).cpu().numpy().astype(np.int64)[rows]
        if (episodes < 0).any():
            raise ValueError(f"episode must be at least 0, got {episodes.min()}")
        return episodes

    def seeds(self, rows: Rows, episodes: Episodes) -> list[int]:
        return [
            episode_seed(self.tasks[row], self.seed, int(episode)) for row, episode in zip(rows, episodes, strict=True)
        ]

    def dump(self) -> Tensor:
        """Return tasks, seed and counters as a tensor of JSON bytes (n,) uint8."""
        state = {"tasks": self.names, "seed": self.seed, "resets": self.resets.tolist()}
        return torch.frombuffer(bytearray(json.dumps(state).encode()), dtype=torch.uint8)

    def load(self, dumped: Tensor) -> None:
        """Restore seed and counters from the :meth:`dump` of a counter with the same rows."""
        state = parse_json(dumped.cpu().numpy().tobytes())
        if state["tasks"] != self.names:
            rows, own_rows = (f"{len(names)} rows, {shown(names)}" for names in (state["tasks"], self.names))
            raise ValueError(f"state_dict belongs to an environment with other rows: {rows}; this one has {own_rows}")
        self.seed, self.resets = state["seed"], np.array(state["resets"], dtype=np.int64)
