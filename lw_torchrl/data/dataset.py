"""A demonstration dataset on disk: what its folder holds, and the metadata that say how it was made.

root/data/            TorchRL's TED layout as a memory-mapped TensorDict, one row a step
root/metadata.json    written last: without it the dataset is not finished
root/.partial/        the episodes so far, while collecting
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl._files import write_json
from lw_torchrl.language.tasks import task_id

FORMAT = "lw_torchrl.demonstrations"
FORMAT_VERSION = 2
DATA, METADATA, PARTIAL = "data", "metadata.json", ".partial"
COLUMNS: dict[tuple[str, ...], tuple[tuple[int, ...], torch.dtype]] = {
    ("observation",): ((39,), torch.float32),
    ("task_id",): ((), torch.int64),
    ("episode",): ((), torch.int64),
    ("action",): ((4,), torch.float32),
    ("expert_action",): ((4,), torch.float32),
    ("unclipped_action",): ((4,), torch.float32),
    ("collector", "traj_ids"): ((), torch.int64),
    ("next", "observation"): ((39,), torch.float32),
    ("next", "task_id"): ((), torch.int64),
    ("next", "reward_sparse"): ((1,), torch.float32),
    ("next", "reward_dense"): ((1,), torch.float32),
    **{("next", flag): ((1,), torch.bool) for flag in ("success", "done", "terminated", "truncated")},
}
_PACKAGES = ("lw_torchrl", "metaworld", "mujoco", "numpy", "tensordict", "torch", "torchrl")


class DatasetError(ValueError):
    """A folder that holds no finished dataset of this format."""


@dataclass(frozen=True)
class CollectConfig:
    """How demonstrations are made; equal configurations give equal datasets.

    Attributes:
        tasks: the tasks' names, sorted.
        episodes_per_task: kept episodes of each task.
        seed: with task and episode, fixes the initial state, the goal and the noise.
        noise_scale: standard deviations of the execution noise, one an episode in turn; (0.0,) for none.
        noise_hold: the steps for which each draw of the noise is kept; the longer, the further it leads astray.
        gripper_noise_factor: what the gripper's noise is multiplied by; noise there makes grasps fail.
        redraw_failures: keep successful episodes only, and draw another for each failure.
        max_steps: steps of an episode.
    """

    tasks: tuple[str, ...]
    episodes_per_task: int
    seed: int
    noise_scale: tuple[float, ...] = (0.0,)
    noise_hold: int = 1
    gripper_noise_factor: float = 0.2
    redraw_failures: bool = False
    max_steps: int = 500

    def to_json(self) -> dict[str, Any]:
        return {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}


@dataclass(frozen=True)
class EpisodeInfo:
    """One episode of a dataset.

    Attributes:
        task: the task's name.
        episode: its index; ``episode_seed(task, seed, episode)`` is its seed.
        start: its first row.
        length: its number of rows.
        success: whether it succeeded at some step.
        first_success: the first successful step, from 1; None without success.
    """

    task: str
    episode: int
    start: int
    length: int
    success: bool
    first_success: int | None


@dataclass(frozen=True)
class Demonstrations:
    """A finished dataset, described; :class:`LanguageWorldExperienceReplay` reads its rows.

    Attributes:
        root: its folder.
        config: how it was collected.
        versions: of the packages that made it.
        task_ids: task name to the number that stands for it in the files; rows are shown with today's
            :func:`~lw_torchrl.task_id`, whatever it was then.
        episodes: in the order of the rows.
        attempts: task name to the episodes run, failures that were redrawn among them.
    """

    root: Path
    config: CollectConfig
    versions: dict[str, str]
    task_ids: dict[str, int]
    episodes: tuple[EpisodeInfo, ...]
    attempts: dict[str, int]

    @property
    def num_steps(self) -> int:
        """The number of rows."""
        return sum(episode.length for episode in self.episodes)

    @property
    def success_rate(self) -> dict[str, float]:
        """Task name to the fraction of its kept episodes that succeeded."""
        found: dict[str, list[bool]] = {}
        for episode in self.episodes:
            found.setdefault(episode.task, []).append(episode.success)
        return {task: sum(found[task]) / len(found[task]) for task in self.config.tasks if task in found}


def package_versions() -> dict[str, str]:
    """The versions that results depend on."""
    return {name: version(name) for name in _PACKAGES}


def write_metadata(
    root: Path, config: CollectConfig, episodes: Sequence[EpisodeInfo], attempts: dict[str, int]
) -> None:
    """Write the metadata, which makes the dataset a finished one."""
    write_json(
        root / METADATA,
        {
            "format": FORMAT,
            "version": FORMAT_VERSION,
            "config": config.to_json(),
            "versions": package_versions(),
            "task_ids": {task: task_id(task) for task in config.tasks},
            "attempts": attempts,
            "episodes": {
                key: [getattr(episode, key) for episode in episodes] for key in EpisodeInfo.__dataclass_fields__
            },
        },
    )


def read_metadata(root: str | os.PathLike[str]) -> Demonstrations:
    """Describe the dataset in a folder.

    Raises:
        FileNotFoundError: there is no such folder.
        DatasetError: (a ValueError) the dataset is half-written, damaged, or of another format or version.
    """
    folder = Path(root)
    path = folder / METADATA
    if not folder.is_dir():
        raise FileNotFoundError(f"root: no dataset folder {str(folder)!r}; make one with collect_demonstrations")
    if not path.is_file():
        if (folder / PARTIAL).is_dir():
            raise DatasetError(
                f"root: the dataset in {str(folder)!r} is half-written; run the same collect_demonstrations again, "
                "and it carries on"
            )
        raise DatasetError(f"root: {str(folder)!r} holds no {METADATA}, so it is no dataset of {FORMAT}")
    try:
        found = json.loads(path.read_text("utf-8"))
        if found["format"] != FORMAT or found["version"] != FORMAT_VERSION:
            raise DatasetError(
                f"root: {str(path)!r} is of format {found['format']!r} version {found['version']!r}; this package "
                f"reads {FORMAT!r} version {FORMAT_VERSION}. Collect it again with the same collect_demonstrations, into "
                "another folder or after deleting this one"
            )
        config: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in found["config"].items()}
        columns = found["episodes"]
        rows = zip(*(columns[key] for key in EpisodeInfo.__dataclass_fields__), strict=True)
        episodes = tuple(EpisodeInfo(*row) for row in rows)
        start = 0
        for episode in episodes:
            if episode.start != start:
                raise ValueError(f"an episode starts at row {episode.start!r} instead of {start}")
            start += episode.length
        task_ids = {task: found["task_ids"][task] for task in config["tasks"]}
        return Demonstrations(folder, CollectConfig(**config), found["versions"], task_ids, episodes, found["attempts"])
    except DatasetError:
        raise
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(f"root: {str(path)!r} is damaged ({error!r}); collect the dataset again") from error


def _check_files(folder: Path, rows: int) -> None:
    """Raise if a column's file is not what it should be. Mapping a file that is too short would lengthen it."""
    for key, (tail, dtype) in COLUMNS.items():
        parent = folder.joinpath(*key[:-1])
        stated = json.loads((parent / "meta.json").read_text("utf-8"))[key[-1]]
        if stated["shape"] != [rows, *tail] or stated["dtype"] != str(dtype):
            raise ValueError(f"{'/'.join(key)} must be {dtype} of shape {[rows, *tail]}, its meta.json says {stated}")
        size = (parent / f"{key[-1]}.memmap").stat().st_size
        if size != rows * prod(tail) * dtype.itemsize:
            raise ValueError(f"{'/'.join(key)}.memmap has {size} bytes, not {rows * prod(tail) * dtype.itemsize}")


