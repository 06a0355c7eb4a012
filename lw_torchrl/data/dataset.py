"""The demonstration dataset on disk: metadata, memory-mapped rows, and a checksum for each episode.

root/data/            the rows (one per time step) in TorchRL's TED layout, with one file per column
root/metadata.json    written last, so that a folder without this file is not a finished dataset
root/.partial/        exists during collection: begun.json and the episodes; see :mod:`.collect`
root/.lock            the lock file, held during collection

The files in data/ have the format of ``TensorDict.memmap``, so ``TensorDict.load_memmap`` can read them. This module
takes the shapes from :func:`columns_of` and unpickles nothing. The memory map is copy-on-write: writing to a column
changes the column in this process only, never the file. Files are written without a memory map, because on a full
disk, writing through a map would kill the process without an error.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path
from reprlib import repr as short
from typing import Any
from zlib import crc32

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl._util.checks import Count, Scale, typed_fields
from lw_torchrl._util.files import AnyPath, check_damage, flush, read_json, write_json
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.registry import ReadOnlyDict
from lw_torchrl.data.collection_policy import BEHAVIOURS, EXPERT, NOISY, Behaviour
from lw_torchrl.envs.episodes import first_success
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.tasks import resolve_tasks

DATA, METADATA, PARTIAL, LOCK = "data", "metadata.json", ".partial", ".lock"
FORMAT, FORMAT_VERSION = "lw_torchrl.demonstrations", 2
TRAJECTORY, REWARD, DONE = ("collector", "traj_ids"), ("next", "reward"), ("next", "done")
DATASET = "dataset"  # the column with the index of each row's folder, if several folders are joined


class DatasetError(ValueError):
    """An error for a folder that holds no finished dataset of this format, or whose files are corrupted."""


@typed_fields
@dataclass(frozen=True)
class CollectConfig:
    """The arguments of :func:`collect_demonstrations` that determine the dataset: equal configs give equal datasets.

    ``tasks`` are sorted names. Episode k uses ``noise_scale[k % len(noise_scale)]``; (0.0,) adds no noise.
    """

    tasks: tuple[str, ...]
    episodes_per_task: Count
    seed: int
    noise_scale: tuple[Scale, ...] = (0.0,)
    noise_hold: Count = 1
    gripper_noise_factor: Scale = 0.2
    redraw_failures: bool = False
    max_steps: Count = 500
    policy: Behaviour = EXPERT
    layout: Layout = METAWORLD

    def __post_init__(self) -> None:
        name, acts = self.policy.name, self.policy.acts
        if name == NOISY or acts != BEHAVIOURS.get(name, acts):
            raise ValueError(f"behaviour: name {name!r} is reserved (reserved: {', '.join((*BEHAVIOURS, NOISY))})")
        if not self.noise_scale:
            raise ValueError("noise_scale must hold at least one number, got an empty sequence")
        if self.layout == METAWORLD:
            tasks = resolve_tasks(self.tasks)
        else:  # the tasks of another suite, which need not be installed to read a dataset
            tasks = tuple(sorted(self.tasks))
            if not tasks or not all(task.startswith(f"{self.layout.name}/") for task in tasks):
                raise ValueError(f"tasks must be named '{self.layout.name}/...', got {short(self.tasks)}")
        # JSON supports only Python's own number types.
        noise_scale = tuple(scale.item() if isinstance(scale, np.generic) else scale for scale in self.noise_scale)
        object.__setattr__(self, "tasks", tasks)
        object.__setattr__(self, "noise_scale", noise_scale)

    def to_json(self) -> dict[str, Any]:
        """Return the config as JSON; omit ``policy`` for the expert and ``layout`` for Meta-World."""
        config = {each.name: getattr(self, each.name) for each in fields(self)}
        config |= {"tasks": list(self.tasks), "noise_scale": list(self.noise_scale)}
        for key, default in (("policy", EXPERT), ("layout", METAWORLD)):
            if (value := config.pop(key)) != default:
                config[key] = value.to_json()
        return config

    @classmethod
    def from_json(cls, config: Mapping[str, Any]) -> CollectConfig:
        """Rebuild a config from the result of :meth:`to_json`."""
        options = {**config, "tasks": tuple(config["tasks"]), "noise_scale": tuple(config["noise_scale"])}
        if "policy" in options:
            options["policy"] = Behaviour(**options["policy"])
        if "layout" in options:
            options["layout"] = Layout.from_json(options["layout"])
        return cls(**options)

    @property
    def behaviour(self) -> str:
        """The label of the episodes: the name of the collection policy, or "noisy" for an expert with action noise."""
        return NOISY if self.policy == EXPERT and any(self.noise_scale) else self.policy.name


@dataclass(frozen=True)
class EpisodeInfo:
    """An episode of a dataset, seeded with ``episode_seed(task, seed, episode)``.

    ``start`` is the index of the first row, ``first_success`` the first successful time step (counted from 1, or None),
    and ``checksum`` the CRC-32 of the rows, column by column.
    """

    task: str
    episode: int
    start: int
    length: int
    success: bool
    first_success: int | None
    checksum: int


@dataclass(frozen=True)
class Demonstrations:
    """The description of a finished dataset; use :class:`LanguageWorldExperienceReplay` to read the rows.

    Attributes:
        root, config: the dataset's folder, and the config with which the dataset was collected.
        versions: the package versions at the start of the collection, by package name.
        task_ids: the task ids in the files, by task name; loaded rows have the current :func:`~lw_torchrl.task_id`.
        episodes: the episodes in the order of the rows.
        attempts: the number of episodes that were run for each task, including failures that were redrawn.
    """

    root: Path
    config: CollectConfig
    versions: dict[str, str]
    task_ids: dict[str, int]
    episodes: tuple[EpisodeInfo, ...]
    attempts: dict[str, int]

    @property
    def num_steps(self) -> int:
        return sum(episode.length for episode in self.episodes)

    @property
    def success_rate(self) -> dict[str, float]:
        """The fraction of each task's kept episodes that succeeded."""
        kept = Counter(episode.task for episode in self.episodes)
        succeeded = Counter(episode.task for episode in self.episodes if episode.success)
        return {task: succeeded[task] / number for task, number in kept.items()}


