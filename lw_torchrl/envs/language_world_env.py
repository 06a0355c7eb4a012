"""LanguageWorldEnv: Meta-World's tasks, and those of other suites, as a natively batched TorchRL environment."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl._utils import seed_generator
from torchrl.data import Unbounded
from torchrl.envs import EnvBase

from lw_torchrl._util.checks import Count, Natural, check_value, typed
from lw_torchrl._util.devices import CPU, check_device, copied_at_once
from lw_torchrl._util.keys import row_mask
from lw_torchrl._util.rendering import check_picture
from lw_torchrl.envs.rows import EpisodeCounter, RowStates, action_spec, done_spec, observation_spec, read_action
from lw_torchrl.language.tasks import Task, one_layout
from lw_torchrl.suites.engine import Engine
from lw_torchrl.suites.metaworld import make_engine
from lw_torchrl.suites.suite import Suite, find_suite, listed_tasks


class LanguageWorldEnv(EnvBase):
    """A batch of N environments with any mixture of the 50 tasks, following the MT50-rand protocol: each reset draws a
    random initial state and goal, the goal is observed, and episodes are truncated after 500 time steps.

    Row i has the task ``tasks[i % n]``. Counting from 0, the m-th reset of the r-th of R rows with the same task starts
    episode m·R + r of the task; in worker w of W, episode (m·W + w)·R + r. An episode begins as in
    Meta-World after ``env.seed(episode_seed(task, seed, episode)); env.reset()``, independent of earlier episodes.
    ``env.reset(episode=7)`` starts episode 7 in every row; an int64 tensor (N,) selects one episode per row. Both count
    as a reset. With a SerialEnv or ParallelEnv, use ``reset(list_of_kwargs=[{"episode": ...}, ...])``. A reset ignores
    ``episode`` in a tensordict.

    Give each worker of a SerialEnv, ParallelEnv, AsyncEnvPool or multi-process collector a distinct ``worker=(w, W)``,
    as in ``ParallelEnv(2, [partial(make_env, worker=(w, 2)) for w in range(2)])``; otherwise all workers run the same
    episodes.

    ``close()`` frees the simulators; the next ``reset()`` makes new simulators and continues with the next episodes.
    ``state_dict`` holds the seed and the episode counters; after loading, reset the environment to continue with the
    next episodes. A TransformedEnv or Collector saves this state only with a
    :class:`~lw_torchrl.transforms.QAFTransform` or :class:`~lw_torchrl.transforms.CameraTransform`.

    Keys (B = (N,)); rows outside a ``_step`` mask do not move, rows outside a ``_reset`` mask are not reset:
        observation: (N, 39) float32, Meta-World's vector: metres, gripper opening in [0, 1], quaternions.
        task_id, episode: (N,) int64, rank of the task's name among the 50 sorted names, and index of the episode.
        success: (N, 1) bool, Meta-World's success at this time step.
        fault: (N, 1) bool, whether the row was truncated because of a NaN action or an unstable simulation.
        action: (N, 4) float32, end-effector displacement xyz and gripper effort, each in [-1, 1]. The environment never
            overwrites ``action``, so that an action out of range keeps its log-probability.
        executed_action: (N, 4) float32 in [-1, 1], the action of the last time step, clipped as in Meta-World; zeros
            after a reset, and for a row that did not take a step.
        reward: (N, 1) float32.
        done, terminated, truncated: (N, 1) bool; terminated stays false unless ``terminate_on_success``.

    Args:
        tasks: "MT10", "MT50", a task's name (with the suite, as in "fetch/push", if not Meta-World), or a list of names
            or :class:`~lw_torchrl.Task` objects. A task that belongs to no suite needs a custom engine.
        num_envs: N, at least the number of tasks; None for one environment per task.
        seed: any integer; :meth:`set_seed` restarts at episode 0.
        suite: the :class:`~lw_torchrl.suites.Suite` of the tasks, or its name; None for the suite in the tasks'
            names, as in "fetch/push", or Meta-World for names without a suite.
        engine: the simulator; None for the suite's default. For Meta-World, "vectorized" (default); "metaworld", a
            slower loop over Meta-World's own environments with the same results; or another name in
            :data:`~lw_torchrl.suites.metaworld.ENGINES`. For a custom engine, a callable ``(row_tasks, *, reward,
            num_threads) -> Engine``. If the vectorized engine does not reproduce the installed version of Meta-World or
            MuJoCo, None selects "metaworld" and issues a warning.
        num_threads: number of simulation threads, by default the cores available to this process. The number of
            threads never changes a result.
        reward: "sparse", the success as 0 or 1; or "dense", Meta-World's dense reward.
        max_steps: simulation steps until truncation; None for the suite's default (Meta-World: 500).
        frame_skip: number of simulation steps per action. The rewards of these steps are added, and a time step counts
            as successful if any of its simulation steps succeeds.
        terminate_on_success: end an episode at its first success, and set ``terminated``.
        strict: raise an error on a NaN action, instead of truncating the row with a warning.
        worker: (w, W), this environment's index among W environments; None for a single environment.
        batch_size: () for a single environment without a batch dimension, as needed for AsyncEnvPool.
        device: device of the tensors that reset and step return; "auto" for this machine's accelerator.

    Raises:
        RuntimeError: a row takes a step after its episode has ended, or a process forked after construction uses the
            environment.
        TypeError: the environment is pickled or copied; pass a function that makes the environment instead.
        ImportError: the rendering library set by MUJOCO_GL is missing, or ``engine="vectorized"`` does not reproduce
            the installed version of Meta-World or MuJoCo.

    Example:
        >>> env = LanguageWorldEnv(["reach", "push"], num_envs=4, seed=0)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["task_id"][:, 0].tolist()
        (torch.Size([4, 3, 39]), [37, 40, 37, 40])
        >>> env.close()

    Source: paper section 'Task Formalism'; ``metaworld.sawyer_xyz_env.SawyerXYZEnv``.
    """

    _has_frame_skip = True  # otherwise TorchRL adds a FrameSkipTransform, which would step rows that have ended

    @typed
    def __init__(
        self,
        tasks: str | Task | Iterable[str | Task],
        *,
        num_envs: Count | None = None,
        seed: int = 0,
        suite: str | Suite | None = None,
        engine: str | Callable[..., Engine] | None = None,
        num_threads: Count | None = None,
        reward: Literal["sparse", "dense"] = "sparse",
        max_steps: Count | None = None,
        frame_skip: Count = 1,
        terminate_on_success: bool = False,
        strict: bool = False,
        worker: tuple[int, int] | None = None,
        batch_size: tuple[()] | None = None,
        device: str | torch.device = "cpu",
    ) -> None:
        tasks = listed_tasks(tasks)
        self.suite = find_suite(tasks, suite)
        named = self.suite.named_tasks(tasks)
        self.tasks, self.layout = tuple(named), one_layout(named.values())
        n = len(self.tasks)
        num_envs = n if num_envs is None else num_envs
        if num_envs < n:
            raise ValueError(f"num_envs must be at least {n}, the number of tasks, got {num_envs}")
        self.max_steps = self.suite.max_steps if max_steps is None else max_steps
        self.frame_skip, self.strict, self.terminate_on_success = frame_skip, strict, terminate_on_success
        if batch_size is not None and num_envs != 1:
            raise ValueError(f"batch_size=() requires num_envs=1, got num_envs={num_envs}")
        self.row_tasks = tuple(self.tasks[i % n] for i in range(num_envs))
        self.worker = (0, 1) if worker is None else worker
        if not 0 <= self.worker[0] < self.worker[1]:
            raise ValueError(f"worker must be (index, number of workers) with 0 <= index < number, got {worker}")
        self._process = os.getpid()
        self._counter = EpisodeCounter([named[t] for t in self.row_tasks], seed, self.worker)
        super().__init__(device=check_device("device", device), batch_size=(num_envs,) if batch_size is None else ())
        self._rows = RowStates(self.row_tasks, self.layout)
        index = ... if batch_size is None else 0
        self.observation_spec = observation_spec(self._rows.task_id, self.layout)[index].to(self.device)
        self.action_spec = action_spec(num_envs, self.layout)[index].to(self.device)
        self.reward_spec = Unbounded((num_envs, 1), dtype=torch.float32)[index].to(self.device)
        self.done_spec = done_spec(num_envs)[index].to(self.device)
        make = self.suite.make_engine if engine is None else partial(make_engine, engine)
        self._make_engine = partial(make, list(self.row_tasks), reward=reward, num_threads=num_threads)
        self._engine: Engine = self._make_engine()
        self.is_closed = False  # EnvBase sets it to True

    @typed
    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Restart at episode 0, with a new seed unless ``seed`` is None; return a seed for the next environment."""
        self._set_seed(seed)
        return seed if seed is None or static_seed else seed_generator(abs(seed))

    def _set_seed(self, seed: int | None) -> None:
        self._counter.seed = self._counter.seed if seed is None else seed
        self._counter.resets[:] = 0

    @property
    def task_of_row(self) -> tuple[Task, ...]:
        """The :class:`~lw_torchrl.Task` of each row."""
        return self._counter.tasks

    @property
    def engine(self) -> Engine:
        """The simulator of the rows (read only: do not call its ``step`` or ``reset``)."""
        return self._engine

    @property
    def seed(self) -> int:
        """The seed. Together with the task and the episode, it determines every reset."""
        return self._counter.seed

    def get_extra_state(self) -> Tensor:
        """Return the content of ``state_dict``: tasks, seed and episode counters, as bytes (n,) uint8."""
        return self._counter.dump()

    def set_extra_state(self, state: Tensor) -> None:
        """Restore the seed and the counters from a saved state, and end all episodes."""
        self._counter.load(state)
        self._rows.over[:] = True

    def load_state_dict(self, state_dict: Mapping[str, Any], strict: bool = True, assign: bool = False) -> Any:
        """Restore the seed and episode counters saved by an environment with the same rows; call ``reset`` next."""
        if strict and not state_dict:
            raise ValueError("state_dict is empty: add a QAFTransform before saving, or use strict=False to ignore it")
        return super().load_state_dict(state_dict, strict=strict, assign=assign)

    def __getstate__(self) -> NoReturn:
        raise TypeError("a LanguageWorldEnv can be neither pickled nor copied: pass a function that makes it")

    def _check_process(self) -> None:
        # The simulator's threads and its OpenGL context do not survive a fork: a child process would hang.
        if os.getpid() != self._process:
            raise RuntimeError("this process was forked after the environment was made: pass ParallelEnv a function")

    def _reset(self, tensordict: TensorDictBase | None = None, *, episode: int | Tensor | None = None) -> TensorDict:
        self._check_process()
        if self.is_closed:
            self._engine, self.is_closed = self._make_engine(), False
        rows = np.flatnonzero(row_mask(tensordict, "_reset", len(self.row_tasks)))
        episodes = self._counter.next(rows) if episode is None else self._counter.requested(episode, rows)
        self._rows.begin(rows, episodes, self._engine.reset(rows.tolist(), self._counter.seeds(rows, episodes)))
        self._counter.resets[rows] += 1
        return self._output(self._rows.as_tensordict())

    def _output(self, rows: TensorDict) -> TensorDict:
        rows = rows if self.batch_size else rows[0]
        return rows if self.device == CPU else copied_at_once(rows, self.device)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        self._check_process()
        size = self.layout.action_size
        action = read_action(tensordict, size).detach().clamp(-1.0, 1.0).cpu().numpy().reshape(-1, size)
        active = row_mask(tensordict, "_step", len(self.row_tasks))
        if (active & self._rows.over).any():
            rows = np.flatnonzero(active & self._rows.over)[:5].tolist()
            raise RuntimeError(f"rows {rows} have ended, or were not reset: reset them before the next step")
        stepped = active
        if math.isnan(action.sum()):  # the sum of numbers in [-1, 1] cannot overflow, so an action is NaN
            broken = active & np.isnan(action).any(-1)
            self._report(broken, "its action is NaN", self.strict)
            stepped = active & ~broken
        self._rows.over |= self._rows.fault
        self._rows.success &= ~active
        reward = self._simulate(action, stepped)
        for _ in range(self.frame_skip - 1):
            if not (running := stepped & ~self._rows.over).any():
                break
            reward += self._simulate(action, running)
        executed = np.where(stepped[:, None], action, np.float32(0.0))
        rewarded = torch.from_numpy(reward.astype(np.float32)).unsqueeze(-1)
        return self._output(self._rows.as_tensordict(executed, reward=rewarded))

    def _simulate(self, action: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Simulate one time step of the rows in the mask ``rows``; return the reward (N,) float64."""
        result = self._engine.step(action, rows)
        self._report(result.fault & rows, "its simulation became unstable")
        np.copyto(self._rows.observation, result.observation, casting="same_kind", where=rows[:, None])
        success = result.success & rows
        self._rows.success |= success
        if self.terminate_on_success:
            self._rows.terminated |= success
        self._rows.steps += rows
        self._rows.over |= self._rows.fault | self._rows.terminated | (self._rows.steps >= self.max_steps)
        return np.where(rows, result.reward, 0.0)

    def _report(self, rows: np.ndarray, problem: str, is_error: bool = False) -> None:
        """Set the ``fault`` flag of the rows in a mask and warn, or raise an error if ``is_error``."""
        if not rows.any():
            return
        row = int(np.flatnonzero(rows)[0])
        place = f"task {self.row_tasks[row]!r}, seed {self.seed}, episode {self._rows.episode[row]}"
        more = f" ({rows.sum()} rows)" if rows.sum() > 1 else ""
        message = f"row {row}: {problem}, in {place}, step {self._rows.steps[row]}{more}"
        if is_error:
            raise ValueError(f"action must hold numbers: {message}")
        self._rows.fault |= rows
        warnings.warn(f"{message}; the row is truncated and flagged, the others continue", stacklevel=4)

    def render(
        self, *, camera: str = "corner2", height: int = 240, width: int = 320, rows: Sequence[int] | None = None
    ) -> Tensor:
        """Render images of the rows' current state, (len(rows), height, width, 3) uint8, or (height, width, 3) with
        ``batch_size=()``. Rendering uses OpenGL (EGL on Linux without a display, unless MUJOCO_GL is set).

        TorchRL's PixelRenderTransform and VideoRecorder, and :class:`CameraTransform`, call this method. With a
        PixelRenderTransform, read the environment's ``observation_spec`` before the first reset.

        Args:
            camera: "corner2", "corner", "corner3", "corner4", "topview", "behindGripper" or "gripperPOV".
            height, width: image size in pixels.
            rows: indices of the rows to render; None for all rows.

        Raises:
            RuntimeError: a row was not reset, or the process was forked from a process that rendered.
            ImportError: OpenGL is missing; the message names what to install.
            AttributeError: a custom engine has no ``render``.
        """
        self._check_process()
        check_picture(camera, height, width)
        drawn = range(len(self.row_tasks)) if rows is None else [check_value("rows", row, Natural) for row in rows]
        if self.is_closed or (self._rows.episode[list(drawn)] < 0).any():
            raise RuntimeError("there is nothing to render before a reset: call env.reset()")
        if not drawn:
            return torch.zeros(0, height, width, 3, dtype=torch.uint8, device=self.device)
        engine: Any = self._engine
        pixels = engine.render(drawn, camera=camera, height=height, width=width)
        pictures = torch.from_numpy(pixels).to(self.device)
        return pictures if self.batch_size else pictures[0]

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the simulators and end all episodes; the next reset makes new simulators."""
        if not self.is_closed:
            self._engine.close()
            self._rows.over[:] = True
        super().close(raise_if_closed=raise_if_closed)
