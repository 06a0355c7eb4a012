"""Which episodes of which datasets a replay buffer shows, and which of their rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor

from lw_torchrl._checks import check_fields, check_int, check_probability, check_text, unknown_name
from lw_torchrl.data.dataset import CollectConfig, DamagedDatasetError, Demonstrations, EpisodeInfo
from lw_torchrl.data.memory_map import load_rows
from lw_torchrl.data.rewards import REWARDS, RewardName
from lw_torchrl.data.storage import DEMONSTRATION, TRAJECTORY
from lw_torchrl.language.value_checks import finite

_Listed = tuple[int, int, str, float, int]  # part, number in it, task, return, rows


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
    """This fraction of a task's episodes, by return and then length; at least one."""
    ours = sorted(listed, key=lambda row: (-row[3], row[4], row[0], row[1]))
    return ours[: max(1, round(part * len(ours)))]


def episode_returns(reward: Tensor, lengths: Sequence[int]) -> Tensor:
    """The return and the number of rows of consecutive episodes: (E, 2) float64, of rewards (R, 1) float32."""
    rows = torch.tensor(lengths, dtype=torch.int64)
    total = torch.zeros(len(rows), dtype=torch.float64)
    total.index_add_(0, torch.repeat_interleave(rows), reward.reshape(-1).double())
    return torch.stack((total, rows.double()), -1)


Label = Literal["expert", "unclipped", "executed"]
LABELS = get_args(Label)
EpisodeChoice = int | Mapping[str, int | Sequence[int]] | None
"""All episodes; the first so many of each task; or, for each task to take, the first so many or these."""


def choose_episodes(found: Demonstrations, chosen: EpisodeChoice, argument: str = "episodes") -> Demonstrations:
    """A dataset's description with only the chosen episodes, in the dataset's order."""
    if chosen is None:
        return found
    there: dict[str, list[int]] = {}
    for episode in found.episodes:
        there.setdefault(episode.task, []).append(episode.episode)
    wanted: dict[str, int | Sequence[int]]
    if isinstance(chosen, Mapping):
        wanted = dict(chosen)
    elif hasattr(chosen, "__index__"):
        wanted = dict.fromkeys(there, chosen)
    else:
        raise TypeError(f"{argument} must be None, a number, or a mapping of task names, got {chosen!r}")
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
            raise ValueError(f"{place}: the dataset holds the episodes {_listed(there[task])}, got {_listed(odd)}")
        if not numbers or len(set(numbers)) != len(numbers):
            raise ValueError(f"{place} must name at least one episode, each once, got {list(numbers)}")
        keep |= {(task, number) for number in numbers}
    return replace(found, episodes=tuple(e for e in found.episodes if (e.task, e.episode) in keep))


def _listed(numbers: list[int]) -> str:
    return ", ".join(map(str, numbers[:20])) + (", ..." if len(numbers) > 20 else "")


def _lengths(episodes: Sequence[EpisodeInfo], after: int | None) -> list[int]:
    """The rows of each episode up to ``after`` steps past its first success."""
    return [
        e.length if after is None or e.first_success is None else min(e.length, e.first_success + after)
        for e in episodes
    ]


def _kept(episodes: Sequence[EpisodeInfo], after: int | None) -> tuple[Tensor, Tensor]:
    """The rows up to ``after`` steps past each episode's first success, and the last of them of each episode."""
    starts = torch.tensor([episode.start for episode in episodes], dtype=torch.int64)
    lengths = torch.tensor(_lengths(episodes, after), dtype=torch.int64)
    before = lengths.cumsum(0) - lengths
    rows = torch.repeat_interleave(starts - before, lengths) + torch.arange(int(lengths.sum()))
    return rows, starts + lengths - 1


def returns_of(whole: Demonstrations, chosen: Demonstrations, reward: RewardName, after: int | None) -> Tensor:
    """The return and the number of rows, (E, 2) float64, of the chosen episodes up to ``after`` steps past success."""
    rows, (kept, _) = load_rows(whole), _kept(chosen.episodes, after)
    made = REWARDS[reward]
    source, success = (rows.get(("next", key))[kept] for key in (f"reward_{made.source}", "success"))
    return episode_returns(made.of(source, success), _lengths(chosen.episodes, after))


def read_part(
    whole: Demonstrations,
    chosen: Demonstrations,
    *,
    label: Label,
    reward: RewardName,
    after_success: int | None,
    terminate_on_success: bool = False,
    first_trajectory: int = 0,
    behaviour: int = 0,
) -> tuple[TensorDictBase, Tensor | None]:
    """All rows of a dataset, memory-mapped, and which of them to show: (n,) int64, None for all. Columns that differ
    from the files are in memory: ends of episodes that are cut short, rewards, ids, ``behaviour``."""
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
        raise DamagedDatasetError(
            f"root: an action in {str(whole.root)!r} is no finite number, for label={label!r}; the same "
            "collect_demonstrations keeps the episodes that are whole and collects the others again"
        )
    if first_trajectory:
        rows.set(TRAJECTORY, rows.get(TRAJECTORY) + first_trajectory)
    rows.set("behaviour", torch.full(rows.batch_size, behaviour))
    rows.set(DEMONSTRATION, torch.ones(rows.batch_size, dtype=torch.bool))
    after = 0 if terminate_on_success else after_success
    if chosen.episodes == whole.episodes and after is None:
        return rows, None
    kept, last = _kept(chosen.episodes, after)
    if label == "executed" and after is not None:
        ends = {"done": last, "truncated": last}
        if terminate_on_success:
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
