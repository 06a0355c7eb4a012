"""A demonstration dataset's description: how it was made, which episodes it holds, and its metadata.json.

root/data/            the rows, one a step, in TorchRL's TED layout; see :mod:`.memory_map`
root/metadata.json    written last: without it the dataset is not finished. Nothing in it is taken on trust
root/.partial/        while collecting: config.json, versions.json and the episodes; see :mod:`.missing_episodes`
root/.lock            held while collecting
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from reprlib import repr as short
from typing import Any, TypeVar

from lw_torchrl._checks import check_fields, check_int, check_scale
from lw_torchrl._files import AnyPath, read_json, write_json
from lw_torchrl.data.behaviours import EXPERT, NOISY, Behaviour, check_own_label
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.tasks import MT50, resolve_tasks

DATA, METADATA, PARTIAL, LOCK = "data", "metadata.json", ".partial", ".lock"
_MOST = 2**63 - 1
Parsed = TypeVar("Parsed")


class DatasetError(ValueError):
    """A folder that holds no finished dataset of this format."""


class DamagedDatasetError(DatasetError):
    """A dataset whose files are not as they were written; the same :func:`collect_demonstrations` repairs it."""


def _whole_number(argument: str, given: Any, minimum: int) -> int:
    if (value := check_int(argument, given, minimum=minimum)) > _MOST:
        raise ValueError(f"{argument} must be below 2**63, got a number of {len(str(value))} digits")
    return value


def _own_tasks(tasks: tuple[str, ...], layout: Layout) -> tuple[str, ...]:
    """The names of another suite's tasks, sorted; the suite itself need not be installed."""
    named = all(isinstance(task, str) and task.startswith(f"{layout.name}/") for task in tasks)
    if not tasks or not named or len(set(tasks)) != len(tasks):
        raise ValueError(f"tasks must be different ones named '{layout.name}/...', got {short(tasks)}")
    return tuple(sorted(tasks))


@dataclass(frozen=True)
class CollectConfig:
    """How demonstrations are made, by the arguments of :func:`collect_demonstrations`; equal configurations give equal
    datasets. ``tasks`` are names, sorted; ``noise_scale`` holds a number for each episode in turn, (0.0,) for none."""

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
        if not isinstance(self.policy, Behaviour):
            raise TypeError(f"policy must be a Behaviour, got {self.policy!r}")
        check_own_label(self.policy)
        check_fields(self)
        if not self.noise_scale:
            raise ValueError("noise_scale must hold at least one number, got an empty sequence")
        checked = {
            "tasks": resolve_tasks(self.tasks) if self.layout == METAWORLD else _own_tasks(self.tasks, self.layout),
            "episodes_per_task": _whole_number("episodes_per_task", self.episodes_per_task, 1),
            "seed": _whole_number("seed", self.seed, -_MOST),
            "noise_scale": tuple(check_scale("noise_scale", scale) for scale in self.noise_scale),
            "noise_hold": _whole_number("noise_hold", self.noise_hold, 1),
            "gripper_noise_factor": check_scale("gripper_noise_factor", self.gripper_noise_factor),
            "max_steps": _whole_number("max_steps", self.max_steps, 1),
        }
        for name, value in checked.items():
            object.__setattr__(self, name, value)

    def to_json(self) -> dict[str, Any]:
        """As JSON; ``policy`` is left out for the expert, and ``layout`` for Meta-World's, as older datasets do."""
        found = {each.name: getattr(self, each.name) for each in fields(self)}
        found |= {"tasks": list(self.tasks), "noise_scale": list(self.noise_scale)}
        for key, usual in (("policy", EXPERT), ("layout", METAWORLD)):
            if (stated := found.pop(key)) != usual:
                found[key] = stated.to_json()
        return found

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
_BAD = (ValueError, TypeError, KeyError, OverflowError, RecursionError)


def write_metadata(made: Demonstrations) -> None:
    """Write the metadata, which makes the dataset a finished one."""
    stated: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION, "config": made.config.to_json()}
    stated |= {key: getattr(made, key) for key in ("versions", "task_ids", "attempts")}
    columns = {key: [getattr(episode, key) for episode in made.episodes] for key in EpisodeInfo.__dataclass_fields__}
    write_json(made.root / METADATA, stated | {"episodes": columns})


