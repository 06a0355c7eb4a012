"""collect_demonstrations: the experts' episodes as a dataset on disk, resumable after a kill."""

from __future__ import annotations

import os
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import nullcontext, suppress
from numbers import Real
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from lw_torchrl._checks import checked, differences, shown
from lw_torchrl._files import AnyPath, flush, held, write_json
from lw_torchrl._versions import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import dataset, memory_map
from lw_torchrl.data.behaviours import Behaviour, behaviour_of
from lw_torchrl.data.dataset import CollectConfig, DamagedDatasetError, DatasetError, Demonstrations, write_metadata
from lw_torchrl.data.memory_map import write_rows
from lw_torchrl.data.missing_episodes import EpisodeFiles, run_missing_episodes, write_failed
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.modules.networks import evaluating
from lw_torchrl.modules.policy import Policy
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks


def _open_episode_files(
    root: Path, config: CollectConfig, made_with: dict[str, str] | None = None
) -> tuple[EpisodeFiles, dict[str, str]]:
    """The episodes so far, and the versions they were begun with: ``made_with`` for a damaged dataset."""
    folder = root / dataset.PARTIAL
    stated, of_packages = folder / "config.json", folder / "versions.json"
    recorded = made_with or {}
    if begun := stated.is_file():
        before = dataset.read_partial(stated, dataset.parse_config)
        _check_same(before, config, f"root: {str(root)!r} holds a half-made dataset")
        if not recorded and of_packages.exists():
            recorded = dataset.read_partial(of_packages, dataset.parse_versions)
    versions = package_versions()
    if recorded and (made_with or any(folder.glob("*.npz"))):
        _check_versions(root, recorded)
        versions = recorded
    if recorded or not begun:  # an older one does not say what it was begun with
        write_json(of_packages, versions)
    if not begun:
        write_json(stated, config.to_json())
    files = EpisodeFiles(folder, config.tasks, config.max_steps, config.layout)
    files.drop_damaged()
    return files, versions


def _check_versions(root: Path, recorded: dict[str, str]) -> None:
    """Refuse to mix two simulators' episodes; warn where other packages may change the last bits."""
    if changes := version_changes(recorded, SIMULATORS):
        wanted = " ".join(f"{name}=={recorded[name]}" for name in SIMULATORS if name in recorded)
        raise DatasetError(
            f"root: {str(root)!r} holds episodes of another simulator ({'; '.join(changes)}), which are not mixed with "
            f"others: install {wanted} to go on, choose another folder, or delete it to start again"
        )
    if changes := version_changes(recorded, ("lw_torchrl", "numpy", "torch")):
        warnings.warn(
            f"root: the dataset in {str(root)!r} was begun under other versions ({'; '.join(changes)}): it is "
            "continued, but new episodes may differ in their last bits from those that these would have given",
            stacklevel=5,
        )


def _check_same(before: CollectConfig, config: CollectConfig, what: str) -> None:
    if before != config:
        was, now = (one.to_json() | {"policy": one.policy.to_json()} for one in (before, config))
        of = f"of another configuration ({', '.join(differences(was, now))})"
        raise DatasetError(f"{what} {of}; choose another folder, or delete it to start again")


def _read_through(
    root: Path, config: CollectConfig, progress: bool
) -> tuple[Demonstrations | None, list[dataset.EpisodeInfo], str]:
    """The dataset in a folder if all of it is as it was written; else its whole episodes, and what is wrong."""
    try:
        found = dataset.read_metadata(root)
    except DamagedDatasetError as error:
        if not memory_map.holds_columns(root / dataset.DATA):
            what = f"root: {str(root)!r} holds no dataset, or one damaged beyond telling ({error})"
            raise DatasetError(f"{what}; choose another folder, or delete it to start again") from error
        return None, [], str(error)
    _check_same(found.config, config, f"root: {str(root)!r} holds a dataset")
    whole = memory_map.whole_episodes(found, progress=progress)
    try:
        memory_map.load_rows(found)
    except DamagedDatasetError as error:
        return None, whole, str(error)
    if len(whole) < len(found.episodes):
        return None, whole, "rows differ from their checksums"
    return found, whole, ""


