"""A demonstration dataset, described: how it was made, and the episodes that it holds.

root/data/            TorchRL's TED layout as a memory-mapped TensorDict, one row a step; see :mod:`.rows`
root/metadata.json    written last: without it the dataset is not finished; see :mod:`.metadata`
root/.partial/        the episodes so far, while collecting; see :mod:`.episode_files`. Beside them config.json and
                      versions.json say how they are made, from the start
root/.lock            held while collecting
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lw_torchrl._checks import check_int, check_scale
from lw_torchrl.data.behaviours import EXPERT, NOISY, Behaviour, check_own_label
from lw_torchrl.language.tasks import resolve_tasks

DATA, METADATA, PARTIAL, LOCK = "data", "metadata.json", ".partial", ".lock"
_MOST = 2**63 - 1


class DatasetError(ValueError):
    """A folder that holds no finished dataset of this format."""


class DamagedDatasetError(DatasetError):
    """A dataset whose files are not as they were written; the same :func:`collect_demonstrations` mends it."""


def _whole_number(argument: str, given: Any, minimum: int) -> int:
    if (value := check_int(argument, given, minimum=minimum)) > _MOST:
        raise ValueError(f"{argument} must be below 2**63, got a number of {len(str(value))} digits")
    return value


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
        policy: who acts.

    Raises:
        ValueError, TypeError: a wrong value, by its name.
    """

    tasks: tuple[str, ...]
    episodes_per_task: int
    seed: int
    noise_scale: tuple[float, ...] = (0.0,)
    noise_hold: int = 1
    gripper_noise_factor: float = 0.2
    redraw_failures: bool = False
    max_steps: int = 500
    policy: Behaviour = EXPERT

    def __post_init__(self) -> None:
        if not isinstance(self.policy, Behaviour):
            raise TypeError(f"policy must be a Behaviour, got {self.policy!r}")
        check_own_label(self.policy)
        if not isinstance(self.redraw_failures, bool):
            raise TypeError(f"redraw_failures must be True or False, got {self.redraw_failures!r}")
        if not self.noise_scale:
            raise ValueError("noise_scale must hold at least one number, got an empty sequence")
        checked = {
            "tasks": resolve_tasks(self.tasks),
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
        """As JSON; who acts is left out where it is the expert, as in datasets that know no others."""
        found = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self).items()}
        return {key: v for key, v in found.items() if key != "policy" or self.policy != EXPERT}

    @property
    def behaviour(self) -> str:
        """The label of its episodes: who acts; "noisy" for an expert executed with noise."""
        return NOISY if self.policy == EXPERT and any(self.noise_scale) else self.policy.name


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
        checksum: CRC-32 of its rows, column after column.
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
    """A finished dataset, described; :class:`LanguageWorldExperienceReplay` reads its rows.

    Attributes:
        root: its folder.
        config: how it was collected.
        versions: of the packages that it was begun with.
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
