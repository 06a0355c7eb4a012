"""Which episodes of joined datasets to show, by how they went and who acted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from lw_torchrl._checks import check_fields, check_probability, check_text, unknown_name
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
        else_best: of a task of which the conditions leave nothing, keep so large a part of all its episodes, chosen as
            for ``best``; None, for an error.

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
    else_best: float | None = None

    def __post_init__(self) -> None:
        check_fields(self, "keep: ")
        for name in ("best", "else_best"):
            if (part := getattr(self, name)) is not None and not check_probability(f"keep: {name}", part):
                raise ValueError(f"keep: {name} must be above 0, got 0")
        if self.behaviours is None:
            return
        if isinstance(self.behaviours, str) or not isinstance(self.behaviours, Iterable):
            raise TypeError(f"keep: behaviours must be a tuple of labels, got {self.behaviours!r}")
        object.__setattr__(self, "behaviours", tuple(self.behaviours))
        for label in self.behaviours:
            check_text("keep: behaviours", label)
        if not self.behaviours:
            raise ValueError("keep: behaviours must hold at least one label, got none")

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
        ]
        chosen = []
        for task in sorted({row[2] for row in listed}):
            ours = [row for row in listed if row[2] == task]
            left = [row for row in ours if self._keeps(parts[row[0]], row[1], row[3])]
            if not left and self.else_best is not None:
                chosen += _best(ours, self.else_best)
            else:
                chosen += left if self.best is None else _best(left, self.best)
        kept = {(part, number) for part, number, *_ in chosen}
        if lost := sorted({row[2] for row in listed} - {row[2] for row in chosen}):
            raise ValueError(f"keep: {self} leaves no episode of {', '.join(lost)}")
        return [
            replace(part, episodes=tuple(e for number, e in enumerate(part.episodes) if (place, number) in kept))
            for place, part in enumerate(parts)
        ]

    def _keeps(self, part: Demonstrations, number: int, earned: float) -> bool:
        return (
            (self.success is None or part.episodes[number].success == self.success)
            and (self.least_return is None or earned >= self.least_return)
            and (self.behaviours is None or part.config.behaviour in self.behaviours)
        )


def _best(listed: list[_Listed], part: float) -> list[_Listed]:
    """So large a part of a task's episodes, the highest returns and then the shortest first; one at least of any."""
    ours = sorted(listed, key=lambda row: (-row[3], row[4], row[0], row[1]))
    return ours[: max(1, round(part * len(ours)))]


def episode_returns(reward: Tensor, lengths: Sequence[int]) -> Tensor:
    """The return and the number of rows of episodes that lie one after another: (E, 2) float64.

    Args:
        reward: (R, 1) float32.
        lengths: of each episode.
    """
    rows = torch.tensor(lengths, dtype=torch.int64)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)
