"""collect_demonstrations: write episodes of an expert, or of another policy, to a dataset; resumable after a kill."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import nullcontext
from numbers import Real
from pathlib import Path

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn

from lw_torchrl._util.checks import differences, typed
from lw_torchrl._util.files import AnyPath, flush, locked, read_json, write_json
from lw_torchrl._util.reproducibility import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import dataset
from lw_torchrl.data.behaviours import Behaviour, behaviour_of
from lw_torchrl.data.dataset import CollectConfig, DatasetError, Demonstrations, write_metadata
from lw_torchrl.data.memory_map import describe_episode, verify, write_rows
from lw_torchrl.data.missing_episodes import EpisodeFiles, run_missing_episodes
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import tasks_of
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks


def _begin(root: Path, config: CollectConfig) -> dict[str, str]:
    """Begin or resume a dataset; return the versions of packages that it was begun with."""
    path = root / dataset.PARTIAL / "begun.json"
    versions = package_versions()
    if not path.is_file():
        write_json(path, {"config": config.to_json(), "versions": versions})
        return versions
    begun = read_json(path, "root: the file")
    _check_same(CollectConfig.from_json(begun["config"]), config, root)
    if changes := version_changes(begun["versions"], SIMULATORS):
        raise DatasetError(
            f"root: {str(root)!r} holds episodes of another simulator ({'; '.join(changes)}); install that version, "
            "choose another folder, or delete it to start again"
        )
    return begun["versions"]


def _check_same(before: CollectConfig, config: CollectConfig, root: Path) -> None:
    if before != config:
        was, now = (one.to_json() | {"policy": one.policy.to_json()} for one in (before, config))
        changes = ", ".join(differences(was, now))
        other = f"root: {str(root)!r} holds a dataset of another configuration ({changes})"
        raise DatasetError(f"{other}; choose another folder, or delete it to start again")


def _assemble(
    root: Path, config: CollectConfig, versions: dict[str, str], files: EpisodeFiles, kept: dict[str, list[int]]
) -> None:
    """Join the episodes' files to a dataset."""
    listed = [(task, episode) for task in config.tasks for episode in kept[task]]
    infos: list[dataset.EpisodeInfo] = []

    def episodes() -> Iterator[TensorDictBase]:
        for number, (task, episode) in enumerate(listed):
            rows = files.get(task, episode)
            rows.set(("collector", "traj_ids"), torch.full(rows.batch_size, number))
            start = infos[-1].start + infos[-1].length if infos else 0
            infos.append(describe_episode(task, episode, start, rows))
            yield rows

    building = files.folder / "rows"
    for old in (building, root / dataset.DATA):
        shutil.rmtree(old, ignore_errors=True)
    write_rows(building, episodes(), config.layout)
    os.replace(building, root / dataset.DATA)
    flush(root)
    attempts = {task: max(kept[task]) + 1 for task in config.tasks}
    task_ids = {task: task_id(task) for task in config.tasks}
    write_metadata(Demonstrations(root, config, versions, task_ids, tuple(infos), attempts))


def _finished(root: Path, config: CollectConfig) -> Demonstrations | None:
    """The finished dataset in a folder, compared with its checksums; None if there is none."""
    if not (root / dataset.METADATA).is_file():
        return None
    demonstrations = dataset.read_metadata(root)
    _check_same(demonstrations.config, config, root)
    verify(demonstrations, demonstrations.episodes)
    return demonstrations