def _take_apart(root: Path, config: CollectConfig, whole: list[dataset.EpisodeInfo], reason: str) -> None:
    """Make a damaged dataset a half-made one: what is whole goes back among the episode files."""
    kept = f"{len(whole)} of {config.episodes_per_task * len(config.tasks)} episodes"
    warnings.warn(f"root: {str(root)!r} is damaged; {kept} are kept, the others are run again ({reason})", stacklevel=4)
    files, _ = _open_episode_files(root, config, dataset.read_metadata(root).versions if whole else None)
    for info in whole:
        if not files.has(info.task, info.episode):
            rows = memory_map.read_rows(root / dataset.DATA, info.start, info.length, config.layout)
            files.put(info.task, info.episode, rows)
    (root / dataset.METADATA).unlink()


def _assemble(
    root: Path, config: CollectConfig, versions: dict[str, str], files: EpisodeFiles, kept: dict[str, list[int]]
) -> None:
    listed = [(task, episode) for task in config.tasks for episode in kept[task]]
    infos: list[dataset.EpisodeInfo] = []

    def episodes() -> Iterator[TensorDictBase]:
        for number, (task, episode) in enumerate(listed):
            rows = files.get(task, episode)
            for key in ("task_id", ("next", "task_id")):
                rows.set(key, torch.full(rows.batch_size, task_id(task)))  # they may have had other numbers then
            rows.set(("collector", "traj_ids"), torch.full(rows.batch_size, number))
            start = infos[-1].start + infos[-1].length if infos else 0
            infos.append(memory_map.describe_episode(task, episode, start, rows))
            yield rows

    building = files.folder / "rows"
    for old in (building, root / dataset.DATA):
        shutil.rmtree(old, ignore_errors=True)
    try:
        write_rows(building, episodes(), config.layout)
        os.replace(building, root / dataset.DATA)
        flush(root)
        attempts = {task: max(kept[task]) + 1 for task in config.tasks}
        task_ids = {task: task_id(task) for task in config.tasks}
        write_metadata(Demonstrations(root, config, versions, task_ids, tuple(infos), attempts))
    except OSError as error:
        shutil.rmtree(building, ignore_errors=True)
        raise write_failed(root, len(listed) * config.max_steps * memory_map.row_bytes(config.layout), error) from error


def _made(
    root: Path, config: CollectConfig, policy: Any, num_envs: int | None, suite: Suite, progress: bool
) -> Demonstrations:
    """The dataset, finished or repaired if need be; the folder must be held, and another call may have come first."""
    finished = (root / dataset.METADATA).is_file()
    found, whole, reason = _read_through(root, config, progress) if finished else (None, [], "")
    if found is None:
        for path in (root / dataset.DATA, root / dataset.PARTIAL):
            if path.is_symlink() or (path.exists() and not path.is_dir()):
                kind = "link" if path.is_symlink() else "file"
                what = f"must be a folder for the dataset to be collected or mended, it is a {kind}"
                raise DatasetError(f"root: {str(path)!r} {what}; put the folder itself there, or choose another root")
        if finished:
            _take_apart(root, config, whole, reason)
        files, versions = _open_episode_files(root, config)
        _assemble(root, config, versions, files, run_missing_episodes(config, policy, files, num_envs, suite, progress))
        found = dataset.read_metadata(root)
    shutil.rmtree(root / dataset.PARTIAL, ignore_errors=True)
    return found


