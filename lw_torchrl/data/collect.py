"""collect_demonstrations: run an expert or another policy, and write the episodes to a dataset.

After an interruption, a later call resumes from these files:

root/.partial/begun.json    the config and the package versions
root/.partial/*.npz         one file per finished episode, so that a killed process loses only the running episodes
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, nullcontext
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._util.checks import Count, Scale, typed
from lw_torchrl._util.devices import CPU, device_of
from lw_torchrl._util.files import AnyPath, check_damage, flush, locked, read_json, replacing, write_json
from lw_torchrl._util.progress import Progress
from lw_torchrl._util.reproducibility import SIMULATORS, differences, package_versions, version_changes
from lw_torchrl._util.workers import Episodes, spread
from lw_torchrl.data import dataset
from lw_torchrl.data.collection_policy import Behaviour, SegmentActor, behaviour_of, segment_plans
from lw_torchrl.data.dataset import COLUMNS, TRAJECTORY, CollectConfig, DatasetError, Demonstrations
from lw_torchrl.envs.episodes import num_rows, policy_of, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.rows import read_action
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.parts import evaluating
from lw_torchrl.modules.policy import plans_of, tasks_of, transform_of
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks
from lw_torchrl.transforms.qaf import QAFTransform

_STORED = [key for key in COLUMNS if key != TRAJECTORY]
_RECORDED = [key for key in _STORED if not key[-1].startswith("reward")] + [("next", "reward")]
_FAILED = b"FAILED"  # the file content that marks a failed episode, which is replaced by another episode
_ROWS = 64  # environments stepped together; with more, an interruption would lose more work
_INSTEAD = "choose another folder, or delete this folder to start again"
_MAX_ATTEMPTS = 20  # number of episodes to run per kept episode before redrawing gives up

_Actor = Callable[[TensorDictBase], TensorDictBase]


class EpisodeFiles:
    """A folder with one file for each finished episode."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def _path(self, task: str, episode: int) -> Path:
        return self.folder / f"{task.replace('/', '+')}.{episode}.npz"

    def put(self, task: str, episode: int, steps: TensorDictBase | None) -> None:
        """Write the rows of an episode, or, if ``steps`` is None, a mark that the episode failed and is not kept."""
        with replacing(self._path(task, episode), sync=False) as path, path.open("wb") as file:
            if steps is None:
                file.write(_FAILED)
            else:
                np.savez(file, **{"/".join(key): steps.get(key).numpy() for key in _STORED})

    def has(self, task: str, episode: int) -> bool:
        return self._path(task, episode).is_file()

    def is_kept(self, task: str, episode: int) -> bool:
        return self._path(task, episode).stat().st_size != len(_FAILED)

    def get(self, task: str, episode: int) -> TensorDict:
        """Read the rows of an episode; raise DatasetError if the file is corrupted."""
        path = self._path(task, episode)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                columns = {key: torch.from_numpy(arrays["/".join(key)]) for key in _STORED}
            return TensorDict(columns, [len(columns["episode",])])
        except Exception as error:  # zipfile and numpy raise many kinds of errors for corrupted files
            check_damage(error)
            message = f"root: {str(path)!r} is corrupted ({error}); delete this file to run the episode again"
            raise DatasetError(message) from error


def _kept_and_missing(config: CollectConfig, files: EpisodeFiles) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """Return the kept episodes and the missing episodes of each task, independent of ``num_envs`` and interruptions."""
    kept: dict[str, list[int]] = {}
    wanted: dict[str, list[int]] = {}
    for task in config.tasks:
        kept[task], candidate = [], 0
        while len(kept[task]) < config.episodes_per_task and files.has(task, candidate):
            if files.is_kept(task, candidate):
                kept[task].append(candidate)
            candidate += 1
        missing = config.episodes_per_task - len(kept[task])
        if missing and candidate >= config.episodes_per_task * _MAX_ATTEMPTS:
            problem = f"task {task!r}: only {len(kept[task])} of {candidate} episodes of {config.behaviour!r} succeeded"
            raise RuntimeError(f"{problem}; lower noise_scale, or set redraw_failures=False")
        ahead = range(candidate, candidate + missing)
        if listed := [episode for episode in ahead if not files.has(task, episode)]:
            wanted[task] = listed
    return kept, wanted


