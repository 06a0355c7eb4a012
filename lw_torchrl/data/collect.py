"""collect_demonstrations: the experts' episodes as a dataset on disk, resumable after a kill."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from lw_torchrl._checks import check_int, check_scale
from lw_torchrl._files import replacing, write_json
from lw_torchrl._progress import Progress
from lw_torchrl.data.dataset import (
    DATA,
    METADATA,
    PARTIAL,
    CollectConfig,
    DatasetError,
    Demonstrations,
    EpisodeInfo,
    read_metadata,
    write_metadata,
)
from lw_torchrl.envs.episodes import run_episodes
from lw_torchrl.envs.experts import ExpertActor
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.tasks import resolve_tasks

_KEYS = [
    "observation",
    "task_id",
    "episode",
    "action",
    "expert_action",
    "unclipped_action",
    *(("next", key) for key in ("observation", "task_id", "reward", "success", "done", "terminated", "truncated")),
]
_FAILED = b"FAILED"
_MAX_ATTEMPTS = 20  # episodes run for each one that is kept, before redrawing gives up


def _name(key: str | Sequence[str]) -> str:
    return key if isinstance(key, str) else "/".join(key)


class _EpisodeFiles:
    """The episodes so far, one file each; a file that says FAILED stands for one that was not kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def _path(self, task: str, episode: int) -> Path:
        return self.folder / f"{task}.{episode}.npz"

    def put(self, task: str, episode: int, steps: TensorDictBase | None) -> None:
        with replacing(self._path(task, episode)) as path:
            if steps is None:
                path.write_bytes(_FAILED)
            else:
                np.savez(path, **{_name(key): steps.get(key).numpy() for key in _KEYS})

    def has(self, task: str, episode: int) -> bool:
        return self._path(task, episode).is_file()

    def kept(self, task: str, episode: int) -> bool:
        return self._path(task, episode).stat().st_size != len(_FAILED)

    def get(self, task: str, episode: int) -> TensorDict:
        with np.load(self._path(task, episode), allow_pickle=False) as found:
            arrays = {_name(key): torch.from_numpy(found[_name(key)]) for key in _KEYS}
        steps = TensorDict({}, batch_size=arrays["task_id"].shape)
        for key in _KEYS:
            steps.set(key, arrays[_name(key)])
        return steps

    def drop_damaged(self) -> None:
        for path in self.folder.glob("*.npz"):
            if path.read_bytes() == _FAILED:
                continue
            try:
                with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
                    for key in _KEYS:
                        found[_name(key)]  # read it: the checksum tells
            except Exception:  # whatever is wrong with it, the episode can be run again
                path.unlink()


def _open_episode_files(root: Path, config: CollectConfig) -> _EpisodeFiles:
    folder = root / PARTIAL
    stated = folder / "config.json"
    if stated.is_file():
        try:
            before = json.loads(stated.read_text("utf-8"))
        except ValueError as error:
            raise DatasetError(
                f"root: {str(stated)!r} is damaged ({error}); delete {str(root)!r} to start again"
            ) from error
        if before != config.to_json():
            raise DatasetError(
                f"root: {str(root)!r} holds a half-made dataset of another configuration "
                f"({_difference(before, config)}); choose another root, or delete it to start again"
            )
    else:
        if root.is_dir() and any(root.iterdir()) and not folder.is_dir():
            raise DatasetError(f"root: {str(root)!r} is not empty and holds no dataset; choose another folder")
        folder.mkdir(parents=True, exist_ok=True)
        write_json(stated, config.to_json())
    files = _EpisodeFiles(folder)
    files.drop_damaged()
    return files


def _difference(before: dict, config: CollectConfig) -> str:
    now = config.to_json()
    return ", ".join(f"{key} {before.get(key)!r}, now {now[key]!r}" for key in now if before.get(key) != now[key])


