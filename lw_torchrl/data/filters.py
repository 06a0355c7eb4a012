"""Which episodes of joined datasets to show, by how they went and who acted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lw_torchrl._checks import check_probability, unknown_name
from lw_torchrl.data.dataset import Demonstrations

_Listed = tuple[int, int, str, float, int]  # part, number in it, task, return, rows


@dataclass(frozen=True)
class EpisodeFilter:
    """Episodes to keep; those that every condition given keeps.

    An episode's return is the sum of ``("next", "reward")``, the one asked for, over the rows that are shown of it.

    Attributes:
        success: keep those that succeeded at some step, or, if False, those that did not.
        least_return: keep those whose return is at least so much.
        best: keep so large a part of each task's episodes, those of the highest return, the shorter where they tie;
            counted among those that the other conditions keep, and at least one.
        behaviours: keep those of these labels, "spoilt-30" say.

    Raises:
        ValueError, TypeError: a wrong value, by its name.

    Example:
        >>> EpisodeFilter(success=True, behaviours=("expert", "noisy")).best is None
        True
    """

    success: bool | None = None
    least_return: float | None = None
    best: float | None = None
    behaviours: tuple[str, ...] | None = None

    def __post_init__(self) -> None:
        if self.success not in (None, True, False):
            raise TypeError(f"keep: success must be True, False or None, got {self.success!r}")
        if self.best is not None and not check_probability("keep: best", self.best):
            raise ValueError("keep: best must be above 0, got 0")
        if self.least_return is not None and self.least_return != self.least_return:
            raise ValueError("keep: least_return must be a number, got nan")
        if isinstance(self.behaviours, str):
            raise TypeError(f"keep: behaviours must be a tuple of labels, got {self.behaviours!r}")
        if self.behaviours is not None:
            object.__setattr__(self, "behaviours", tuple(self.behaviours))

    def choose(self, parts: Sequence[Demonstrations], returns: Sequence[Tensor]) -> list[Demonstrations]:
        """The parts with the episodes that are kept.

        Args:
            parts: the datasets' descriptions.
            returns: of each part, the return and the rows of each episode, (E, 2) float64.

        Raises:
            ValueError: a label that no part has (with the nearest), or nothing is left of a part's task.
        """
        labels = {part.config.behaviour for part in parts}
        for label in self.behaviours or ():
            if label not in labels:
                raise unknown_name("keep: behaviours", label, sorted(labels))
        listed = [
            (part, number, episode.task, float(earned), int(rows))
            for part, (described, found) in enumerate(zip(parts, returns, strict=True))
            for number, (episode, (earned, rows)) in enumerate(zip(described.episodes, found.tolist(), strict=True))
            if self._keeps(described.config.behaviour, episode.success, earned)
        ]
        if self.best is not None:
            listed = [one for task in sorted({row[2] for row in listed}) for one in self._best(listed, task)]
        kept = {(part, number) for part, number, *_ in listed}
        if lost := sorted({e.task for part in parts for e in part.episodes} - {row[2] for row in listed}):
            raise ValueError(f"keep: {self} leaves no episode of {', '.join(lost)}")
        return [
            replace(part, episodes=tuple(e for number, e in enumerate(part.episodes) if (place, number) in kept))
            for place, part in enumerate(parts)
        ]

    def _keeps(self, behaviour: str, success: bool, earned: float) -> bool:
        return (
            (self.success is None or success is self.success)
            and (self.least_return is None or earned >= self.least_return)
            and (self.behaviours is None or behaviour in self.behaviours)
        )

    def _best(
        self, listed: list[tuple[int, int, str, float, int]], task: str
    ) -> list[tuple[int, int, str, float, int]]:
        assert self.best is not None
        ours = sorted((row for row in listed if row[2] == task), key=lambda row: (-row[3], row[4], row[0], row[1]))
        return ours[: max(1, round(self.best * len(ours)))]


def episode_returns(reward: Tensor, lengths: Sequence[int]) -> Tensor:
    """The return and the number of rows of episodes that lie one after another: (E, 2) float64.

    Args:
        reward: (R, 1) float32.
        lengths: of each episode.
    """
    rows = torch.tensor(lengths)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)