def _clipped(policy: _Actor, size: int) -> _Actor:
    """Wrap ``policy`` to clip its action, and to write the action before clipping as ``unclipped_action``."""

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        action = read_action(tensordict, size)
        return tensordict.set("unclipped_action", action).set("action", action.clamp(-1.0, 1.0))

    return run


def _env_and_actor(config: CollectConfig, policy: Any, env: LanguageWorldEnv) -> tuple[EnvBase, _Actor]:
    """Return the environment with the transform that the policy requires, and the policy."""
    if config.policy.kind == "expert":
        policy = suite_expert(env.suite, config.tasks)
        if plans_of(policy) is None:
            return env, policy
    if policy is None:
        plans = segment_plans(config.tasks, env.suite)
        actor: _Actor = SegmentActor(config.policy, plans, config.seed, config.max_steps, skills=env.suite.skills)
        transform: Transform | None = QAFTransform(plans)
    else:
        actor, transform = policy_of(policy), transform_of(policy, plans_of(policy))
    transformed = env if transform is None else TransformedEnv(env, transform)
    return transformed, _clipped(actor, env.layout.action_size)


def suite_expert(suite: Suite, tasks: Sequence[str]) -> Any:
    """Return a suite's expert, or else an actor with the suite's scripted skills; raise ValueError without either."""
    if suite.make_expert is not None:
        return suite.make_expert(tasks)
    if suite.plans is None or suite.skills is None:
        raise ValueError(f"policy='expert': suite {suite.name!r} has no plans with scripted skills; pass a policy")
    return ScriptedSkillActor(segment_plans(tasks, suite), skills=suite.skills)


def run_missing_episodes(
    config: CollectConfig,
    policy: Any,
    files: EpisodeFiles,
    num_envs: int | None,
    suite: Suite,
    progress: bool,
    workers: int | None = 1,
) -> dict[str, list[int]]:
    """Run the missing episodes, write them to the files, and return the kept episodes' indices by task."""

    def run(part: Episodes, on_steps: Callable[[int], object]) -> Iterator[None]:
        """Run episodes and write each to its file."""
        # Record only the dense reward, because the sparse reward can be computed from success.
        options: dict[str, Any] = {"suite": suite, "seed": config.seed, "max_steps": config.max_steps}
        options |= {"num_envs": num_rows(part, _ROWS, num_envs), "reward": "dense", "strict": policy is not None}
        env, actor = _env_and_actor(config, policy, LanguageWorldEnv(list(part), **options))
        scales = np.array(config.noise_scale)[:, None].repeat(config.layout.action_size, 1)
        scales[:, config.layout.effort] *= config.gripper_noise_factor
        noise = (lambda n: scales[n % len(scales)]) if any(config.noise_scale) else None
        how: dict[str, Any] = {"noise": noise, "noise_hold": config.noise_hold, "clean_action": "expert_action"}
        mode = evaluating(policy) if isinstance(policy, nn.Module) else nullcontext()
        with closing(env), mode, torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            for task, episode, steps in run_episodes(env, actor, part, keys=_RECORDED, on_progress=on_steps, **how):
                keep = not config.redraw_failures or bool(steps.get(("next", "success")).any())
                steps.rename_key_(("next", "reward"), ("next", "reward_dense"))
                steps.set(("next", "reward_sparse"), steps.get(("next", "success")).float())
                files.put(task, episode, steps if keep else None)
                yield

    total = config.episodes_per_task * len(config.tasks)
    kept, wanted = _kept_and_missing(config, files)
    before = (total - sum(map(len, wanted.values()))) * config.max_steps
    alone = not isinstance(policy, nn.Module | None) or device_of(policy) != CPU
    with Progress("collecting", total * config.max_steps, "step", initial=before, show=progress) as bar:
        while wanted:
            # Keep the parts small, because an interrupted collection loses the episodes of unfinished parts.
            limits: dict[str, Any] = {"workers": workers, "max_steps": config.max_steps, "largest": 64}
            with closing(spread(run, wanted, bar.update, alone=alone, **limits)) as written:
                for _ in written:
                    pass
            kept, wanted = _kept_and_missing(config, files)
            # Move the progress back by the failed episodes, which other episodes replace.
            bar.update((total - sum(map(len, wanted.values()))) * config.max_steps - bar.done)
    return kept