def write_metadata(demonstrations: Demonstrations) -> None:
    """Write the metadata file, which marks the dataset as finished."""
    metadata: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION, "config": demonstrations.config.to_json()}
    metadata |= {key: getattr(demonstrations, key) for key in ("versions", "task_ids", "attempts")}
    names = EpisodeInfo.__dataclass_fields__
    metadata["episodes"] = {name: [getattr(episode, name) for episode in demonstrations.episodes] for name in names}
    write_json(demonstrations.root / METADATA, metadata)


def read_metadata(root: AnyPath) -> Demonstrations:
    """Read a dataset's description; raise DatasetError if it is unfinished, corrupted or of another version."""
    folder = Path(root)
    path = folder / METADATA
    if not folder.is_dir():
        raise FileNotFoundError(f"root: no dataset folder {str(folder)!r}; create it with collect_demonstrations")
    if not path.is_file():
        resume = "unfinished; repeat the call of collect_demonstrations to resume"
        problem = resume if (folder / PARTIAL).is_dir() else f"not a dataset, because it has no file {METADATA}"
        raise DatasetError(f"root: {str(folder)!r} is {problem}")
    try:
        return parse_metadata(read_json(path, "root: the metadata"), folder)
    except DatasetError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise damaged(f"the metadata file {str(path)!r} is corrupted ({type(error).__name__}: {error})") from error


def damaged(problem: str) -> DatasetError:
    """Return the error to raise for a dataset whose files differ from what was written."""
    return DatasetError(f"root: {problem}; delete the folder and collect the dataset again")