def _take_stock(config: CollectConfig, files: _EpisodeFiles) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """The kept episodes of each task, and those still to run. Candidates are taken in the order of their index, so
    which are kept depends neither on the number of environments nor on interruptions."""
    kept: dict[str, list[int]] = {}
    wanted: dict[str, list[int]] = {}
    for task in config.tasks:
        kept[task], candidate = [], 0
        while len(kept[task]) < config.episodes_per_task and files.has(task, candidate):
            if files.kept(task, candidate):
                kept[task].append(candidate)
            candidate += 1
        missing = config.episodes_per_task - len(kept[task])
        if missing and candidate >= config.episodes_per_task * _MAX_ATTEMPTS:
            raise RuntimeError(
                f"task {task!r}: only {len(kept[task])} of {candidate} episodes succeeded; lower the noise_scale or "
                "set redraw_failures=False"
            )
        ahead = range(candidate, candidate + missing)
        wanted[task] = [episode for episode in ahead if not files.has(task, episode)]
    return kept, wanted


def _run(config: CollectConfig, files: _EpisodeFiles, num_envs: int | None, progress: bool) -> dict[str, list[int]]:
    """Run episodes until the files is full; returns the kept ones of each task."""
    kept, wanted = _take_stock(config, files)
    missing = sum(map(len, wanted.values()))
    if not missing:
        return kept
    rows = max(len(config.tasks), min(50, missing)) if num_envs is None else num_envs
    env = LanguageWorldEnv(config.tasks, num_envs=rows, seed=config.seed, max_steps=config.max_steps, reward="dense")
    policy = ExpertActor(config.tasks)
    scales = [(s, s, s, s * config.gripper_noise_factor) for s in config.noise_scale]
    total = config.episodes_per_task * len(config.tasks)
    before = (total - missing) * config.max_steps
    bar = Progress("collecting", total * config.max_steps, "step", initial=before, show=progress)
    with bar:
        while missing:
            bar.set_done((total - missing) * config.max_steps)  # steps back by the failures that are drawn again
            episodes = run_episodes(
                env,
                policy,
                wanted,
                keys=_KEYS,
                noise=(lambda n: scales[n % len(scales)]) if any(config.noise_scale) else None,
                noise_hold=config.noise_hold,
                clean_action="expert_action",
                on_progress=bar.update,
            )
            for task, episode, steps in episodes:
                keep = not config.redraw_failures or bool(steps.get(("next", "success")).any())
                files.put(task, episode, steps if keep else None)
            kept, wanted = _take_stock(config, files)
            missing = sum(map(len, wanted.values()))
    env.close()
    return kept


def _assemble(root: Path, config: CollectConfig, files: _EpisodeFiles, kept: dict[str, list[int]]) -> list[EpisodeInfo]:
    building = root / f"{PARTIAL}/rows"
    shutil.rmtree(building, ignore_errors=True)
    listed = [(task, episode) for task in config.tasks for episode in kept[task]]
    infos: list[EpisodeInfo] = []
    rows: TensorDictBase | None = None
    start = 0
    for number, (task, episode) in enumerate(listed):
        steps = files.get(task, episode)
        steps.set(("collector", "traj_ids"), torch.full(steps.batch_size, number))
        steps.rename_key_(("next", "reward"), ("next", "reward_dense"))
        steps.set(("next", "reward_sparse"), steps.get(("next", "success")).float())
        length = steps.batch_size[0]
        if rows is None:
            total = length * len(listed)  # episodes end by truncation alone, so all are equally long
            rows = steps[0].expand(total).memmap_like(building)
        rows[start : start + length] = steps
        successes = steps.get(("next", "success")).flatten().nonzero().flatten()
        first = int(successes[0]) + 1 if len(successes) else None
        infos.append(EpisodeInfo(task, episode, start, length, first is not None, first))
        start += length
    shutil.rmtree(root / DATA, ignore_errors=True)
    os.replace(building, root / DATA)
    return infos