@checked
def collect_demonstrations(
    tasks: str | Iterable[str],
    *,
    episodes_per_task: int,
    root: AnyPath,
    suite: str | Suite | None = None,
    policy: str | Behaviour | TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase] = "expert",
    behaviour: str | None = None,
    seed: int = 0,
    noise_scale: float | Sequence[float] = 0.0,
    noise_hold: int = 1,
    gripper_noise_factor: float = 0.2,
    redraw_failures: bool = False,
    max_steps: int | None = None,
    num_envs: int | None = None,
    progress: bool = True,
) -> Demonstrations:
    """Run Meta-World's scripted experts, or others, and write their episodes to a dataset.

    A call that was killed, or ran out of disk, carries on when it is repeated. On a finished dataset of the same
    configuration it checks all rows, and runs damaged episodes again. Neither ``num_envs`` nor interruptions matter.

    Each row is a step, in TorchRL's TED layout (R rows):
        observation, next/observation: (R, 39) float32, metres.
        task_id, next/task_id, episode: (R,) int64. collector/traj_ids: (R,) int64, unique per episode.
        action: (R, 4) float32 in [-1, 1], as executed, noise included.
        expert_action: (R, 4) float32 in [-1, 1], what the expert, or whoever acted, wanted in the same state;
            unclipped_action: (R, 4) float32, what its script asked for.
        next/reward_sparse, next/reward_dense: (R, 1) float32, the success as 0 and 1, and Meta-World's reward.
        next/success, next/done, next/terminated, next/truncated: (R, 1) bool.

    Args:
        tasks: of the 50, as for :func:`resolve_tasks`, or of another suite; docs/training.md shows tasks of your own.
        episodes_per_task: how many episodes of each task to keep.
        root: the dataset's folder, new or left by an earlier call.
        suite: the :class:`~lw_torchrl.suites.Suite` that has the tasks; None for the one that their names begin with.
        policy: who acts in the whole dataset; mixtures are lists of datasets. A name in :data:`BEHAVIOURS`: "expert",
            Meta-World's script, "scripted", "spoilt-60", "spoilt-30", "wrong" or "random"; a :class:`Behaviour`; a
            trained :class:`Policy`, any TensorDictModule or a function, run as :func:`evaluate` runs it: it reads
            ``observation`` (N, 39) float32, ``task_id`` and ``episode`` (N,) int64, and ``qaf`` if it has ``plans``,
            and writes ``action`` (N, 4) float32. What it does in a row must depend on that row alone. Of a function
            nothing but its label is kept: continued with another of the same label, a dataset is of both.
        behaviour: the label of its episodes, for :class:`EpisodeFilter`; None for its name. What is no name and no
            :class:`Behaviour` needs one.
        seed: evaluate on another one.
        noise_scale: standard deviation of the noise on the executed action; of a sequence, each episode's in turn.
        noise_hold: steps for which each draw of the noise is kept; the longer, the further it leads the expert astray.
        gripper_noise_factor: multiplies the noise on the gripper.
        redraw_failures: keep only successful episodes.
        max_steps: steps of an episode.
        num_envs: environments stepped together.
        progress: show a progress bar when it takes longer than a second.

    Warns:
        UserWarning: a dataset was damaged, or begun under another version of numpy, torch or this package.

    Raises:
        DatasetError: (a ValueError) ``root`` holds something else, or of another simulator, or another call is at work.
        OSError: it cannot be written, for lack of room, say; nothing is lost.
        RuntimeError: redrawing found too few successes.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        >>> demos.num_steps, demos.success_rate
        (80, {'reach': 1.0})
    """
    try:
        tasks = listed_tasks(tasks)
        if own := [one for one in ([tasks] if isinstance(tasks, Task) else tasks) if isinstance(one, Task)]:
            raise TypeError(f"task must be a task's name, got {shown(own[0])} (Task)")
        found_suite = find_suite(tasks, suite)
        names = tuple(found_suite.named_tasks(tasks))
    except TypeError as error:
        why = "Meta-World's experts demonstrate its own 50 tasks; docs/training.md shows demonstrations in others"
        raise TypeError(f"{error}. {why}") from error
    actor = None if isinstance(policy, (str, Behaviour)) else policy
    if isinstance(actor, Policy) and (unknown := [task for task in names if task not in actor.tasks]):
        raise ValueError(f"tasks must be among the policy's, it was not made for {', '.join(unknown)}")
    config = CollectConfig(
        tasks=names,
        episodes_per_task=episodes_per_task,
        seed=seed,
        noise_scale=(noise_scale,) if isinstance(noise_scale, (float, Real)) else tuple(noise_scale),
        noise_hold=noise_hold,
        gripper_noise_factor=gripper_noise_factor,
        redraw_failures=bool(redraw_failures),
        max_steps=found_suite.max_steps if max_steps is None else max_steps,
        layout=found_suite.layout,
        policy=behaviour_of(policy, names, behaviour, found_suite),
    )
    folder, partial = Path(root), Path(root, dataset.PARTIAL)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"root must be a folder, {str(folder)!r} is a file")
    found = None
    if (folder / dataset.METADATA).is_file():
        with suppress(OSError):  # another call may be repairing it
            found = _read_through(folder, config, progress)[0]
    elif folder.is_dir() and not partial.is_dir() and {path.name for path in folder.iterdir()} - {dataset.LOCK}:
        raise DatasetError(f"root: {str(folder)!r} is not empty and holds no dataset; choose another folder")
    if found is None or partial.is_dir():
        lock = held(folder, "root", "collect_demonstrations", folder=True, error=DatasetError)
        with lock, evaluating(actor) if isinstance(actor, nn.Module) else nullcontext():
            found = _made(folder, config, actor, num_envs, found_suite, progress)
    return found
