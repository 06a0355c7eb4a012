"""Selection of the episodes and rows that a replay buffer shows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from lw_torchrl._util.checks import Count, Probability, check_value, shown, typed_fields, unknown_name
from lw_torchrl.data.dataset import CollectConfig, Demonstrations, EpisodeInfo
from lw_torchrl.data.memory_map import load_rows
from lw_torchrl.data.storage import REWARDS, RewardName


@typed_fields
@dataclass(frozen=True)
class EpisodeFilter:
    """Keeps the episodes that meet every given condition.

    An episode's return is the sum of the buffer's ``("next", "reward")`` over the rows that are shown of it.

    Attributes:
        success: keep episodes that succeeded at some step, or, if False, those that did not.
        least_return, behaviours: keep episodes of at least this return; of these labels, "spoilt-30" for example.
        best: the fraction of each task's remaining episodes to keep, at least one: those of the highest return, the
            shorter at a tie.
        else_best: for a task without an episode that meets the conditions, the fraction of all its episodes to keep,
            chosen as for ``best``; None for an error.

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
        for name in ("best", "else_best"):
            if (part := getattr(self, name)) is not None and not check_value(f"keep: {name}", part, Probability):
                raise ValueError(f"keep: {name} must be above 0, got 0")
        if self.behaviours is not None:
            if isinstance(self.behaviours, str) or not isinstance(self.behaviours, Iterable):
                raise TypeError(f"keep: behaviours must be a list of labels, got {self.behaviours!r}")
            object.__setattr__(self, "behaviours", tuple(self.behaviours))
            for label in self.behaviours:
                check_value("keep: behaviours", label, str)
            if not self.behaviours:
                raise ValueError("keep: behaviours must hold at least one label, got none")

    def choose(self, parts: Sequence[Demonstrations], returns: Sequence[Tensor]) -> list[Demonstrations]:
        """The parts with the episodes that are kept, by the return and the rows of each, (E, 2) float64 a part."""
        labels = {part.config.behaviour for part in parts}
        for label in self.behaviours or ():
            if label not in labels:
                raise unknown_name("keep: behaviours", label, sorted(labels))
        listed = [
            (place, episode, earned, rows)
            for place, (part, found) in enumerate(zip(parts, returns, strict=True))
            for episode, (earned, rows) in zip(part.episodes, found.tolist(), strict=True)
        ]
        chosen: set[tuple[int, EpisodeInfo]] = set()
        lost = []
        for task in sorted({episode.task for _, episode, *_ in listed}):
            ours = [row for row in listed if row[1].task == task]
            left, share = [row for row in ours if self._keeps(parts[row[0]], *row[1:3])], self.best
            if not left and self.else_best is not None:
                left, share = ours, self.else_best
            if share is not None:  # the highest returns, and the shorter at a tie
                left = sorted(left, key=lambda row: (-row[2], row[3]))[: max(1, round(share * len(left)))]
            chosen |= {row[:2] for row in left}
            if not left:
                lost.append(task)
        if lost:
            raise ValueError(f"keep: {self} leaves no episode of {', '.join(lost)}")
        return [
            replace(part, episodes=tuple(episode for episode in part.episodes if (place, episode) in chosen))
            for place, part in enumerate(parts)
        ]

    def _keeps(self, part: Demonstrations, episode: EpisodeInfo, earned: float) -> bool:
        return (
            (self.success is None or episode.success == self.success)
            and (self.least_return is None or earned >= self.least_return)
            and (self.behaviours is None or part.config.behaviour in self.behaviours)
        )


def episode_returns(reward: Tensor, lengths: Sequence[int] | Tensor) -> Tensor:
    """The return and the number of rows of consecutive episodes: (E, 2) float64, of rewards (R, 1) float32."""
    rows = torch.as_tensor(lengths, dtype=torch.int64)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)


Label = Literal["expert", "unclipped", "executed"]
EpisodeChoice = int | Mapping[str, int | Sequence[int]] | None
"""None for all; the number of first episodes of each task; or, for each task to use, such a number or the indices."""


