"""A demonstration dataset's description: how it was collected, which episodes it holds, and its metadata.json.

root/data/            the rows, one for each step, in TorchRL's TED layout; see :mod:`.memory_map`
root/metadata.json    written last: a folder without it is not a finished dataset
root/.partial/        while collecting: begun.json and the episodes; see :mod:`.missing_episodes`
root/.lock            held while collecting
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from reprlib import repr as short
from typing import Any

from lw_torchrl._util.checks import Count, Scale, check_value, typed_fields
from lw_torchrl._util.files import AnyPath, read_json, write_json
from lw_torchrl.data.behaviours import EXPERT, NOISY, Behaviour, check_own_label
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.tasks import resolve_tasks

DATA, METADATA, PARTIAL, LOCK = "data", "metadata.json", ".partial", ".lock"


class DatasetError(ValueError):
    """A folder that holds no finished dataset of this format, or a damaged one."""


def _own_tasks(tasks: tuple[str, ...], layout: Layout) -> tuple[str, ...]:
    """The names of another suite's tasks, sorted; the suite itself need not be installed."""
    if not tasks or not all(task.startswith(f"{layout.name}/") for task in tasks):
        raise ValueError(f"tasks must be named '{layout.name}/...', got {short(tasks)}")
    return tuple(sorted(tasks))


