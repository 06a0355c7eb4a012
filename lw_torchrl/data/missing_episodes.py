"""The episodes of an unfinished dataset: a file for each one that was run, and running the missing ones."""

import errno
import stat
import zipfile
from collections.abc import Callable, Sequence
from contextlib import closing
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._files import replacing
from lw_torchrl._progress import Progress
from lw_torchrl.data.behaviours import SegmentActor, segment_plans
from lw_torchrl.data.dataset import CollectConfig, DatasetError
from lw_torchrl.data.memory_map import COLUMNS, columns_of, row_bytes
from lw_torchrl.envs.episodes import policy_of, read_action, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import Policy, plans_of, transform_of
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.suites.suite import Suite
from lw_torchrl.transforms.qaf import QAFTransform

_STORED = [key for key in COLUMNS if key != ("collector", "traj_ids")]
_FAILED = b"FAILED"
_HEADERS = 2**16  # bytes of a file beside its rows, at the most
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _file_name(task: str) -> str:
    return task.replace("/", "+")


class EpisodeFiles:
    """The episodes so far, one file each, so that a kill costs only those under way; FAILED stands for one not kept."""

    def __init__(self, folder: Path, tasks: Sequence[str], max_steps: int, layout: Layout = METAWORLD) -> None:
        self.folder, self.max_steps, self.layout = folder, max_steps, layout
        self.tasks = {_file_name(task): task for task in tasks}

    def _path(self, task: str, episode: int) -> Path:
        return self.folder / f"{_file_name(task)}.{episode}.npz"

    def put(self, task: str, episode: int, steps: TensorDictBase | None) -> None:
        content = _FAILED
        if steps is not None:
            stream = BytesIO()
            np.savez(stream, **{"/".join(key): steps.get(key).numpy() for key in _STORED})
            content = stream.getvalue()
        try:
            with replacing(self._path(task, episode), sync=False) as path:  # a damaged one is run again
                path.write_bytes(content)
        except OSError as error:
            raise write_failed(self.folder, len(content), error) from error

    def has(self, task: str, episode: int) -> bool:
        return self._path(task, episode).is_file()

    def kept(self, task: str, episode: int) -> bool:
        return self._path(task, episode).stat().st_size != len(_FAILED)

    def get(self, task: str, episode: int) -> TensorDict:
        """An episode's rows; any exception where the file is damaged."""
        content = self._content(self._path(task, episode))
        with zipfile.ZipFile(BytesIO(content)) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it is compressed")
        with np.load(BytesIO(content), allow_pickle=False) as found:
            columns = {key: torch.from_numpy(found["/".join(key)]) for key in _STORED}
        length = len(columns["episode",])
        for key, column in columns.items():
            tail, dtype = columns_of(self.layout)[key]
            if column.shape != (length, *tail) or column.dtype != dtype:
                raise ValueError(f"{'/'.join(key)} must be {dtype} of shape {(length, *tail)}")
        if not 0 < length <= self.max_steps or (columns["episode",] != episode).any():
            raise ValueError("it is another episode")
        return TensorDict(columns, [length])

    def _content(self, path: Path) -> bytes:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > self.max_steps * row_bytes(self.layout) + _HEADERS:
            raise ValueError("it is no file, or larger than an episode can be")
        return path.read_bytes()

    def drop_damaged(self) -> None:
        """Remove the files that cannot be read, so that their episodes are run again."""
        for path in self.folder.glob("*.npz"):
            task, _, number = path.stem.rpartition(".")
            if task not in self.tasks or not number.isdecimal():
                continue
            if path.is_dir() and not path.is_symlink():
                raise DatasetError(f"root: {str(path)!r} is a folder, and no episode's file; move it elsewhere")
            try:
                if self._content(path) != _FAILED:
                    self.get(self.tasks[task], int(number))
            except Exception:  # whatever is wrong with it, the episode can be run again
                path.unlink()


def write_failed(folder: Path, size: int, error: OSError) -> OSError:
    """The error for something that could not be written while collecting; the caller raises it."""
    until = "there is room" if error.errno in _NO_ROOM else "that is mended"
    what = f"root: writing {size} bytes to {str(folder)!r} failed: {error.strerror or error}. Nothing is lost"
    return OSError(error.errno, f"{what}: once {until}, the same collect_demonstrations carries on")


_Actor = Callable[[TensorDictBase], TensorDictBase]