def choose_episodes(dataset: Demonstrations, chosen: EpisodeChoice, argument: str = "episodes") -> Demonstrations:
    """A dataset's description with only the chosen episodes, in the dataset's order."""
    if chosen is None:
        return dataset
    existing: dict[str, list[int]] = {}
    for episode in dataset.episodes:
        existing.setdefault(episode.task, []).append(episode.episode)
    choices = chosen if isinstance(chosen, Mapping) else dict.fromkeys(existing, chosen)
    keep: set[tuple[str, int]] = set()
    for task, choice in choices.items():
        if task not in existing:
            raise unknown_name(f"{argument}: task", task, existing)
        place = f"{argument}[{task!r}]"
        if isinstance(choice, Sequence) and not isinstance(choice, str):
            numbers = list(choice)
        elif check_value(place, choice, Count) > len(existing[task]):
            raise ValueError(f"{place}: the dataset has {len(existing[task])} episodes of {task!r}, got {choice}")
        else:
            numbers = existing[task][:choice]
        if odd := sorted(set(numbers) - set(existing[task])):
            episodes, missing = shown(existing[task])[1:-1], shown(odd)[1:-1]
            raise ValueError(f"{place}: the dataset holds the episodes {episodes}, got {missing}")
        if not numbers or len(set(numbers)) < len(numbers):
            raise ValueError(f"{place} must name at least one episode, each once, got {shown(numbers)}")
        keep |= {(task, number) for number in numbers}
    if not keep:
        raise ValueError(f"{argument} must choose at least one episode, got {shown(chosen)}")
    return replace(dataset, episodes=tuple(e for e in dataset.episodes if (e.task, e.episode) in keep))


def _spans(first: Tensor, count: Tensor) -> Tensor:
    """``count[g]`` places from ``first[g]`` on, group after group: (count.sum(),) int64."""
    group = torch.repeat_interleave(count)
    return torch.arange(len(group)) + (first - count.cumsum(0) + count)[group]


def kept_rows(episodes: Sequence[EpisodeInfo], after: int | None) -> tuple[Tensor, Tensor]:
    """The rows up to ``after`` steps past each episode's first success, and how many these are of each episode."""
    cuts = [e.length if after is None or e.first_success is None else e.first_success + after for e in episodes]
    shown = [min(e.length, cut) for e, cut in zip(episodes, cuts, strict=True)]
    starts, lengths = (torch.tensor(some, dtype=torch.int64) for some in ([e.start for e in episodes], shown))
    return _spans(starts, lengths), lengths


def returns_of(whole: Demonstrations, chosen: Demonstrations, reward: RewardName, after: int | None) -> Tensor:
    """The return and the number of rows, (E, 2) float64, of the chosen episodes up to ``after`` steps past success."""
    rows, (kept, lengths) = load_rows(whole).get("next"), kept_rows(chosen.episodes, after)
    made = REWARDS[reward]
    return episode_returns(made.of(rows.get(f"reward_{made.source}")[kept], rows.get("success")[kept]), lengths)


@dataclass(frozen=True)
class JoinedConfig:
    """How the ``parts`` of joined demonstrations were collected; and for each, task name to chosen ``episodes``."""

    parts: tuple[CollectConfig, ...]
    episodes: tuple[dict[str, list[int]], ...]

    def to_json(self) -> dict[str, Any]:
        return {"parts": [part.to_json() for part in self.parts], "episodes": list(self.episodes)}


@dataclass(frozen=True)
class JoinedDemonstrations:
    """Chosen episodes of one or more datasets, as a replay buffer joins them; ``parts`` describe these."""

    parts: tuple[Demonstrations, ...]

    @property
    def episodes(self) -> tuple[EpisodeInfo, ...]:
        """The episodes in the order of the rows; ``start`` and ``length`` are as in their own dataset."""
        return tuple(episode for part in self.parts for episode in part.episodes)

    @property
    def num_steps(self) -> int:
        """The number of rows of these episodes, before any are dropped."""
        return sum(part.num_steps for part in self.parts)

    @property
    def config(self) -> JoinedConfig:
        chosen: list[dict[str, list[int]]] = []
        for part in self.parts:
            chosen.append({})
            for episode in part.episodes:
                chosen[-1].setdefault(episode.task, []).append(episode.episode)
        return JoinedConfig(tuple(part.config for part in self.parts), tuple(chosen))


def check_label(label: str, parts: Sequence[Demonstrations]) -> None:
    """Raise if the label needs an expert's actions, and another policy acted."""
    others = sorted({part.config.behaviour for part in parts if part.config.policy.kind != "expert"})
    if others and label != "executed":
        needs = f"label={label!r} needs an expert's actions, but this dataset was collected by {', '.join(others)!r}"
        raise ValueError(f"{needs}; use label='executed'")


def check_behaviours(parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` if two behaviours have the same label."""
    first: dict[str, Demonstrations] = {}
    for part in parts:
        before = first.setdefault(part.config.behaviour, part)
        if before.config.policy.acts != part.config.policy.acts:
            folders = f"{str(before.root)!r} and {str(part.root)!r}"
            raise ValueError(f"root: {part.config.behaviour!r} names different behaviours in {folders}")
