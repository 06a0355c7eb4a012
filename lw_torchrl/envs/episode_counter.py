"""Which episode each row runs next: counted by row and worker, or the one that was asked for."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._checks import check_int
from lw_torchrl.envs.seeding import episode_seed
from lw_torchrl.language.tasks import Task

Rows = NDArray[np.intp]
Episodes = NDArray[np.int64]


def check_worker(worker: Any) -> tuple[int, int]:
    """Return ``worker`` as (rank, of) with 0 <= rank < of."""
    if not isinstance(worker, Sequence) or isinstance(worker, str) or len(worker) != 2:
        raise TypeError(f"worker must be a pair (rank, of), got {worker!r}")
    of = check_int("worker's of", worker[1], minimum=1)
    rank = check_int("worker's rank", worker[0], minimum=0)
    if rank >= of:
        raise ValueError(f"worker's rank must be under the number of workers, {of}, got {rank}")
    return rank, of


def stated_episode(tensordict: TensorDictBase | None, episode: int | Tensor | None) -> Tensor:
    """The episode that ``reset(tensordict, set_state=True)`` goes to; without one, or with another beside it, a
    ValueError."""
    if episode is not None:
        raise ValueError("episode and set_state=True each name an episode: give one of them")
    if tensordict is None or (episode := tensordict.get("episode", None)) is None:
        raise ValueError(
            "set_state=True needs episode in the tensordict; a TransformedEnv does not hand it down: "
            "reset(episode=tensordict['episode'])"
        )
    return episode


class EpisodeCounter:
    """The m-th reset of the r-th of a task's R rows in the w-th of W workers is episode (m·W + w)·R + r.

    So W environments of R rows run what one of W·R rows would.

    Args:
        tasks: the task of each row, in turn over the different ones.
        seed: with task and episode it fixes every reset.
        worker: (w, W).
    """

    def __init__(self, tasks: Sequence[Task], seed: int, worker: tuple[int, int]) -> None:
        self.tasks = tuple(tasks)
        self.names = [task.name for task in tasks]
        n = len(set(self.names))
        self.seed = seed
        self.resets = np.zeros(len(tasks), dtype=np.int64)
        rows = np.arange(len(tasks))
        self._rank, copies = rows // n, np.bincount(rows % n)[rows % n]
        self._first, self._stride = worker[0] * copies + self._rank, worker[1] * copies

    def start_again(self, seed: int | None) -> None:
        """Begin at the first episode, of another seed if one is given."""
        if seed is not None:
            self.seed = check_int("seed", seed)
        self.resets[:] = 0

    def next(self, rows: Rows) -> Episodes:
        """The episodes that come next in ``rows``."""
        return (self.resets * self._stride + self._first)[rows]

    def asked(self, episode: int | Tensor, rows: Rows) -> Episodes:
        """The episodes asked for in ``rows``: one integer for all, or an int64 tensor (N,) with one for each."""
        n = len(self.names)
        if isinstance(episode, Tensor) and (
            episode.shape not in ((), (n,)) or episode.dtype not in (torch.int64, torch.int32)
        ):
            raise ValueError(
                f"episode must be an integer, or int64 of shape ({n},), one for each row, got {episode.dtype} of "
                f"shape {tuple(episode.shape)}"
            )
        if not isinstance(episode, Tensor):
            episode = torch.tensor(check_int("episode", episode))
        found = episode.expand(n).cpu().numpy().astype(np.int64)[rows]
        if (found < 0).any():
            raise ValueError(f"episode must be at least 0, got {found.min()}")
        return found

    def seeds(self, rows: Rows, episodes: Episodes) -> list[int]:
        """The simulator's seed of each row's episode."""
        return [
            episode_seed(self.tasks[row], self.seed, int(episode)) for row, episode in zip(rows, episodes, strict=True)
        ]

    def dump(self) -> Tensor:
        """Tasks, seed and counters as JSON in a tensor (bytes,) uint8."""
        state = {"tasks": self.names, "seed": self.seed, "resets": self.resets.tolist()}
        return torch.frombuffer(bytearray(json.dumps(state).encode()), dtype=torch.uint8)

    def load(self, dumped: Tensor) -> None:
        """Take seed and counters from :meth:`dump` of an environment with the same tasks in its rows."""
        try:
            state = json.loads(dumped.cpu().numpy().tobytes())
            names, seed, resets = state["tasks"], check_int("seed", state["seed"]), np.array(state["resets"], np.int64)
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"state_dict is none of a LanguageWorldEnv: {error!r}") from error
        if names != self.names:
            raise ValueError(
                f"state_dict is of an environment with other rows, {len(names)}: {_few(names)}; this one has "
                f"{len(self.names)}: {_few(self.names)}"
            )
        if resets.shape != self.resets.shape or (resets < 0).any():
            raise ValueError(f"state_dict must count the resets of {len(self.names)} rows, got {state['resets']}")
        self.seed, self.resets = seed, resets


def _few(names: Sequence[str]) -> str:
    return ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