@typed_fields
@dataclass(frozen=True)
class CollectConfig:
    """The arguments of :func:`collect_demonstrations` that decide what it collects: equal ones give equal datasets.
    ``tasks`` are names, sorted; ``noise_scale`` holds a number for each episode in turn, (0.0,) for none."""

    tasks: tuple[str, ...]
    episodes_per_task: int
    seed: int
    noise_scale: tuple[float, ...] = (0.0,)
    noise_hold: int = 1
    gripper_noise_factor: float = 0.2
    redraw_failures: bool = False
    max_steps: int = 500
    policy: Behaviour = EXPERT
    layout: Layout = METAWORLD

    def __post_init__(self) -> None:
        check_own_label(self.policy)
        if not self.noise_scale:
            raise ValueError("noise_scale must hold at least one number, got an empty sequence")
        checked = {
            "tasks": resolve_tasks(self.tasks) if self.layout == METAWORLD else _own_tasks(self.tasks, self.layout),
            "episodes_per_task": check_value("episodes_per_task", self.episodes_per_task, Count),
            "seed": check_value("seed", self.seed, int),
            "noise_scale": tuple(check_value("noise_scale", scale, Scale) for scale in self.noise_scale),
            "noise_hold": check_value("noise_hold", self.noise_hold, Count),
            "gripper_noise_factor": check_value("gripper_noise_factor", self.gripper_noise_factor, Scale),
            "max_steps": check_value("max_steps", self.max_steps, Count),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def to_json(self) -> dict[str, Any]:
        """As JSON; without ``policy`` for the expert, and without ``layout`` for Meta-World's."""
        config = {each.name: getattr(self, each.name) for each in fields(self)}
        config |= {"tasks": list(self.tasks), "noise_scale": list(self.noise_scale)}
        for key, default in (("policy", EXPERT), ("layout", METAWORLD)):
            if (value := config.pop(key)) != default:
                config[key] = value.to_json()
        return config

    @classmethod
    def from_json(cls, config: Mapping[str, Any]) -> CollectConfig:
        """The configuration that :meth:`to_json` gave."""
        options = {**config, "tasks": tuple(config["tasks"]), "noise_scale": tuple(config["noise_scale"])}
        for key, parse in (("policy", Behaviour.from_json), ("layout", Layout.from_json)):
            if key in options:
                options[key] = parse(options[key])
        return cls(**options)

    @property
    def behaviour(self) -> str:
        """The label of its episodes: who acts; "noisy" for an expert executed with noise."""
        return NOISY if self.policy == EXPERT and any(self.noise_scale) else self.policy.name


@dataclass(frozen=True)
class EpisodeInfo:
    """One episode of a dataset: ``episode_seed(task, seed, episode)`` is its seed, ``start`` its first row,
    ``first_success`` the first successful step, from 1, or None, ``checksum`` the CRC-32 of its rows, by columns."""

    task: str
    episode: int
    start: int
    length: int
    success: bool
    first_success: int | None
    checksum: int


@dataclass(frozen=True)
class Demonstrations:
    """A finished dataset, described; :class:`LanguageWorldExperienceReplay` reads its rows.

    Attributes:
        root, config: its folder, and how it was collected.
        versions: of the packages that it was begun with.
        task_ids: task name to its number in the files; rows are shown with the present :func:`~lw_torchrl.task_id`.
        episodes: in the order of the rows.
        attempts: task name to the number of episodes run, with the failures that were redrawn.
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
        """Task name to the fraction of its kept episodes that succeeded."""
        kept = Counter(episode.task for episode in self.episodes)
        succeeded = Counter(episode.task for episode in self.episodes if episode.success)
        return {task: succeeded[task] / number for task, number in kept.items()}


FORMAT = "lw_torchrl.demonstrations"
FORMAT_VERSION = 2


def write_metadata(demonstrations: Demonstrations) -> None:
    """Write the metadata, which makes the dataset a finished one."""
    metadata: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION, "config": demonstrations.config.to_json()}
    metadata |= {key: getattr(demonstrations, key) for key in ("versions", "task_ids", "attempts")}
    names = EpisodeInfo.__dataclass_fields__
    metadata["episodes"] = {name: [getattr(episode, name) for episode in demonstrations.episodes] for name in names}
    write_json(demonstrations.root / METADATA, metadata)


def read_metadata(root: AnyPath) -> Demonstrations:
    """Describe the dataset in a folder; DatasetError if it is unfinished, damaged, or of another version."""
    folder = Path(root)
    path = folder / METADATA
    if not folder.is_dir():
        raise FileNotFoundError(f"root: no dataset folder {str(folder)!r}; make one with collect_demonstrations")
    if (folder / PARTIAL).is_dir() and not path.is_file():
        unfinished = f"root: the dataset in {str(folder)!r} is unfinished"
        raise DatasetError(f"{unfinished}; the same collect_demonstrations resumes it")
    if not path.is_file():
        raise DatasetError(f"root: {str(folder)!r} is not a dataset: it has no {METADATA}")
    try:
        return parse_metadata(read_json(path, "root: the metadata"), folder)
    except DatasetError:
        raise
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise damaged(f"the metadata {str(path)!r} are damaged ({type(error).__name__}: {error})") from error


def damaged(what: str) -> DatasetError:
    """The error for a dataset whose files differ from what was written; the caller raises it."""
    return DatasetError(f"root: {what}; delete the folder and collect the dataset again")


def parse_metadata(metadata: Mapping[str, Any], folder: Path) -> Demonstrations:
    """The description in metadata; DatasetError if they are of another version."""
    if (metadata["format"], metadata["version"]) != (FORMAT, FORMAT_VERSION):
        version = f"{short(metadata['format'])} version {short(metadata['version'])}"
        raise DatasetError(
            f"root: {str(folder)!r} has the format {version}, this package reads {FORMAT!r} version {FORMAT_VERSION}; "
            "collect it again"
        )
    config = CollectConfig.from_json(metadata["config"])
    columns = [metadata["episodes"][name] for name in EpisodeInfo.__dataclass_fields__]
    episodes = tuple(EpisodeInfo(*row) for row in zip(*columns, strict=True))
    tasks = [task for task in config.tasks for _ in range(config.episodes_per_task)]
    start = 0
    for task, episode in zip(tasks, episodes, strict=True):
        if (episode.task, episode.start) != (task, start) or not 0 < episode.length <= config.max_steps:
            raise ValueError(f"episode {episode.episode} of {episode.task!r} does not fit the others")
        start += episode.length
    task_ids = {task: int(metadata["task_ids"][task]) for task in config.tasks}
    return Demonstrations(folder, config, metadata["versions"], task_ids, episodes, metadata["attempts"])
