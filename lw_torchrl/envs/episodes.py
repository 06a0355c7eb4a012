"""run_episodes: run exactly the requested episodes on any number of parallel environments.

Data collection and evaluation use this function.
"""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import EnvBase, TransformedEnv, step_mdp

from lw_torchrl._util.checks import check_value
from lw_torchrl._util.devices import CPU, in_blocks, place
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.envs.rows import action_noise


def first_success(success: Tensor) -> int | None:
    """Return the first successful time step of ``success`` (T, 1) bool, counted from 1; None without success."""
    successes = success.flatten().nonzero().flatten()
    return int(successes[0]) + 1 if len(successes) else None


class FinishedEpisode(NamedTuple):
    """A finished episode: its task's name, its index, and the recorded keys of its T time steps (batch size (T,))."""

    task: str
    episode: int
    steps: TensorDictBase

    @property
    def first_success(self) -> int | None:
        """The first successful time step, counted from 1, or None; ``steps`` must have ("next", "success")."""
        return first_success(self.steps.get(("next", "success")))


def num_rows(episodes: Mapping[str, Sequence[int]], most: int, num_envs: int | None = None) -> int:
    """Return the number of environments to step together: ``num_envs``, or by default about ``most``, divided equally
    among the tasks. It is at most the number of tasks times the most episodes of a task."""
    tasks, longest = len(episodes), max(map(len, episodes.values()))
    return min(tasks * longest, tasks * max(1, most // tasks) if num_envs is None else num_envs)


def policy_of(actor: Any, device: str | torch.device | None = None) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return an actor as a policy that runs on ``device``. Networks process blocks of a fixed number of rows, so that
    rows do not affect each other."""
    actor_device = place(actor, device)
    policy = actor if getattr(actor, "row_by_row", False) else in_blocks(actor)
    if actor_device == CPU:
        return policy
    return lambda tensordict: tensordict.update(policy(tensordict.to(actor_device)).to(CPU))


def run_episodes(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    episodes: Mapping[str, Sequence[int]],
    *,
    keys: Sequence[NestedKey],
    noise: Callable[[int], Sequence[float]] | None = None,
    noise_hold: int = 1,
    after_success: int | None = None,
    clean_action: NestedKey | None = None,
    place: NestedKey | None = None,
    on_progress: Callable[[int], object] | None = None,
) -> Iterator[FinishedEpisode]:
    """Run each task's listed episodes and yield them as they finish.

    A row whose episode ends starts the next episode of its task.

    Args:
        env: a LanguageWorldEnv, with or without transforms.
        policy: a function of a TensorDict of all N rows, in which the mask ``_step`` (N,) bool marks the active rows.
        episodes: a mapping from task name to episode indices; an index listed twice is run twice.
        keys: the keys to record at each time step, such as ``("next", "success")``. The recorded ``action`` is the
            executed action.
        noise: a function that maps an episode index to the standard deviations (A,) of the noise on the action; None
            for no noise.
        noise_hold: number of time steps for which each noise value stays the same.
        after_success: end an episode N time steps after its first success; None to never end early.
        clean_action: the key under which to store the action before noise is added; None to not store it.
        place: the key under which the policy finds the position (N,) int64 of each row's episode in the list of its
            task; None to omit it.
        on_progress: called after each step with the number of new time steps, including those skipped by an early end.
    """
    base = check_value("env", env.base_env if isinstance(env, TransformedEnv) else env, LanguageWorldEnv)
    rows = len(base.row_tasks)
    waiting = {task: deque(enumerate(listed)) for task, listed in episodes.items()}
    if unknown := set(waiting) - set(base.tasks):
        raise ValueError(f"episodes: env lacks the tasks {', '.join(sorted(unknown))}")
    episode, listed_at = torch.zeros(2, rows, dtype=torch.int64)
    active = torch.zeros(rows, dtype=torch.bool)
    steps = np.zeros(rows, dtype=np.int64)
    last = np.zeros(rows, dtype=np.int64)  # the time step after which an episode ends early
    noises = np.zeros((rows, base.max_steps, base.layout.action_size), dtype=np.float32)
    buffers: TensorDictBase | None = None
    state: TensorDictBase = env.full_done_spec.zero()
    idle = torch.ones(rows, dtype=torch.bool)
    is_first = True  # the first reset covers all rows, because policies also read the task of idle rows
    while True:
        starting = torch.zeros(rows, dtype=torch.bool)
        for row in torch.nonzero(idle).flatten().tolist():
            if queue := waiting.get(base.row_tasks[row]):
                listed_at[row], number = queue.popleft()
                episode[row], starting[row], steps[row], last[row] = number, True, 0, base.max_steps
                if noise is not None:
                    scale = np.asarray(noise(number), dtype=np.float32)
                    noises[row] = scale * action_noise(
                        base.task_of_row[row], base.seed, number, base.max_steps, noise_hold, base.layout.action_size
                    )
        active = (active & ~idle) | starting
        if not active.any():
            return
        if starting.any():
            reset = torch.ones_like(starting) if is_first else starting
            state, is_first = env.reset(state.set("_reset", reset), episode=episode).exclude("_reset"), False
        state.set("_step", active)
        if place is not None:
            state.set(place, listed_at.clone())
        state = policy(state)
        action = state.get("action")
        if clean_action is not None:
            state.set(clean_action, action.clone())
        if noise is not None:
            noise_now = noises[np.arange(rows), np.minimum(steps, base.max_steps - 1)]
            action = (action + torch.from_numpy(noise_now)).clamp(-1.0, 1.0)
        # Idle rows get a zero action: the policy may have computed their actions from stale states.
        state.set("action", torch.where(active.unsqueeze(-1), action, 0.0))
        state.set("_step", active)
        state = env.step(state)
        state.set("action", state.get(("next", "executed_action")))
        recorded = state.select(*keys)
        if buffers is None:
            buffers = recorded.unsqueeze(1).expand(rows, base.max_steps).clone()
        live = torch.nonzero(active).flatten()
        buffers[live, torch.from_numpy(steps)[live]] = recorded[live]
        steps[live.numpy()] += 1
        following = state.get("next")
        ended = following.get("done").squeeze(-1)
        if after_success is not None:
            success = following.get("success").squeeze(-1).numpy()
            last = np.where(success, np.minimum(last, steps + after_success), last)
            ended = ended | torch.from_numpy(steps >= last)
        idle = ended & active
        if on_progress is not None:
            on_progress(int(active.sum()) + int((base.max_steps - steps)[idle.numpy()].sum()))
        for row in torch.nonzero(idle).flatten().tolist():
            yield FinishedEpisode(base.row_tasks[row], int(episode[row]), buffers[row, : steps[row]].clone())
        idle = idle | ~active
        state = step_mdp(state, exclude_action=True, keep_other=True)