def parse_metadata(metadata: Mapping[str, Any], folder: Path) -> Demonstrations:
    """Parse a dataset's metadata; raise DatasetError if the version differs, and any exception if it is corrupted."""
    if (metadata["format"], metadata["version"]) != (FORMAT, FORMAT_VERSION):
        version = f"{short(metadata['format'])} version {short(metadata['version'])}"
        needed = f"this package reads {FORMAT!r} version {FORMAT_VERSION}"
        raise DatasetError(f"root: {str(folder)!r} has format {version}, but {needed}; collect the dataset again")
    config = CollectConfig.from_json(metadata["config"])
    columns = [metadata["episodes"][name] for name in EpisodeInfo.__dataclass_fields__]
    episodes = tuple(EpisodeInfo(*row) for row in zip(*columns, strict=True))
    tasks = [task for task in config.tasks for _ in range(config.episodes_per_task)]
    start = 0
    for task, episode in zip(tasks, episodes, strict=True):
        if (episode.task, episode.start) != (task, start) or not 0 < episode.length <= config.max_steps:
            raise ValueError(f"{episode} has the wrong task, start or length")
        start += episode.length
    task_ids = {task: int(metadata["task_ids"][task]) for task in config.tasks}
    return Demonstrations(folder, config, metadata["versions"], task_ids, episodes, metadata["attempts"])


Column = tuple[str, ...]


@cache
def columns_of(layout: Layout) -> Mapping[Column, tuple[tuple[int, ...], torch.dtype]]:
    """Return the columns of a dataset, with the shape and dtype of one row."""
    observation, action = ((layout.size,), torch.float32), ((layout.action_size,), torch.float32)
    return ReadOnlyDict(
        {
            ("observation",): observation,
            ("task_id",): ((), torch.int64),
            ("episode",): ((), torch.int64),
            ("action",): action,
            ("expert_action",): action,
            ("unclipped_action",): action,
            TRAJECTORY: ((), torch.int64),
            ("next", "observation"): observation,
            ("next", "task_id"): ((), torch.int64),
            ("next", "reward_sparse"): ((1,), torch.float32),
            ("next", "reward_dense"): ((1,), torch.float32),
            **{("next", flag): ((1,), torch.bool) for flag in ("success", "done", "terminated", "truncated")},
        }
    )


COLUMNS = columns_of(METAWORLD)
"""The columns of a Meta-World dataset; in other suites, observations and actions have other sizes."""


def _path(folder: Path, key: Column) -> Path:
    return folder.joinpath(*key[:-1], f"{key[-1]}.memmap")