@typed
def collect_demonstrations(
    tasks: str | Iterable[str],
    *,
    episodes_per_task: int,
    root: AnyPath,
    suite: str | Suite | None = None,
    policy: str | Behaviour | TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase] = "expert",
    behaviour: str | None = None,
    seed: int = 0,
    noise_scale: float | Iterable[float] = 0.0,
    noise_hold: int = 1,
    gripper_noise_factor: float = 0.2,
    redraw_failures: bool = False,
    max_steps: int | None = None,
    num_envs: int | None = None,
    progress: bool = True,
) -> Demonstrations:
    """Run Meta-World's scripted experts, or other policies, and write their episodes to a dataset.

    Repeat a call that was killed, or ran out of disk, to resume it. For a finished dataset of the same configuration,
    the call compares all rows with their checksums and returns. The dataset depends neither on ``num_envs`` nor on
    interruptions.

    Each row is a step, in TorchRL's TED layout (R rows):
        observation, next/observation: (R, 39) float32, metres.
        task_id, next/task_id, episode: (R,) int64. collector/traj_ids: (R,) int64, unique per episode.
        action: (R, 4) float32 in [-1, 1], as executed, noise included.
        expert_action: (R, 4) float32 in [-1, 1], the policy's action in the same state without noise;
            unclipped_action: (R, 4) float32, the same before it was clipped.
        next/reward_sparse, next/reward_dense: (R, 1) float32, the success as 0 and 1, and Meta-World's reward.
        next/success, next/done, next/terminated, next/truncated: (R, 1) bool.

    Args:
        tasks: Meta-World tasks, as for :func:`resolve_tasks`, or another suite's; docs/training.md shows own tasks.
        episodes_per_task: number of episodes of each task to keep.
        root: the dataset's folder, new or left by an earlier call.
        suite: the :class:`~lw_torchrl.suites.Suite` of the tasks; None for the suite that their names begin with.
        policy: who acts in the whole dataset. A name in :data:`BEHAVIOURS`: "expert" (Meta-World's script),
            "scripted", "spoilt-60", "spoilt-30", "wrong" or "random"; a :class:`Behaviour`; a trained policy,
            any TensorDictModule or a function, run as :func:`evaluate` runs it: it reads ``observation`` (N, 39)
            float32, ``task_id`` and ``episode`` (N,) int64, and ``qaf`` if it has ``plans``, and writes ``action``
            (N, 4) float32. Its action in a row must depend only on that row. A function is identified by its label
            only: resume with the same function.
        behaviour: the label of the episodes, for :class:`EpisodeFilter`; None for the policy's name. Modules and
            functions need a label.
        seed: random seed (use a different one for evaluation).
        noise_scale: standard deviation of the noise on the executed action; of a sequence, each episode's in turn.
        noise_hold: number of steps for which each noise value is held; longer leads further off the expert's path.
        gripper_noise_factor: factor on the noise of the gripper.
        redraw_failures: keep only successful episodes.
        max_steps: number of steps of an episode; None for the suite's.
        num_envs: environments stepped together.
        progress: show a progress bar if it takes longer than a second.

    Raises:
        DatasetError: (a ValueError) ``root`` holds something else, a damaged dataset, or episodes of another simulator,
            or another process is collecting there.
        OSError: the dataset cannot be written, for example because the disk is full; resume when there is room.
        RuntimeError: redrawing finds too few successes.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        >>> demos.num_steps, demos.success_rate
        (80, {'reach': 1.0})
    """
    tasks = listed_tasks(tasks)
    found_suite = find_suite(tasks, suite)
    names = tuple(found_suite.named_tasks(tasks))
    actor = None if isinstance(policy, (str, Behaviour)) else policy
    known = tasks_of(actor) or names
    if unknown := [task for task in names if task not in known]:
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
    if (demonstrations := _finished(folder, config)) is not None and not partial.is_dir():
        return demonstrations
    is_new = demonstrations is None and folder.is_dir() and not partial.is_dir()
    if is_new and {path.name for path in folder.iterdir()} - {dataset.LOCK}:
        raise DatasetError(f"root: {str(folder)!r} is not empty and holds no dataset; choose another folder")
    lock = locked(folder, "root", "collect_demonstrations", folder=True, error=DatasetError)
    with lock, evaluating(actor) if isinstance(actor, nn.Module) else nullcontext():
        if _finished(folder, config) is None:  # another process may have finished it
            versions, files = _begin(folder, config), EpisodeFiles(partial)
            kept = run_missing_episodes(config, actor, files, num_envs, found_suite, progress)
            _assemble(folder, config, versions, files, kept)
        for left in (partial, *folder.glob(".metadata.*.tmp.json")):  # a killed process may have left the latter
            shutil.rmtree(left, ignore_errors=True) if left.is_dir() else left.unlink(missing_ok=True)
    return dataset.read_metadata(folder)