def _renumbered(demonstrations: Demonstrations) -> Tensor:
    """Today's task_id of each row: (R,) int64."""
    episodes = demonstrations.episodes
    numbers = torch.tensor([task_id(episode.task) for episode in episodes])
    return numbers.repeat_interleave(torch.tensor([episode.length for episode in episodes]))


def load_rows(demonstrations: Demonstrations) -> TensorDictBase:
    """The rows of a dataset, memory-mapped and read without unpickling.

    Where tasks were numbered otherwise when the dataset was made, ``task_id`` and ``("next", "task_id")`` are today's
    numbers, in memory.

    Raises:
        DatasetError: (a ValueError) a column is missing, damaged, or not as long as the metadata say.
    """
    folder, expected = demonstrations.root / DATA, demonstrations.num_steps
    try:
        (rows,) = json.loads((folder / "meta.json").read_text("utf-8"))["shape"]
        if rows == expected:
            _check_files(folder, rows)
            found = TensorDict.load_memmap(folder, allow_pickle=False)
            if any(task_id(task) != number for task, number in demonstrations.task_ids.items()):
                found.set("task_id", now := _renumbered(demonstrations))
                found.set(("next", "task_id"), now.clone())
            return found
    except Exception as error:
        reason = f"{type(error).__name__}: {error}"
        raise DatasetError(
            f"root: the rows in {str(folder)!r} cannot be read ({reason}); collect them again"
        ) from error
    raise DatasetError(f"root: {str(folder)!r} has {rows} rows, the metadata say {expected}; collect the dataset again")