def collect_demonstrations(
    tasks: str | Iterable[str],
    *,
    episodes_per_task: int,
    root: str | os.PathLike[str],
    seed: int = 0,
    noise_scale: float | Sequence[float] = 0.0,
    noise_hold: int = 1,
    gripper_noise_factor: float = 0.2,
    redraw_failures: bool = False,
    max_steps: int = 500,
    num_envs: int | None = None,
    progress: bool = True,
) -> Demonstrations:
    """Run Meta-World's scripted experts and write their episodes to a dataset.

    Killed and called again it carries on; called on a finished dataset of the same configuration it returns at
    once. The dataset does not depend on ``num_envs`` or on interruptions.

    Each row is a step, in TorchRL's TED layout (R rows):
        observation: (R, 39) float32, metres; next/observation likewise.
        task_id, episode: (R,) int64; next/task_id likewise. collector/traj_ids: (R,) int64, unique per episode.
        action: (R, 4) float32 in [-1, 1], as executed, noise included.
        expert_action: (R, 4) float32 in [-1, 1], what the expert wanted in the same state; unclipped_action: (R, 4)
            float32, what its script asked for.
        next/reward_sparse, next/reward_dense: (R, 1) float32, the success as 0 and 1, and Meta-World's reward.
        next/success, next/done, next/terminated, next/truncated: (R, 1) bool.

    Args:
        tasks: as for :func:`resolve_tasks`.
        episodes_per_task: how many episodes of each task to keep.
        root: the dataset's folder, new or left by an earlier call.
        seed: evaluate on another one.
        noise_scale: standard deviation of the noise on the executed action; a sequence is gone through in turn, one
            an episode.
        noise_hold: the steps for which each draw of the noise is kept; the longer, the further it leads the expert
            astray, and the more a policy learns of the way back.
        gripper_noise_factor: multiplies the noise on the gripper.
        redraw_failures: keep only successful episodes.
        max_steps: steps of an episode.
        num_envs: environments stepped together.
        progress: show a progress bar when it takes longer than a second.

    Returns:
        The finished dataset's description.

    Raises:
        ValueError: a wrong argument; DatasetError where ``root`` holds something else.
        RuntimeError: redrawing found too few successes.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        >>> demos.num_steps, demos.success_rate
        (80, {'reach': 1.0})
    """
    scales = (noise_scale,) if isinstance(noise_scale, (int, float)) else tuple(noise_scale)
    if not scales:
        raise ValueError("noise_scale must hold at least one number, got an empty sequence")
    config = CollectConfig(
        tasks=resolve_tasks(tasks),
        episodes_per_task=check_int("episodes_per_task", episodes_per_task, minimum=1),
        seed=check_int("seed", seed),
        noise_scale=tuple(check_scale("noise_scale", scale) for scale in scales),
        noise_hold=check_int("noise_hold", noise_hold, minimum=1),
        gripper_noise_factor=check_scale("gripper_noise_factor", gripper_noise_factor),
        redraw_failures=bool(redraw_failures),
        max_steps=check_int("max_steps", max_steps, minimum=1),
    )
    folder = Path(root)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"root must be a folder, {str(folder)!r} is a file")
    if (folder / METADATA).is_file():
        found = read_metadata(folder)
        if found.config != config:
            raise DatasetError(
                f"root: {str(folder)!r} holds a dataset of another configuration "
                f"({_difference(found.config.to_json(), config)}); choose another folder"
            )
        shutil.rmtree(folder / PARTIAL, ignore_errors=True)
        return found
    files = _open_episode_files(folder, config)
    kept = _run(config, files, num_envs, progress)
    infos = _assemble(folder, config, files, kept)
    attempts = {task: max(kept[task]) + 1 for task in config.tasks}
    write_metadata(folder, config, infos, attempts)
    shutil.rmtree(folder / PARTIAL, ignore_errors=True)
    return read_metadata(folder)