def read_metadata(root: AnyPath) -> Demonstrations:
    """Describe the dataset in a folder; DatasetError if it is half-written, damaged, or of another version."""
    folder = Path(root)
    path = folder / METADATA
    if not folder.is_dir():
        raise FileNotFoundError(f"root: no dataset folder {str(folder)!r}; make one with collect_demonstrations")
    if (folder / PARTIAL).is_dir() and not path.is_file():
        what = f"root: the dataset in {str(folder)!r} is half-written"
        raise DatasetError(f"{what}; run the same collect_demonstrations again, and it carries on")
    if not path.is_file():
        raise DatasetError(f"root: {str(folder)!r} holds no {METADATA}, so it is no dataset of {FORMAT}")
    try:
        found = read_json(path, "root: the metadata")
        stated = found["format"], found["version"]
        if stated != (FORMAT, FORMAT_VERSION) or isinstance(stated[1], float):
            raise DatasetError(
                f"root: {str(path)!r} is of format {short(stated[0])} version {short(stated[1])}; this package reads "
                f"{FORMAT!r} version {FORMAT_VERSION}. Collect it again with the same collect_demonstrations"
            )
        config = parse_config(found["config"])
        episodes = _episodes(_object("episodes", found["episodes"], EpisodeInfo.__dataclass_fields__), config)
        last = {episode.task: episode.episode for episode in episodes}
        attempts = _object("attempts", found["attempts"], config.tasks)
        if any(_integer(f"attempts of {task}", attempts[task]) != last[task] + 1 for task in config.tasks):
            raise ValueError("the attempts are not those of the episodes")
        versions, task_ids = parse_versions(found["versions"]), _object("task_ids", found["task_ids"], config.tasks)
        if len({_integer(f"task_ids of {task}", number) for task, number in task_ids.items()}) != len(task_ids):
            raise ValueError(f"task_ids must differ, got {short(task_ids)}")
        return Demonstrations(folder, config, versions, task_ids, episodes, attempts)
    except DatasetError:
        raise
    except _BAD as error:
        told = f"{type(error).__name__}: {str(error)[:500]}"
        again = "the same collect_demonstrations makes the dataset again"
        raise DamagedDatasetError(f"root: {str(path)!r} is damaged ({told}); {again}") from error


def read_partial(path: Path, parse: Callable[[Any], Parsed]) -> Parsed:
    """What ``parse`` makes of a JSON file of a half-made dataset; a damaged file is a :class:`DatasetError`."""
    try:
        return parse(read_json(path, "root: the file"))
    except _BAD as error:
        again = f"delete {str(path.parent.parent)!r} to start again"
        raise DatasetError(f"root: {str(path)!r} is damaged ({str(error)[:500]}); {again}") from error


def parse_config(stated: Any) -> CollectConfig:
    """A configuration from its JSON; ValueError, TypeError or OverflowError if it is none."""
    there = stated if isinstance(stated, Mapping) else {}
    readers: dict[str, Callable[[Any], Any]] = {"policy": Behaviour.from_json, "layout": Layout.from_json}
    names = [name for name in CollectConfig.__dataclass_fields__ if name not in readers or name in there]
    found = _object("config", stated, names)
    for name, longest in (("tasks", len(MT50)), ("noise_scale", None)):
        if not isinstance(found[name], list) or (longest and len(found[name]) > longest):
            raise ValueError(f"{name} must be a list, of at most {longest or 'any'} entries, got {short(found[name])}")
    options: dict[str, Any] = {key: tuple(v) if isinstance(v, list) else v for key, v in found.items()}
    config = CollectConfig(**options | {key: read(found[key]) for key, read in readers.items() if key in found})
    if list(config.tasks) != found["tasks"]:
        raise ValueError(f"tasks must be sorted, got {short(found['tasks'])}")
    return config


def _object(name: str, stated: Any, keys: Any) -> dict[str, Any]:
    if not isinstance(stated, Mapping) or set(stated) != set(keys):
        raise ValueError(f"{name} must be an object of {', '.join(keys)}, got {short(stated)}")
    return dict(stated)


def _integer(name: str, stated: Any, minimum: int = 0, maximum: int = _MOST) -> int:
    if type(stated) is not int or not minimum <= stated <= maximum:
        raise ValueError(f"{name} must be an integer in [{minimum}, {maximum}], got {short(stated)}")
    return stated


def parse_versions(stated: Any) -> dict[str, str]:
    """Package name to version, from its JSON; ValueError if it is none."""
    if not isinstance(stated, dict) or not all(isinstance(v, str) and len(v) <= 100 for v in stated.values()):
        raise ValueError(f"versions must be names and short texts, got {short(stated)}")
    return stated


def _episodes(columns: dict[str, Any], config: CollectConfig) -> tuple[EpisodeInfo, ...]:
    """The episodes from their columns: sorted, as many of each task as configured, row after row."""
    number = len(config.tasks) * config.episodes_per_task
    for name, column in columns.items():
        if not isinstance(column, list) or len(column) != number:
            raise ValueError(f"episodes: {name} must be a list of {number}, got {short(column)}")
    expected = [task for task in config.tasks for _ in range(config.episodes_per_task)]
    if columns["task"] != expected:
        raise ValueError(f"episodes: task must be {short(expected)}, got {short(columns['task'])}")
    found: list[EpisodeInfo] = []
    start = 0
    for row in zip(*(columns[key] for key in EpisodeInfo.__dataclass_fields__), strict=True):
        info = EpisodeInfo(*row)
        follows = found and found[-1].task == info.task
        _integer("episodes: episode", info.episode, found[-1].episode + 1 if follows else 0)
        _integer("episodes: start", info.start, start, start)
        start += _integer("episodes: length", info.length, 1, config.max_steps)
        if info.first_success is not None:
            _integer("episodes: first_success", info.first_success, 1, info.length)
        if info.success is not (info.first_success is not None):
            raise ValueError(f"episodes: success must be {info.first_success is not None}, got {short(info.success)}")
        _integer("episodes: checksum", info.checksum, 0, 2**32 - 1)
        found.append(info)
    return tuple(found)