def _meta(rows: int, layout: Layout = METAWORLD) -> dict[str, dict[str, Any]]:
    """Return the content that TensorDict writes to the meta.json of each folder; "" is the folder of the rows."""
    folders: dict[str, dict[str, Any]] = {"": {}}
    for (*parents, name), (shape, dtype) in columns_of(layout).items():
        for parent in parents:
            folders[""][parent] = {"type": "TensorDict"}
        leaf = {"device": "cpu", "shape": [rows, *shape], "dtype": str(dtype), "is_nested": False}
        folders.setdefault("/".join(parents), {})[name] = leaf
    about = {"shape": [rows], "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
    return {folder: entries | about for folder, entries in folders.items()}


def write_rows(
    folder: Path, episodes: Iterable[tuple[str, int, TensorDictBase]], layout: Layout
) -> tuple[EpisodeInfo, ...]:
    """Write episodes (task, index, rows) in the given order, flush the files, and return the episodes' descriptions."""
    infos: list[EpisodeInfo] = []
    start = 0
    for name in _meta(0):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        files = {key: stack.enter_context(_path(folder, key).open("wb")) for key in COLUMNS}
        for number, (task, episode, rows) in enumerate(episodes):
            rows.set(TRAJECTORY, torch.full(rows.batch_size, number))
            infos.append(describe_episode(task, episode, start, rows))
            start += len(rows)
            for key, file in files.items():
                file.write(rows.get(key).contiguous().numpy().data)
    for name, entries in _meta(start, layout).items():
        (folder / name / "meta.json").write_text(json.dumps(entries, separators=(",", ":")), encoding="utf-8")
    for path in sorted(folder.rglob("*"), reverse=True):  # files before their folders
        flush(path)
    flush(folder)
    return tuple(infos)


def describe_episode(task: str, episode: int, start: int, rows: TensorDictBase) -> EpisodeInfo:
    """Describe an episode with these rows, which begin at row ``start`` of the dataset."""
    checksum = 0
    for key in COLUMNS:
        checksum = crc32(rows.get(key).contiguous().numpy().data, checksum)
    first = first_success(rows.get(("next", "success")))
    return EpisodeInfo(task, episode, start, len(rows), first is not None, first, checksum)


class MappedColumn(Tensor):
    """A memory-mapped column. Spawned processes map the file again; results of operations are plain tensors."""

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    _source: tuple[Path, tuple[int, ...], torch.dtype]

    @staticmethod
    def of(path: Path, shape: tuple[int, ...], dtype: torch.dtype) -> MappedColumn:
        """Map a file as a column; raise OSError, ValueError or RuntimeError if shape and dtype do not fit the file."""
        content = torch.from_numpy(np.memmap(path, np.uint8, "c"))
        column = content.view(dtype).view(shape).as_subclass(MappedColumn)
        column._source = (path.absolute(), shape, dtype)
        return column

    def __reduce_ex__(self, protocol: Any) -> Any:
        return MappedColumn.of, self._source

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        return self.clone()


def load_rows(demonstrations: Demonstrations) -> TensorDict:
    """Memory-map all rows of a dataset; raise DatasetError if a file is missing or has the wrong size."""
    folder, number = demonstrations.root / DATA, demonstrations.num_steps
    try:
        columns = {
            key: MappedColumn.of(_path(folder, key), (number, *shape), dtype)
            for key, (shape, dtype) in columns_of(demonstrations.config.layout).items()
        }
    except (OSError, ValueError, RuntimeError) as error:
        check_damage(error)
        raise damaged(f"the rows in {str(folder)!r} are corrupted ({error})") from error
    return TensorDict(columns, [number], device="cpu")


# For each folder: the state of the files when this process last verified episodes, and the verified episodes.
_VERIFIED: dict[Path, tuple[list[Any], set[EpisodeInfo]]] = {}


def damaged_episodes(
    demonstrations: Demonstrations, episodes: Sequence[EpisodeInfo], *, progress: bool = False
) -> list[EpisodeInfo]:
    """Return the episodes whose rows do not match their checksum."""
    rows, damaged_ones = load_rows(demonstrations), []
    with Progress("checking", len(episodes), "episode", show=progress) as bar:
        for info in episodes:
            steps = rows[info.start : info.start + info.length]
            if describe_episode(info.task, info.episode, info.start, steps) != info:
                damaged_ones.append(info)
            bar.update()
    return damaged_ones


def verify(demonstrations: Demonstrations, episodes: Sequence[EpisodeInfo]) -> None:
    """Raise DatasetError unless episodes match their checksums; skip episodes verified since the files last changed."""
    load_rows(demonstrations)  # raises if a file is missing
    root = demonstrations.root.resolve()
    states = [path.stat() for path in (root / METADATA, *(_path(root / DATA, key) for key in COLUMNS))]
    files = [(state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns) for state in states]
    files_before, known = _VERIFIED.get(root, (files, set()))
    if files != files_before:
        known = set()
    if broken := damaged_episodes(demonstrations, [info for info in episodes if info not in known]):
        episode = f"episode {broken[0].episode} of {broken[0].task!r}"
        raise damaged(f"the rows in {str(root)!r} are corrupted: {episode} differs from its checksum")
    _VERIFIED[root] = (files, known | set(episodes))
