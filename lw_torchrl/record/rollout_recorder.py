"""RolloutRecorder: episodes of chosen rows of an environment, recorded while they run."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from lw_torchrl._util.checks import Count, Natural, check_value, typed
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.record.meshes import Motion
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollouts import read_rollout
from lw_torchrl.transforms.environment import base_env, refuse_changed

_OURS = {"task_id", "episode", "qaf_plan", "observation", "qaf", "qaf_logits", "skill_weights", "action_corrected"}
_BEFORE = {*_OURS, "pixels"}  # the keys of a LanguageWorldEnv before a step, and after it
_AFTER = {"executed_action", "success", "reward"}


class RolloutRecorder(Transform):
    """Record episodes of chosen rows of an environment while they run.

    At its end, an episode becomes a page like that of :func:`lw_torchrl.log_rollout`, or in an environment other than
    :class:`~lw_torchrl.LanguageWorldEnv` like that of :meth:`RerunLogger.log_episode`; an episode that is cut by a
    reset, or by closing the environment, as far as it went. Put the recorder after :class:`~lw_torchrl.QAFTransform`
    and before transforms of the observation, and close the environment before the logger. It cannot record a
    LanguageWorldEnv that runs in another process.

    Args:
        logger: the recording.
        rows: indices of the environment's rows.
        plans: the plans that ``qaf`` answers, one for the task of each row; None without plans.
        every: record the first and then every N-th episode of a row.
        policy: the policy's name, for the tab of a LanguageWorldEnv's episode.
        objects: for other environments, a function from a rollout (T,) to name -> T×3 positions in metres to draw.
        task: for other environments, the task's name; None takes the environment's class.

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
        rows: Sequence[int] = (0,),
        *,
        plans: AnyPlans | None = None,
        every: int = 1,
        policy: str | None = None,
        objects: Callable[[TensorDictBase], Mapping[str, Tensor]] | None = None,
        task: str | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.logger = logger
        self.rows = tuple(dict.fromkeys(check_value("rows", row, Natural) for row in rows))
        self.plans = None if plans is None else as_plans(plans)
        self.every = check_value("every", every, Count)
        self.policy, self.objects, self.task = policy, objects, task
        self._running: dict[int, _Row] = {}

    def clone(self) -> RolloutRecorder:
        """Return a recorder into the same recording, without any episode."""
        copied = super().clone()
        copied._running = {}
        return copied

    def set_container(self, container: Transform | EnvBase) -> None:
        super().set_container(container)
        env = base_env(self)
        if env is None:
            return
        own = isinstance(env, LanguageWorldEnv)
        if own:
            refuse_changed(self, "observation")
        elif {"task_id", "executed_action"} <= set(env.full_observation_spec.keys()):
            raise TypeError(f"RolloutRecorder needs a LanguageWorldEnv in its own process, got {type(env).__name__}")
        count = max(1, env.batch_size.numel())
        for row in self.rows:
            if row >= count:
                raise ValueError(f"rows must be below {count}, the environment's rows, got {row}")
        if isinstance(env, LanguageWorldEnv) and self.plans is not None:
            self.plans.require(env.row_tasks[row] for row in self.rows)
        self._running = {row: _OwnRow(env, row, self) if own else _Row(env, row, self) for row in self.rows}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for row in _named(tensordict.get("_reset", None), self.rows):
            running = self._running[row]
            running.end()
            running.begin(recorded=running.ended % self.every == 0)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # All at once: to get them one by one takes as long as the rest.
        before, after = dict(tensordict.items()), dict(next_tensordict.items())
        done = after["done"].numpy(force=True).reshape(-1) if "done" in after else None
        for row in _named(before.get("_step"), self.rows):
            running = self._running[row]
            running.take(before, after)
            if done is not None and done[row]:
                running.end()
        return next_tensordict

    def close(self) -> None:
        """Record unfinished episodes; a second call does nothing."""
        for running in self._running.values():
            running.end()


