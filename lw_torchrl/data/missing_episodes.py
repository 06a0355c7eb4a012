"""Running the episodes that a dataset still lacks, by whoever acts in it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing

import torch
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl._progress import Progress
from lw_torchrl.data.behaviours import segment_plans
from lw_torchrl.data.dataset import CollectConfig
from lw_torchrl.data.episode_files import EpisodeFiles
from lw_torchrl.data.segment_actor import SegmentActor
from lw_torchrl.envs.episodes import in_blocks, run_episodes
from lw_torchrl.envs.experts import ExpertActor
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.modules.policy import Policy
from lw_torchrl.transforms.qaf import QAFTransform

_Acts = Callable[[TensorDictBase], TensorDictBase]

_RECORDED = [
    "observation",
    "task_id",
    "episode",
    "action",
    "expert_action",
    "unclipped_action",
    *(("next", key) for key in ("observation", "task_id", "reward", "success", "done", "terminated", "truncated")),
]
_MAX_ATTEMPTS = 20  # episodes run for each one that is kept, before redrawing gives up


def _take_stock(config: CollectConfig, files: EpisodeFiles) -> tuple[dict[str, list[int]], dict[str, list[int]]]:
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


def _clipped(policy: _Acts) -> _Acts:
    """``policy`` with what it asked for beside what can be done, as :class:`ExpertActor` gives them."""

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        asked = policy(tensordict).get("action")
        return tensordict.set("unclipped_action", asked).set("action", asked.clamp(-1.0, 1.0))

    return run


def _cast(config: CollectConfig, policy: Policy | None, env: LanguageWorldEnv) -> tuple[EnvBase, _Acts]:
    """The environment with what must run before who acts, and who acts."""
    if config.policy.kind == "expert":
        return env, ExpertActor(config.tasks)
    if policy is None:
        plans = segment_plans(config.tasks)
        actor = SegmentActor(config.policy, plans, config.seed, config.max_steps)
        return TransformedEnv(env, QAFTransform(plans)), _clipped(actor)
    transform = policy.transform()
    acts = policy if policy.row_by_row else in_blocks(policy)
    return env if transform is None else TransformedEnv(env, transform), _clipped(acts)


def run_missing_episodes(
    config: CollectConfig, policy: Policy | None, files: EpisodeFiles, num_envs: int | None, progress: bool
) -> dict[str, list[int]]:
    """Run episodes until the files are full; returns the kept ones of each task.

    Args:
        config: what to collect.
        policy: who acts, where the configuration says that a trained one does.
        files: the episodes so far.
        num_envs: environments stepped together.
        progress: show a progress bar.

    Raises:
        OSError: there is no room.
        RuntimeError: redrawing found too few successes.
    """
    kept, wanted = _take_stock(config, files)
    missing = sum(map(len, wanted.values()))
    if not missing:
        return kept
    rows = max(len(config.tasks), min(50, missing)) if num_envs is None else num_envs
    options = {"num_envs": rows, "seed": config.seed, "max_steps": config.max_steps, "strict": policy is not None}
    base = LanguageWorldEnv(config.tasks, reward="dense", **options)  # type: ignore[arg-type]
    env, acts = _cast(config, policy, base)
    scales = [(s, s, s, s * config.gripper_noise_factor) for s in config.noise_scale]
    total = config.episodes_per_task * len(config.tasks)
    before = (total - missing) * config.max_steps
    bar = Progress("collecting", total * config.max_steps, "step", initial=before, show=progress)
    deterministic = set_exploration_type(ExplorationType.DETERMINISTIC)
    with bar, closing(env), torch.no_grad(), deterministic:
        while missing:
            bar.set_done((total - missing) * config.max_steps)  # steps back by the failures that are drawn again
            episodes = run_episodes(
                env,
                acts,
                wanted,
                keys=_RECORDED,
                noise=(lambda n: scales[n % len(scales)]) if any(config.noise_scale) else None,
                noise_hold=config.noise_hold,
                clean_action="expert_action",
                on_progress=bar.update,
            )
            for task, episode, steps in episodes:
                keep = not config.redraw_failures or bool(steps.get(("next", "success")).any())
                files.put(task, episode, _as_rows(steps) if keep else None)
            kept, wanted = _take_stock(config, files)
            missing = sum(map(len, wanted.values()))
    return kept


def _as_rows(steps: TensorDictBase) -> TensorDictBase:
    """Recorded steps with a dataset's columns, the trajectory's number aside."""
    steps.rename_key_(("next", "reward"), ("next", "reward_dense"))
    return steps.set(("next", "reward_sparse"), steps.get(("next", "success")).float())
