"""LanguageWorldEnv: Meta-World's tasks as one natively batched TorchRL environment."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterable
from typing import Any, Literal

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from lw_torchrl._checks import check_choice, check_int
from lw_torchrl.envs.engine import ACTION_SIZE, OBSERVATION_SIZE, Engine
from lw_torchrl.envs.engines.metaworld import MetaWorldEngine
from lw_torchrl.envs.engines.vectorized.engine import VectorizedEngine
from lw_torchrl.envs.seeding import episode_seed
from lw_torchrl.language.tasks import resolve_tasks, task_id

ENGINES: dict[str, Callable[..., Engine]] = {"vectorized": VectorizedEngine, "metaworld": MetaWorldEngine}


def _make_engine(engine: str | Callable[..., Engine], rows: list[str], **options: Any) -> Engine:
    if callable(engine):
        return engine(rows, **options)
    return ENGINES[check_choice("engine", engine, ENGINES)](rows, **options)


class LanguageWorldEnv(EnvBase):
    """N environments over any mixture of the 50 tasks, stepped together, by the MT50-rand protocol: a random
    initial state and goal at every reset, the goal observed, 500 steps, ended by truncation alone.

    Row i keeps the task ``tasks[i % n]`` for life. The m-th reset of the r-th of a task's R rows is that task's
    episode m·R + r, unless the reset tensordict's ``episode`` names another. An episode starts as Meta-World's
    own environment does after ``env.seed(episode_seed(task, seed, episode)); env.reset()``, whatever ran before
    or beside it.

    Keys (B = (N,)):
        observation: (N, 39) float32, Meta-World's vector: metres, gripper opening in [0, 1], quaternions.
        task_id: (N,) int64, rank of the task's name among the 50 sorted names.
        episode: (N,) int64, index of the episode.
        success: (N, 1) bool, Meta-World's success at this step.
        fault: (N, 1) bool, the row was truncated because its action was NaN or its simulation became unstable.
        action: (N, 4) float32, end-effector displacement xyz and gripper effort, each in [-1, 1]. The environment never
            writes it: a policy's numbers out of range stay as they were sampled, so that their likelihood stays true.
        executed_action: (N, 4) float32 in [-1, 1], what was done in the step that led here: the action, clipped as
            Meta-World does. Zeros after a reset, and for a row that was not stepped.
        reward: (N, 1) float32; done, terminated, truncated: (N, 1) bool, terminated always false.

    A ``_step`` mask leaves rows where they are; a ``_reset`` mask resets only its rows.

    Args:
        tasks: "MT10", "MT50", a task's name, or a list of names.
        num_envs: N, at least the number of tasks; None for one environment each.
        seed: any integer; :meth:`set_seed` starts again at episode 0.
        engine: "vectorized", the fast one; "metaworld" for Meta-World's own environments in a loop, which gives the
            same numbers; or a callable ``(row_tasks, *, reward, num_threads) -> Engine``.
        num_threads: of the simulation, by default the cores this process may use; never changes a result.
        reward: "sparse", the success as 0 and 1, or "dense", Meta-World's own.
        max_steps: steps until truncation.
        strict: raise on a NaN action, instead of truncating the row with a warning as for an unstable simulation.

    Raises:
        ValueError: an unknown task or engine, or ``num_envs`` under the number of tasks.
        ImportError: a rendering library named by MUJOCO_GL is absent, or the vectorized engine does not know the
            installed version of Meta-World or MuJoCo.

    Example:
        >>> env = LanguageWorldEnv(["reach", "push"], num_envs=4, seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["task_id"][:, 0].tolist()
        (torch.Size([4, 3, 39]), [37, 40, 37, 40])
        >>> env.close()

    Source: paper section 'Task Formalism'; ``metaworld.sawyer_xyz_env.SawyerXYZEnv``.
    """

    def __init__(
        self,
        tasks: str | Iterable[str],
        *,
        num_envs: int | None = None,
        seed: int = 0,
        engine: Literal["vectorized", "metaworld"] | Callable[..., Engine] = "vectorized",
        num_threads: int | None = None,
        reward: Literal["sparse", "dense"] = "sparse",
        max_steps: int = 500,
        strict: bool = False,
    ) -> None:
        self.tasks = resolve_tasks(tasks)
        n = len(self.tasks)
        num_envs = n if num_envs is None else check_int("num_envs", num_envs, minimum=1)
        if num_envs < n:
            raise ValueError(f"num_envs must be at least the number of tasks, {n}, got {num_envs}")
        check_choice("reward", reward, ("sparse", "dense"))
        if num_threads is not None:
            check_int("num_threads", num_threads, minimum=1)
        self.max_steps = check_int("max_steps", max_steps, minimum=1)
        self.strict = strict
        self.row_tasks = tuple(self.tasks[i % n] for i in range(num_envs))
        self._seed = check_int("seed", seed)
        super().__init__(device=torch.device("cpu"), batch_size=(num_envs,))
        self._make_specs(num_envs)
        self._task_id = torch.tensor([task_id(task) for task in self.row_tasks])
        self._rank = np.arange(num_envs) // n  # r, the row's rank among the rows of its task
        self._copies = np.bincount(np.arange(num_envs) % n, minlength=n)[np.arange(num_envs) % n]  # R
        self._resets = np.zeros(num_envs, dtype=np.int64)
        self._episode = np.full(num_envs, -1, dtype=np.int64)
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._over = np.ones(num_envs, dtype=bool)
        self._fault = np.zeros(num_envs, dtype=bool)
        self._success = np.zeros(num_envs, dtype=bool)
        self._observation = np.zeros((num_envs, OBSERVATION_SIZE), dtype=np.float32)
        self._engine = _make_engine(engine, list(self.row_tasks), reward=reward, num_threads=num_threads)
        self.is_closed = False  # EnvBase starts with True

    def _make_specs(self, n: int) -> None:
        flag = Categorical(2, shape=(n, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            observation=Unbounded((n, OBSERVATION_SIZE)),
            task_id=Categorical(50, shape=(n,), dtype=torch.int64),
            episode=Unbounded((n,), dtype=torch.int64),
            success=flag.clone(),
            fault=flag.clone(),
            executed_action=Bounded(-1.0, 1.0, (n, ACTION_SIZE)),
            shape=(n,),
        )
        # What a reset may read: a TransformedEnv hands down nothing of the reset tensordict that is not state.
        self.state_spec = Composite(episode=Unbounded((n,), dtype=torch.int64), shape=(n,))
        self.action_spec = Bounded(-1.0, 1.0, (n, ACTION_SIZE))
        self.reward_spec = Unbounded((n, 1))
        self.done_spec = Composite(done=flag.clone(), terminated=flag.clone(), truncated=flag.clone(), shape=(n,))

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self._seed = check_int("seed", seed)
        self._resets[:] = 0

    @property
    def seed(self) -> int:
        """The seed that, with task and episode, fixes every reset."""
        return self._seed

    def _state(self, executed_action: Tensor, **more: Tensor) -> TensorDict:
        over = torch.from_numpy(self._over.copy()).unsqueeze(-1)
        return TensorDict(
            {
                "observation": torch.from_numpy(self._observation.copy()),
                "task_id": self._task_id.clone(),
                "episode": torch.from_numpy(self._episode.copy()),
                "success": torch.from_numpy(self._success.copy()).unsqueeze(-1),
                "fault": torch.from_numpy(self._fault.copy()).unsqueeze(-1),
                "executed_action": executed_action,
                "done": over,
                "terminated": torch.zeros_like(over),
                "truncated": over.clone(),
                **more,
            },
            batch_size=self.batch_size,
            device=self.device,
        )

    def _mask(self, tensordict: TensorDictBase | None, key: str) -> np.ndarray:
        mask = None if tensordict is None else tensordict.get(key, None)
        if mask is None:
            return np.ones(self.batch_size[0], dtype=bool)
        return mask.reshape(self.batch_size).cpu().numpy()

    def _check_open(self) -> None:
        if self.is_closed:
            raise RuntimeError("this environment is closed (a collector closes its own at its end): make a new one")

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        self._check_open()
        rows = np.flatnonzero(self._mask(tensordict, "_reset"))
        named = None if tensordict is None else tensordict.get("episode", None)
        if named is None:
            episodes = (self._resets * self._copies + self._rank)[rows]
        else:
            if named.numel() != len(self.row_tasks) or named.dtype not in (torch.int64, torch.int32):
                raise ValueError(
                    f"episode must be int64 of shape {tuple(self.batch_size)}, got {named.dtype} of shape "
                    f"{tuple(named.shape)}"
                )
            episodes = named.reshape(self.batch_size).cpu().numpy()[rows]
            if (episodes < 0).any():
                raise ValueError(f"episode must be at least 0, got {episodes.min()}")
        seeds = [
            episode_seed(self.row_tasks[row], self._seed, int(episode))
            for row, episode in zip(rows, episodes, strict=True)
        ]
        self._observation[rows] = self._engine.reset(rows.tolist(), seeds)
        self._resets[rows] += 1
        self._episode[rows] = episodes
        self._steps[rows] = 0
        for flag in (self._over, self._fault, self._success):
            flag[rows] = False
        return self._state(torch.zeros(*self.batch_size, ACTION_SIZE))

    def _clipped(self, tensordict: TensorDictBase) -> Tensor:
        action = tensordict.get("action", None)
        if action is None or action.shape != (*self.batch_size, ACTION_SIZE) or action.dtype != torch.float32:
            given = "none" if action is None else f"{action.dtype} of shape {tuple(action.shape)}"
            raise ValueError(f"action must be float32 of shape {(*self.batch_size, ACTION_SIZE)}, got {given}")
        return action.detach().clamp(-1.0, 1.0)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._check_open()
        action = self._clipped(tensordict).cpu().numpy()
        active = self._mask(tensordict, "_step")
        if (active & self._over).any():
            rows = np.flatnonzero(active & self._over)[:5].tolist()
            raise RuntimeError(f"rows {rows} have ended or were never reset: reset them before the next step")
        stepped = active
        if math.isnan(action.sum()):  # of numbers in [-1, 1], so one of them is NaN
            broken = active & np.isnan(action).any(-1)
            self._report(broken, "its action is NaN", self.strict)
            stepped = active & ~broken
        result = self._engine.step(action, stepped)
        if (unstable := result.fault & stepped).any():
            self._report(unstable, "its simulation became unstable")
        np.copyto(self._observation, result.observation, casting="same_kind", where=stepped[:, None])
        np.copyto(self._success, result.success & stepped, where=active)
        self._steps += active
        self._over |= self._fault
        self._over |= self._steps >= self.max_steps
        reward = np.where(stepped, result.reward, 0.0).astype(np.float32)
        executed = np.where(stepped[:, None], action, np.float32(0.0))
        return self._state(torch.from_numpy(executed), reward=torch.from_numpy(reward).unsqueeze(-1))

    def _report(self, rows: np.ndarray, what: str, fatal: bool = False) -> None:
        if not rows.any():
            return
        row = int(np.flatnonzero(rows)[0])
        message = (
            f"row {row}: {what}, in task {self.row_tasks[row]!r}, seed {self._seed}, episode "
            f"{self._episode[row]}, step {self._steps[row]}" + (f" ({rows.sum()} rows)" if rows.sum() > 1 else "")
        )
        if fatal:
            raise ValueError(f"action must hold numbers: {message}")
        self._fault |= rows
        warnings.warn(f"{message}; the row is truncated and flagged, the others go on", stacklevel=3)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulators."""
        if not self.is_closed:
            self._engine.close()
        super().close(raise_if_closed=raise_if_closed)
