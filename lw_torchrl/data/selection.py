"""Select the episodes and rows that a replay buffer exposes."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from lw_torchrl._util.checks import Count, Probability, check_choice, check_value, shown, typed_fields
from lw_torchrl._util.files import AnyPath
from lw_torchrl.data.dataset import CollectConfig, Demonstrations, EpisodeInfo, load_rows, read_metadata, verify
from lw_torchrl.data.rewards import REWARDS, RewardName, episode_returns


@typed_fields
@dataclass(frozen=True)
class EpisodeFilter:
    """A filter that keeps the episodes that satisfy all given conditions (None stands for no condition).

    An episode's return is the sum of the buffer's ``("next", "reward")`` over the episode's selected rows.

    Attributes:
        success: True to keep episodes that succeeded at any time step, False to keep failed episodes.
        least_return: the minimum return of an episode.
        behaviours: labels of the episodes to keep, for example "noisy-30".
        best: the fraction of each task's remaining episodes to keep (at least one), by highest return and then by
            fewest rows.
        else_best: the fraction of all episodes of a task to keep, ranked as for ``best``, if none of the task's
            episodes satisfies the conditions; None to raise an error.

    Example:
        >>> EpisodeFilter(success=True, behaviours=("expert", "noisy")).best is None
        True
    """

    success: bool | None = None
    least_return: float | None = None
    best: Probability | None = None
    behaviours: tuple[str, ...] | None = None
    else_best: Probability | None = None

    def choose(self, parts: Sequence[Demonstrations], returns: Sequence[Tensor]) -> list[Demonstrations]:
        """Return parts with only the kept episodes, given the return and length (E, 2) of the parts' episodes."""
        labels = {part.config.behaviour for part in parts}
        for label in self.behaviours or ():
            check_choice("keep: behaviours", label, sorted(labels))
        listed = [
            (place, episode, total, rows)
            for place, (part, returns_of_part) in enumerate(zip(parts, returns, strict=True))
            for episode, (total, rows) in zip(part.episodes, returns_of_part.tolist(), strict=True)
        ]
        chosen: set[tuple[int, EpisodeInfo]] = set()
        empty = []
        for task in sorted({episode.task for _, episode, *_ in listed}):
            of_task = [row for row in listed if row[1].task == task]
            left, share = [row for row in of_task if self._keeps(parts[row[0]], *row[1:3])], self.best
            if not left and self.else_best is not None:
                left, share = of_task, self.else_best
            if share is not None:  # keep the highest returns, and the shorter episodes at a tie
                left = sorted(left, key=lambda row: (-row[2], row[3]))[: max(1, round(share * len(left)))]
            chosen |= {row[:2] for row in left}
            if not left:
                empty.append(task)
        if empty:
            raise ValueError(f"keep: {self} leaves no episode of {', '.join(empty)}; relax the filter or set else_best")
        return [
            replace(part, episodes=tuple(episode for episode in part.episodes if (place, episode) in chosen))
            for place, part in enumerate(parts)
        ]

    def _keeps(self, part: Demonstrations, episode: EpisodeInfo, total: float) -> bool:
        return (
            (self.success is None or episode.success == self.success)
            and (self.least_return is None or total >= self.least_return)
            and (self.behaviours is None or part.config.behaviour in self.behaviours)
        )


Label = Literal["expert", "unclipped", "executed"]
EpisodeChoice = int | Mapping[str, int | Sequence[int]] | None
"""A choice of episodes: None for all, a number N for the first N of each task, or a mapping from each
task to use to a number N or a list of episode indices.
"""


def episodes_by_task(dataset: Demonstrations) -> dict[str, list[int]]:
    existing: dict[str, list[int]] = {}
    for episode in dataset.episodes:
        existing.setdefault(episode.task, []).append(episode.episode)
    return existing


def choose_episodes(dataset: Demonstrations, choice: EpisodeChoice, argument: str = "episodes") -> Demonstrations:
    """Return a dataset's description with only the chosen episodes, in the order of the dataset."""
    if choice is None:
        return dataset
    existing = episodes_by_task(dataset)
    choices = choice if isinstance(choice, Mapping) else dict.fromkeys(existing, choice)
    if not choices:
        raise ValueError(f"{argument} must choose at least one episode, got {shown(choice)}")
    keep: set[tuple[str, int]] = set()
    for task, wanted in choices.items():
        of_task, place = existing[check_choice(f"{argument}: task", task, existing)], f"{argument}[{task!r}]"
        numbers = list(wanted) if isinstance(wanted, Sequence) else of_task[: check_value(place, wanted, Count)]
        is_short = not isinstance(wanted, Sequence) and len(numbers) < wanted
        if is_short or not numbers or len({*numbers}) < len(numbers) or not {*numbers} <= {*of_task}:
            allowed = f"a number up to {len(of_task)}, or distinct episodes in {shown(of_task)}"
            raise ValueError(f"{place} must be {allowed}, got {shown(wanted)}")
        keep |= {(task, number) for number in numbers}
    return replace(dataset, episodes=tuple(e for e in dataset.episodes if (e.task, e.episode) in keep))