def _begin(root: Path, config: CollectConfig) -> dict[str, str]:
    """Start or resume a dataset, and return the package versions at the start of the collection."""
    path = root / dataset.PARTIAL / "begun.json"
    versions = package_versions()
    if not path.is_file():
        write_json(path, {"config": config.to_json(), "versions": versions})
        return versions
    begun = read_json(path, "root: the file")
    _check_same(CollectConfig.from_json(begun["config"]), config, root)
    if changes := "; ".join(version_changes(begun["versions"], SIMULATORS)):
        raise DatasetError(f"root: {str(root)!r} holds episodes of another simulator ({changes}); {_INSTEAD}")
    return begun["versions"]


def _check_same(before: CollectConfig, config: CollectConfig, root: Path) -> None:
    if before != config:
        was, now = (each.to_json() | {"policy": each.policy.to_json()} for each in (before, config))
        changes = ", ".join(differences(was, now))
        raise DatasetError(f"root: {str(root)!r} holds a dataset with another configuration ({changes}); {_INSTEAD}")


def _assemble(
    root: Path, config: CollectConfig, versions: dict[str, str], files: EpisodeFiles, kept: dict[str, list[int]]
) -> None:
    """Combine the episodes' files into a dataset."""
    episodes = ((task, episode, files.get(task, episode)) for task in config.tasks for episode in kept[task])
    building = files.folder / "rows"
    # Rename the folder of rows when it is complete; the metadata file, written last, marks the dataset as finished.
    for old in (building, root / dataset.DATA):
        shutil.rmtree(old, ignore_errors=True)
    infos = dataset.write_rows(building, episodes, config.layout)
    os.replace(building, root / dataset.DATA)
    flush(root)
    attempts = {task: max(kept[task]) + 1 for task in config.tasks}
    task_ids = {task: task_id(task) for task in config.tasks}
    dataset.write_metadata(Demonstrations(root, config, versions, task_ids, infos, attempts))


def _finished(root: Path, config: CollectConfig) -> Demonstrations | None:
    """Verify and return the finished dataset in a folder; return None if there is none."""
    if not (root / dataset.METADATA).is_file():
        return None
    demonstrations = dataset.read_metadata(root)
    _check_same(demonstrations.config, config, root)
    dataset.verify(demonstrations, demonstrations.episodes)
    return demonstrations


