"""The episodes of an unfinished dataset: a file for each finished episode, and running the missing ones."""

from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._util.files import replacing
from lw_torchrl._util.progress import Progress
from lw_torchrl.data.behaviours import SegmentActor, segment_plans
from lw_torchrl.data.dataset import CollectConfig, DatasetError
from lw_torchrl.data.memory_map import COLUMNS
from lw_torchrl.envs.episodes import policy_of, read_action, run_episodes
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules.policy import plans_of, transform_of
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.suites.suite import Suite
from lw_torchrl.transforms.qaf import QAFTransform

_STORED = [key for key in COLUMNS if key != ("collector", "traj_ids")]
_FAILED = b"FAILED"


class EpisodeFiles:
    """A file for each episode, so that a kill loses only running episodes. FAILED marks a failure to redraw."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def _path(self, task: str, episode: int) -> Path:
        return self.folder / f"{task.replace('/', '+')}.{episode}.npz"

    def put(self, task: str, episode: int, steps: TensorDictBase | None) -> None:
        with replacing(self._path(task, episode), sync=False) as path, path.open("wb") as file:
            if steps is None:
                file.write(_FAILED)
            else:
                np.savez(file, **{"/".join(key): steps.get(key).numpy() for key in _STORED})

    def has(self, task: str, episode: int) -> bool:
        return self._path(task, episode).is_file()

    def kept(self, task: str, episode: int) -> bool:
        return self._path(task, episode).stat().st_size != len(_FAILED)

    def get(self, task: str, episode: int) -> TensorDict:
        """The rows of an episode; DatasetError if its file is damaged."""
        path = self._path(task, episode)
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
                columns = {key: torch.from_numpy(arrays["/".join(key)]) for key in _STORED}
            return TensorDict(columns, [len(columns["episode",])])
        except Exception as error:  # zipfile and numpy raise many kinds of errors
            raise DatasetError(f"root: {str(path)!r} is damaged ({error}); delete this file to run it again") from error


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
        if plans_of(expert) is None:
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