def kept_rows(episodes: Sequence[EpisodeInfo], after: int | None) -> tuple[Tensor, Tensor]:
    """Return the indices of rows up to ``after`` steps after each first success, and the number of rows per episode."""
    cuts = [e.length if after is None or e.first_success is None else e.first_success + after for e in episodes]
    starts = torch.tensor([e.start for e in episodes], dtype=torch.int64)
    lengths = torch.tensor([min(e.length, cut) for e, cut in zip(episodes, cuts, strict=True)], dtype=torch.int64)
    # The index of a kept row is its position among the kept rows plus an offset that depends on its episode.
    moved = torch.repeat_interleave(starts - lengths.cumsum(0) + lengths, lengths)
    return torch.arange(len(moved)) + moved, lengths


def returns_of(whole: Demonstrations, chosen: Demonstrations, reward: RewardName, after: int | None) -> Tensor:
    """Return each chosen episode's return and number of rows, (E, 2) float64.

    Rows more than ``after`` time steps after an episode's first success are ignored; None keeps all rows.
    """
    rows, (kept, lengths) = load_rows(whole).get("next"), kept_rows(chosen.episodes, after)
    kind = REWARDS[reward]
    return episode_returns(kind.of(rows.get(f"reward_{kind.source}")[kept], rows.get("success")[kept]), lengths)


def check_behaviours(parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` if datasets use the same label for different behaviours."""
    acts: dict[str, Any] = {}
    for part, label in ((part, part.config.behaviour) for part in parts):
        if acts.setdefault(label, part.config.policy.acts) != part.config.policy.acts:
            raise ValueError(f"root: the label {label!r} in {str(part.root)!r} is another behaviour in other folders")


def select(
    root: AnyPath | Iterable[AnyPath],
    episodes: EpisodeChoice | Sequence[EpisodeChoice],
    keep: EpisodeFilter | None,
    label: Label,
    reward: RewardName,
    after: int | None,
    check: bool,
) -> tuple[list[Demonstrations], list[Demonstrations]]:
    """Return two descriptions of each dataset: with all episodes, and with only the selected episodes.

    See :func:`load_demonstrations` for the arguments.
    """
    is_single = isinstance(root, (str, os.PathLike))
    folders: list[Any] = [root] if is_single else list(root)  # type: ignore[arg-type]
    choices: Any = [episodes] if is_single else [None] * len(folders) if episodes is None else episodes
    if not folders or (episodes is None and len({Path(folder).resolve() for folder in folders}) < len(folders)):
        raise ValueError(f"root must be a folder, or a list of distinct folders, got {folders}")
    if not isinstance(choices, Sequence) or len(choices) != len(folders):
        raise ValueError(f"episodes must be a list of {len(folders)} choices, one for each folder, got {episodes!r}")
    datasets = [read_metadata(folder) for folder in folders]
    others = ", ".join(sorted({each.config.behaviour for each in datasets if each.config.policy.kind != "expert"}))
    if others and label != "executed":
        raise ValueError(f"label={label!r} needs an expert, but {others!r} collected the dataset; use label='executed'")
    check_behaviours(datasets)
    sizes = {(dataset.config.layout.size, dataset.config.layout.action_size) for dataset in datasets}
    if len(sizes) > 1:
        raise ValueError(f"root: all folders must have the same observation and action sizes, got {sizes}")
    parts = [
        choose_episodes(dataset, choice, "episodes" if is_single else f"episodes[{number}]")
        for number, (dataset, choice) in enumerate(zip(datasets, choices, strict=True))
    ]
    for dataset, part in zip(datasets, parts, strict=True) if check else ():
        verify(dataset, part.episodes)
    if keep is not None:
        returns = [returns_of(dataset, part, reward, after) for dataset, part in zip(datasets, parts, strict=True)]
        parts = keep.choose(parts, returns)
    return datasets, parts


@dataclass(frozen=True)
class JoinedConfig:
    """The configs of joined datasets (``parts``), and for each dataset the chosen ``episodes`` by task name."""

    parts: tuple[CollectConfig, ...]
    episodes: tuple[dict[str, list[int]], ...]

    def to_json(self) -> dict[str, Any]:
        return {"parts": [part.to_json() for part in self.parts], "episodes": list(self.episodes)}


@dataclass(frozen=True)
class JoinedDemonstrations:
    """The episodes that a replay buffer selects from one or more datasets; ``parts`` describes each dataset."""

    parts: tuple[Demonstrations, ...]

    @property
    def episodes(self) -> tuple[EpisodeInfo, ...]:
        """The episodes in the order of the rows; ``start`` and ``length`` refer to the dataset of each episode."""
        return tuple(episode for part in self.parts for episode in part.episodes)

    @property
    def num_steps(self) -> int:
        """The number of rows in these episodes, before rows after a success are dropped."""
        return sum(part.num_steps for part in self.parts)

    @property
    def config(self) -> JoinedConfig:
        chosen = tuple(episodes_by_task(part) for part in self.parts)
        return JoinedConfig(tuple(part.config for part in self.parts), chosen)
