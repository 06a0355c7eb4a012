"""Which episode each row of a round is in, and how the first of each went."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

_MOST_EPISODES = 1_000_000


class FirstEpisodes:
    """Which trajectory each row of a round is in, and how the first episode of each went."""

    def __init__(self, rows: int) -> None:
        self._episode = torch.zeros(rows, dtype=torch.int64)
        self._ended = 0
        self._success = torch.full((rows,), torch.nan)

    def ids(self, round_number: int) -> Tensor:
        """(N,) int64, of each row's trajectory: no two in a training are the same."""
        rows = len(self._episode)
        return (round_number * _MOST_EPISODES + self._episode) * rows + torch.arange(rows)

    def note(self, step: TensorDictBase) -> None:
        """Look at a step of all rows."""
        done, success = (step.get(("next", name)).squeeze(-1) for name in ("done", "success"))
        first = done & (self._episode == 0)
        self._success = torch.where(first, success.to(torch.float32), self._success)
        self._episode = self._episode + done
        self._ended += int(done.sum())

    def result(self) -> dict[str, float]:
        ended = {"episodes": float(self._ended)}
        return ended if self._success.isnan().any() else {"success": float(self._success.double().mean()), **ended}