class _Row:
    """The running episode of a row of any environment."""

    def __init__(self, env: EnvBase, row: int, recorder: RolloutRecorder) -> None:
        self.env, self.row, self.recorder = env, row, recorder
        self.ended = 0
        self._before: dict[str, list[NDArray[Any]]] = {}
        self._after: dict[str, list[NDArray[Any]]] = {}
        self._recorded = self._stepped = False

    def keeps(self, key: str, values: Any, later: bool) -> bool:
        return isinstance(values, Tensor) and not key.startswith("_")

    def begin(self, *, recorded: bool) -> None:
        self._before, self._after = {}, {}
        self._recorded, self._stepped = recorded, False

    def take(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        """Note a step: the state and action, and their result."""
        self._stepped = True
        dims = len(self.env.batch_size)
        for noted, entries in ((self._before, before), (self._after, after)) if self._recorded else ():
            for key, values in entries.items():
                if self.keeps(key, values, entries is after):
                    array = values.numpy(force=True)
                    own = array.reshape(-1, *array.shape[dims:])[self.row] if dims else array
                    noted.setdefault(key, []).append(np.array(own))  # some environments write into their tensors again

    def finish(self) -> TensorDict | None:
        """End the episode and return its rollout (T,); None if no step of it was recorded."""
        self.ended += self._stepped
        before, after = (
            {key: torch.from_numpy(np.stack(column)) for key, column in noted.items()}
            for noted in (self._before, self._after)
        )
        self.begin(recorded=False)
        if not after:
            return None
        length = len(next(iter(after.values())))
        return TensorDict({**before, "next": TensorDict(after, [length])}, [length])

    def end(self) -> None:
        """Add the page of the episode if it has begun and is to be recorded."""
        number = self.ended
        if (rollout := self.finish()) is not None:
            recorder = self.recorder
            task = recorder.task or type(self.env).__name__
            objects = {} if recorder.objects is None else recorder.objects(rollout)
            plan = None if recorder.plans is None else recorder.plans.get(task)
            name: str | None = f"{task}-{number}" + (f", row {self.row}" if len(recorder.rows) > 1 else "")
            name = None if name in recorder.logger.episodes else name
            recorder.logger.log_episode(rollout, task=task, objects=objects, plan=plan, name=name)


class _OwnRow(_Row):
    """The running episode of a row of a LanguageWorldEnv, with the motion of the robot."""

    env: LanguageWorldEnv

    def __init__(self, env: EnvBase, row: int, recorder: RolloutRecorder) -> None:
        super().__init__(env, row, recorder)
        self._poses: list[Any] = []
        self._seed = self.env.seed
        engine: Any = self.env.engine
        self._model: Any = engine.model(row) if hasattr(engine, "poses") else None  # a custom engine may lack bodies

    def keeps(self, key: str, values: Any, later: bool) -> bool:
        return key in (_AFTER if later else _BEFORE)

    def begin(self, *, recorded: bool) -> None:
        super().begin(recorded=recorded)
        self._seed, self._poses = self.env.seed, []
        if recorded and self._model is not None:
            engine: Any = self.env.engine
            self._model = engine.model(self.row)
        self._look()

    def take(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
        super().take(before, after)
        self._look()

    def _look(self) -> None:
        if self._recorded and self._model is not None:
            engine: Any = self.env.engine
            position, quaternion = engine.poses(self.row)
            self._poses.append((np.array(position, np.float32), np.array(quaternion, np.float32)))

    def end(self) -> None:
        poses, recorder, seed = self._poses, self.recorder, self._seed
        if (rollout := self.finish()) is None:
            return
        about: dict[str, Any] = {"tasks": [self.env.task_of_row[self.row]], "seed": seed, "policy": recorder.policy}
        about |= {"suite": self.env.suite, "step_time": self.env.suite.step_time * self.env.frame_skip}
        heading, episode = read_rollout(rollout, recorder.plans, **about)
        motion = None
        if self._model is not None:
            position, quaternion = (np.stack(part) for part in zip(*poses, strict=True))
            motion = Motion(self._model, position, quaternion)
        recorder.logger.add_page(heading, episode, motion=motion)


def _named(mask: Tensor | None, rows: Sequence[int]) -> Sequence[int]:
    """Return the rows that a mask names, all without a mask."""
    return rows if mask is None else [row for row in rows if mask.reshape(-1)[row]]
