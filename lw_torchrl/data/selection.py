"""Which episodes of which datasets a replay buffer shows, and which of their rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._checks import check_fields, check_int, check_probability, check_text, shown, unknown_name
from lw_torchrl.data.dataset import CollectConfig, Demonstrations, EpisodeInfo
from lw_torchrl.data.memory_map import damaged, load_rows
from lw_torchrl.data.passes import spans
from lw_torchrl.data.rewards import REWARDS, RewardName
from lw_torchrl.language.value_checks import finite


@dataclass(frozen=True)
class EpisodeFilter:
    """Which episodes to keep: those that meet every condition given.

    An episode's return is the sum of the requested ``("next", "reward")`` over the rows that are shown of it.

    Attributes:
        success: keep those that succeeded at some step, or, if False, those that did not.
        least_return, behaviours: keep those with at least this return; those of these labels, "spoilt-30" say.
        best: of those that meet the other conditions, the fraction of each task's episodes to keep, at least one, those
            of the highest return, the shorter at a tie.
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
"""All episodes; the first so many of each task; or, for each task to take, the first so many or these."""


def choose_episodes(found: Demonstrations, chosen: EpisodeChoice, argument: str = "episodes") -> Demonstrations:
    """A dataset's description with only the chosen episodes, in the dataset's order."""
    if chosen is None:
        return found
    there: dict[str, list[int]] = {}
    for episode in found.episodes:
        there.setdefault(episode.task, []).append(episode.episode)
    if not isinstance(chosen, Mapping) and not hasattr(chosen, "__index__"):
        raise TypeError(f"{argument} must be None, a number, or a mapping of task names, got {chosen!r}")
    wanted = chosen if isinstance(chosen, Mapping) else dict.fromkeys(there, chosen)
    if not wanted:
        raise ValueError(f"{argument} must name at least one task, got an empty mapping")
    keep: set[tuple[str, int]] = set()
    for task, some in wanted.items():
        if task not in there:
            raise unknown_name(f"{argument}: task", task, there)
        place = f"{argument}[{task!r}]"
        if hasattr(some, "__index__"):
            if (number := check_int(place, some, minimum=1)) > len(there[task]):
                raise ValueError(f"{place}: the dataset has {len(there[task])} episodes of {task!r}, got {number}")
            numbers = there[task][:number]
        elif isinstance(some, Sequence) and not isinstance(some, str):
            numbers = [check_int(place, number) for number in some]
        else:
            raise TypeError(f"{place} must be a number or a list of episodes, got {some!r}")
        if odd := sorted(set(numbers) - set(there[task])):
            held, asked = shown(there[task])[1:-1], shown(odd)[1:-1]
            raise ValueError(f"{place}: the dataset holds the episodes {held}, got {asked}")
        if not numbers or len(set(numbers)) != len(numbers):
            raise ValueError(f"{place} must name at least one episode, each once, got {list(numbers)}")
        keep |= {(task, number) for number in numbers}
    return replace(found, episodes=tuple(e for e in found.episodes if (e.task, e.episode) in keep))


def _kept(episodes: Sequence[EpisodeInfo], after: int | None) -> tuple[Tensor, Tensor]:
    """The rows up to ``after`` steps past each episode's first success, and how many these are of each episode."""
    cuts = [e.length if after is None or e.first_success is None else e.first_success + after for e in episodes]
    shown = [min(e.length, cut) for e, cut in zip(episodes, cuts, strict=True)]
    starts, lengths = (torch.tensor(some, dtype=torch.int64) for some in ([e.start for e in episodes], shown))
    return spans(starts, lengths), lengths


def returns_of(whole: Demonstrations, chosen: Demonstrations, reward: RewardName, after: int | None) -> Tensor:
    """The return and the number of rows, (E, 2) float64, of the chosen episodes up to ``after`` steps past success."""
    rows, (kept, lengths) = load_rows(whole).get("next"), _kept(chosen.episodes, after)
    made = REWARDS[reward]
    return episode_returns(made.of(rows.get(f"reward_{made.source}")[kept], rows.get("success")[kept]), lengths)


def read_part(
    whole: Demonstrations, chosen: Demonstrations, label: Label, reward: RewardName, after: int | None, terminate: bool
) -> tuple[TensorDictBase, Tensor | None]:
    """All rows of a dataset, memory-mapped, and which of them to show: (n,) int64, None for all. Columns that differ
    from the files are in memory: rewards, and ends of episodes that are cut short."""
    rows = load_rows(whole)
    if label == "executed":
        rows = rows.clone(recurse=False)
        made = REWARDS[reward]
        source, success = rows.get(("next", f"reward_{made.source}")), rows.get(("next", "success"))
        rows.set(("next", "reward"), made.of(source, success))
    else:
        taken, other = ("expert_action", "unclipped_action")[:: 1 if label == "expert" else -1]
        rows = rows.exclude("next", "action", other).rename_key_(taken, "action")
    if not finite(rows.get("action")):
        raise damaged(f"an action in {str(whole.root)!r} is no finite number, for label={label!r}")
    if chosen.episodes == whole.episodes and after is None:
        return rows, None
    kept, lengths = _kept(chosen.episodes, after)
    if label == "executed" and after is not None:
        last = kept[lengths.cumsum(0) - 1]
        ends = {"done": last, "truncated": last}
        if terminate:
            succeeds = rows.get(("next", "success"))[last].reshape(-1)
            ends |= {"truncated": last[~succeeds], "terminated": last[succeeds]}
        for key, where in ends.items():
            flag = rows.get(("next", key)).clone()
            flag[last], flag[where] = False, True
            rows.set(("next", key), flag)
    return rows, kept


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