_RECORDED = [key for key in _STORED if not key[-1].startswith("reward")] + [("next", "reward")]
_MAX_ATTEMPTS = 20  # episodes run for each one that is kept, before redrawing gives up


def _kept_and_missing(config: CollectConfig, files: EpisodeFiles) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
    """The kept episodes of each task, and those still to run; neither ``num_envs`` nor interruptions matter."""
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
            some = f"only {len(kept[task])} of {candidate} episodes of {config.behaviour!r} succeeded"
            raise RuntimeError(f"task {task!r}: {some}; lower the noise_scale or set redraw_failures=False")
        ahead = range(candidate, candidate + missing)
        wanted[task] = [episode for episode in ahead if not files.has(task, episode)]
    return kept, wanted


def _clipped(policy: _Actor, size: int) -> _Actor:
    """``policy`` with ``unclipped_action`` beside ``action``, as of :class:`ExpertActor`."""

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        tensordict = policy(tensordict)
        asked = read_action(tensordict, size)
        return tensordict.set("unclipped_action", asked).set("action", asked.clamp(-1.0, 1.0))

    return run


def _env_and_actor(config: CollectConfig, policy: Any, env: LanguageWorldEnv) -> tuple[EnvBase, _Actor]:
    if config.policy.kind == "expert":
        expert = suite_expert(env.suite, config.tasks)
        if not isinstance(expert, Policy):
            return env, expert
        policy = expert
    if policy is None:
        plans = segment_plans(config.tasks, env.suite)
        actor: _Actor = SegmentActor(config.policy, plans, config.seed, config.max_steps, skills=env.suite.skills)
        transform: Transform | None = QAFTransform(plans)
    else:
        actor, transform = policy_of(policy), transform_of(policy, plans_of(policy))
    seen = env if transform is None else TransformedEnv(env, transform)
    return seen, _clipped(actor, env.layout.action_size)


def suite_expert(suite: Suite, tasks: Sequence[str]) -> Any:
    """A suite's own demonstrator, or its plans, carried out by its scripted skills; ValueError without."""
    if suite.make_expert is not None:
        return suite.make_expert(tasks)
    if suite.plans is None or suite.skills is None:
        raise ValueError(f"policy='expert': suite {suite.name!r} has no plans with scripted skills; give a policy")
    suite.plans.require(tasks)
    return ScriptedSkillActor(Plans([suite.plans[task] for task in tasks]), skills=suite.skills)


def run_missing_episodes(
    config: CollectConfig,
    policy: Any,
    files: EpisodeFiles,
    num_envs: int | None,
    suite: Suite,
    progress: bool,
) -> dict[str, list[int]]:
    """Run episodes until the files hold all; returns the kept ones of each task."""
    kept, wanted = _kept_and_missing(config, files)
    missing = sum(map(len, wanted.values()))
    if not missing:
        return kept
    rows = max(len(config.tasks), min(50, missing)) if num_envs is None else num_envs
    options = {"num_envs": rows, "seed": config.seed, "max_steps": config.max_steps, "strict": policy is not None}
    base = LanguageWorldEnv(config.tasks, suite=suite, reward="dense", **options)  # type: ignore[arg-type]
    env, actor = _env_and_actor(config, policy, base)
    scales = np.array(config.noise_scale)[:, None].repeat(base.layout.action_size, 1)
    scales[:, base.layout.effort] *= config.gripper_noise_factor
    total = config.episodes_per_task * len(config.tasks)
    before = (total - missing) * config.max_steps
    bar = Progress("collecting", total * config.max_steps, "step", initial=before, show=progress)
    deterministic = set_exploration_type(ExplorationType.DETERMINISTIC)
    with bar, closing(env), torch.no_grad(), deterministic:
        while missing:
            bar.set_done((total - missing) * config.max_steps)  # steps back by the failures that are drawn again
            episodes = run_episodes(
                env,
                actor,
                wanted,
                keys=_RECORDED,
                noise=(lambda n: scales[n % len(scales)]) if any(config.noise_scale) else None,
                noise_hold=config.noise_hold,
                clean_action="expert_action",
                on_progress=bar.update,
            )
            for task, episode, steps in episodes:
                keep = not config.redraw_failures or bool(steps.get(("next", "success")).any())
                steps.rename_key_(("next", "reward"), ("next", "reward_dense"))
                steps.set(("next", "reward_sparse"), steps.get(("next", "success")).float())
                files.put(task, episode, steps if keep else None)
            kept, wanted = _kept_and_missing(config, files)
            missing = sum(map(len, wanted.values()))
    return kept