@typed
def collect_demonstrations(
    tasks: str | Iterable[str],
    *,
    episodes_per_task: Count,
    root: AnyPath,
    suite: str | Suite | None = None,
    policy: str | Behaviour | TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase] = "expert",
    behaviour: str | None = None,
    seed: int = 0,
    noise_scale: float | Iterable[float] = 0.0,
    noise_hold: Count = 1,
    gripper_noise_factor: Scale = 0.2,
    redraw_failures: bool = False,
    max_steps: Count | None = None,
    num_envs: Count | None = None,
    workers: Count | None = None,
    progress: bool = True,
) -> Demonstrations:
    """Run Meta-World's scripted experts, or other policies, and write their episodes to a dataset.

    If a call was killed or ran out of disk space, repeat the call to resume. If a finished dataset with the same config
    exists, the call only verifies its checksums. The dataset does not depend on ``num_envs``, ``workers`` or
    interruptions.

    Each row is one time step, in TorchRL's TED layout (R rows):
        observation, next/observation: (R, 39) float32, metres.
        task_id, next/task_id, episode: (R,) int64. collector/traj_ids: (R,) int64, unique per episode.
        action: (R, 4) float32 in [-1, 1], the executed action, including noise.
        expert_action: (R, 4) float32 in [-1, 1], the policy's action in the same state without noise;
            unclipped_action: (R, 4) float32, the policy's action before clipping.
        next/reward_sparse, next/reward_dense: (R, 1) float32, the success as 0 or 1, and Meta-World's reward.
        next/success, next/done, next/terminated, next/truncated: (R, 1) bool.

    Args:
        tasks: Meta-World's, as for :func:`resolve_tasks`, or another suite's; docs/your-robot.md explains custom tasks.
        episodes_per_task: number of episodes of each task to keep.
        root: the dataset's folder; a new folder, or a folder that an earlier call created.
        suite: the :class:`~lw_torchrl.suites.Suite` of the tasks; None to derive the suite from the tasks' names.
        policy: the collection policy: a name in :data:`BEHAVIOURS` ("expert", "scripted", "noisy-60", "noisy-30",
            "wrong" or "random"); a :class:`Behaviour`; or a trained policy, any TensorDictModule or function, which is
            run as in :func:`evaluate`. A trained policy reads ``observation`` (N, 39) float32, ``task_id`` and
            ``episode`` (N,) int64, and ``qaf`` if it has ``plans``, and writes ``action`` (N, 4) float32, whose rows
            must be computed independently. A function is identified only by its label: resume with the same function.
        behaviour: the label of the episodes, for :class:`EpisodeFilter`; None for the policy's name. Required for
            modules and functions.
        seed: random seed (use a different one for evaluation).
        noise_scale: standard deviation of the noise on the executed action; a sequence is cycled over the episodes.
        noise_hold: number of time steps for which each noise value is held; larger values lead further away from
            the expert's path.
        gripper_noise_factor: factor on the noise of the gripper.
        redraw_failures: keep only successful episodes, and replace failed ones.
        max_steps: number of time steps per episode; None for the suite's default.
        num_envs: number of environments stepped together; None to choose the number automatically.
        workers: number of processes to split the episodes over, 1 for this process only; None for one per core if that
            saves time (from about 300,000 time steps on two cores, 70,000 on 16). With None, a function or a policy
            on a GPU stays in this process.
        progress: show a progress bar if the collection takes longer than a second.

    Raises:
        DatasetError: (a ValueError) ``root`` holds other files, a corrupted dataset or episodes of another simulator,
            or another process is collecting in ``root``.
        OSError: the dataset cannot be written, for example because the disk is full; free space and repeat the call.
        RuntimeError: too few episodes succeed to redraw the failures.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=80)
        >>> demos.num_steps, demos.success_rate
        (80, {'reach': 1.0})
    """
    tasks = listed_tasks(tasks)
    suite = find_suite(tasks, suite)
    names = tuple(suite.named_tasks(tasks))
    actor = None if isinstance(policy, (str, Behaviour)) else policy
    known = tasks_of(actor) or names
    if unknown := [task for task in names if task not in known]:
        raise ValueError(f"tasks must be among the policy's tasks ({', '.join(known)}), got {', '.join(unknown)}")
    config = CollectConfig(
        tasks=names,
        episodes_per_task=episodes_per_task,
        seed=seed,
        noise_scale=(noise_scale,) if isinstance(noise_scale, (float, Real)) else tuple(noise_scale),
        noise_hold=noise_hold,
        gripper_noise_factor=gripper_noise_factor,
        redraw_failures=bool(redraw_failures),
        max_steps=suite.max_steps if max_steps is None else max_steps,
        layout=suite.layout,
        policy=behaviour_of(policy, names, behaviour, suite),
    )
    folder, partial = Path(root), Path(root, dataset.PARTIAL)
    if (demonstrations := _finished(folder, config)) is not None and not partial.is_dir():
        return demonstrations
    is_new = demonstrations is None and folder.exists() and not partial.is_dir()
    if is_new and (not folder.is_dir() or {path.name for path in folder.iterdir()} - {dataset.LOCK}):
        raise DatasetError(f"root: {str(folder)!r} is not empty, but holds no dataset; choose another folder")
    with locked(folder, "root", "collect_demonstrations", folder=True, error=DatasetError):
        if _finished(folder, config) is None:  # another process may have finished the dataset in the meantime
            versions, files = _begin(folder, config), EpisodeFiles(partial)
            kept = run_missing_episodes(config, actor, files, num_envs, suite, progress, workers)
            _assemble(folder, config, versions, files, kept)
        for left in (partial, *folder.glob(".metadata.*.tmp")):  # a killed process may have left the latter
            shutil.rmtree(left, ignore_errors=True)
    return dataset.read_metadata(folder)
