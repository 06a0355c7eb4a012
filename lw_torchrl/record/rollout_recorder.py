"""RolloutRecorder: a transform that records episodes of selected environment rows while they run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from lw_torchrl._util.checks import Count, Natural, typed
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.record.meshes import Motion
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollouts import read_rollout
from lw_torchrl.transforms.environment import base_env, refuse_changed

# The keys of a LanguageWorldEnv whose values are recorded: before a time step, and after a time step.
_BEFORE = {"task_id", "episode", "qaf_plan", "observation", "qaf", "qaf_logits", "skill_weights", "pixels"}
_AFTER = {"executed_action", "success", "reward"}


class RolloutRecorder(Transform):
    """A transform that records episodes of selected environment rows while they run.

    When an episode ends, the recorder adds a page to the recording, with :func:`lw_torchrl.log_rollout` for a
    :class:`~lw_torchrl.LanguageWorldEnv` and with :meth:`RerunLogger.log_episode` for other environments. An episode
    that a reset or ``close()`` interrupts is recorded up to that point. Put the recorder after
    :class:`~lw_torchrl.QAFTransform` and before observation transforms, and close the environment before the
    logger. A LanguageWorldEnv in another process cannot be recorded.

    Args:
        logger: the logger of the recording.
        rows: indices of the environment rows to record.
        plans: the plans whose conditions are evaluated in ``qaf``, one for the task of each row; None without plans.
        every: record the first and then every N-th episode of a row.
        policy: the policy's name, shown in the tab of a LanguageWorldEnv's episode.
        objects: for other environments, a function that maps a rollout (T,) to the objects to draw: name -> T×3
            positions in metres.
        task: for other environments, the task's name; None uses the name of the environment's class.

    Raises:
        ValueError: a row is not in the environment, ``plans`` has no plan for a row's task, or a transform before the
            recorder changes the observation.
        TypeError: the environment is a LanguageWorldEnv in another process.

    Example:
        >>> import tempfile
        >>> from torchrl.envs import TransformedEnv
        >>> import lw_torchrl as lw
        >>> logger = lw.RerunLogger(tempfile.mkdtemp() + "/reach.rrd")
        >>> base = lw.LanguageWorldEnv("reach", num_envs=3, max_steps=10)
        >>> env = TransformedEnv(base, lw.record.RolloutRecorder(logger, rows=[1], policy="expert"))
        >>> _ = env.rollout(10, lw.ExpertActor("reach"))
        >>> env.close()
        >>> logger.episodes
        ['reach-1']
        >>> logger.shutdown()
    """

    @typed
    def __init__(
        self,
        logger: RerunLogger,
        rows: Sequence[Natural] = (0,),
        *,
        plans: AnyPlans | None = None,
        every: Count = 1,
        policy: str | None = None,
        objects: Callable[[TensorDictBase], Mapping[str, Tensor]] | None = None,
        task: str | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.logger = logger
        self.rows = tuple(dict.fromkeys(rows))
        self.plans = None if plans is None else as_plans(plans)
        self.every = every
        self.policy, self.objects, self.task = policy, objects, task
        self._running: dict[int, _Row] = {}

    def clone(self) -> RolloutRecorder:
        """Return a recorder for the same recording, with no episode in progress."""
        copied = super().clone()
        copied._running = {}
        return copied

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        env = base_env(self)
        if env is None:
            return
        if isinstance(env, LanguageWorldEnv):
            refuse_changed(self, "observation")
        elif {"task_id", "executed_action"} <= set(env.full_observation_spec.keys()):
            raise TypeError(f"RolloutRecorder cannot record episodes of another process, got {type(env).__name__}")
        count = max(1, env.batch_size.numel())
        for row in self.rows:
            if row >= count:
                raise ValueError(f"rows must be less than {count} (the number of environment rows), got {row}")
        if isinstance(env, LanguageWorldEnv) and self.plans is not None:
            self.plans.require(env.row_tasks[row] for row in self.rows)
        self._running = {row: _Row(env, row, self) for row in self.rows}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for row in _masked(tensordict.get("_reset", None), self.rows):
            running = self._running[row]
            running.end()
            running.begin(recorded=running.ended % self.every == 0)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # Read all keys at once: reading one key after another takes as long as everything else in this method.
        before, after = dict(tensordict.items()), dict(next_tensordict.items())
        done = after["done"].numpy(force=True).reshape(-1) if "done" in after else None
        for row in _masked(before.get("_step"), self.rows):
            running = self._running[row]
            running.add_step(before, after)
            if done is not None and done[row]:
                running.end()
        return next_tensordict

    def close(self) -> None:
        """Record unfinished episodes; further calls do nothing."""
        for running in self._running.values():
            running.end()


class _Row:
    """The running episode of one environment row; in a LanguageWorldEnv, also the robot's motion."""

    def __init__(self, env: Any, row: int, recorder: RolloutRecorder) -> None:
        self.env, self.row, self.recorder = env, row, recorder
        self._is_own = isinstance(env, LanguageWorldEnv)
        self._has_motion = self._is_own and hasattr(env.engine, "poses")  # a custom engine may lack bodies
        self.ended = 0
        self.begin(recorded=False)

    def begin(self, *, recorded: bool) -> None:
        self._before: dict[str, list[NDArray[Any]]] = {}
        self._after: dict[str, list[NDArray[Any]]] = {}
        self._poses: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
        self._recorded, self._stepped = recorded, False
        if self._is_own:
            self._seed = self.env.seed
        if recorded and self._has_motion:
            self._model = self.env.engine.row_model(self.row)
        self._add_pose()

    def add_step(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        """Store a time step: the tensordict's entries before and after the step."""
        self._stepped = True
        dims = len(self.env.batch_size)
        for columns, entries, own in ((self._before, before, _BEFORE), (self._after, after, _AFTER)):
            for key, values in entries.items() if self._recorded else ():
                if key in own if self._is_own else isinstance(values, Tensor) and not key.startswith("_"):
                    array = values.numpy(force=True)
                    value = array.reshape(-1, *array.shape[dims:])[self.row] if dims else array
                    # Copy, because some environments overwrite the same tensors at the next time step.
                    columns.setdefault(key, []).append(np.array(value))
        self._add_pose()

    def _add_pose(self) -> None:
        if self._recorded and self._has_motion:
            position, quaternion = self.env.engine.poses(self.row)
            self._poses.append((np.array(position, np.float32), np.array(quaternion, np.float32)))

    def end(self) -> None:
        """Add the episode's page to the recording if at least one time step was recorded."""
        number, recorded, poses = self.ended, (self._before, self._after), self._poses
        seed = self._seed if self._is_own else None
        self.ended += self._stepped
        self.begin(recorded=False)
        before, after = ({key: torch.from_numpy(np.stack(rows)) for key, rows in some.items()} for some in recorded)
        if not after:
            return
        length = len(next(iter(after.values())))
        rollout = TensorDict({**before, "next": TensorDict(after, [length])}, [length])
        recorder = self.recorder
        if self._is_own:
            suite = self.env.suite
            about: dict[str, Any] = {"tasks": [self.env.task_of_row[self.row]], "seed": seed, "suite": suite}
            about |= {"policy": recorder.policy, "step_time": suite.step_time * self.env.frame_skip}
            heading, episode = read_rollout(rollout, recorder.plans, **about)
            motion = None
            if self._has_motion:
                position, quaternion = (np.stack(part) for part in zip(*poses, strict=True))
                motion = Motion(self._model, position, quaternion)
            recorder.logger.add_page(heading, episode, motion=motion)
            return
        task = recorder.task or type(self.env).__name__
        objects = {} if recorder.objects is None else recorder.objects(rollout)
        plan = None if recorder.plans is None else recorder.plans.get(task)
        name: str | None = f"{task}-{number}" + (f", row {self.row}" if len(recorder.rows) > 1 else "")
        name = None if name in recorder.logger.episodes else name
        recorder.logger.log_episode(rollout, task=task, objects=objects, plan=plan, name=name)


def _masked(mask: Tensor | None, rows: Sequence[int]) -> Sequence[int]:
    """Return the rows that a mask selects, or all rows without a mask."""
    return rows if mask is None else [row for row in rows if mask.reshape(-1)[row]]
