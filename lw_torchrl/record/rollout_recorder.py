"""RolloutRecorder: episodes of chosen rows of an environment, recorded while they run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, Transform

from lw_torchrl._checks import check_int, checked
from lw_torchrl.envs.language_world_env import LanguageWorldEnv
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.record.meshes import Motion
from lw_torchrl.record.rerun_logger import RerunLogger
from lw_torchrl.record.rollouts import read_rollout
from lw_torchrl.transforms.environment import base_env, refuse_changed

_OF_EPISODE = ("task_id", "episode", "qaf_plan")
_BEFORE = ("observation", "qaf", "qaf_logits", "skill_weights", "action_corrected", "pixels")
_AFTER = ("executed_action", "success", "reward")
"""Keys of an episode, the same in all its steps; of the state and the policy; of what a step led to."""


class RolloutRecorder(Transform):
    """Record episodes of chosen rows of a :class:`~lw_torchrl.LanguageWorldEnv` while they run.

    At the end of an episode it adds a page like :func:`lw_torchrl.log_rollout`'s; an episode that is cut by a reset or
    by closing the environment is recorded as far as it went. Put it after :class:`~lw_torchrl.QAFTransform` and before
    transforms of the observation, and close the environment before the logger. It cannot record an environment that
    runs in another process.

    Args:
        logger: the recording.
        rows: indices of the environment's rows.
        plans: the plans that ``qaf`` answers, one for the task of each row; None without plans.
        every: record the first and then every N-th episode of a row.
        policy: the policy's name, for the tab.

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

    @checked
    def __init__(
        self,
        logger: RerunLogger,
        rows: Sequence[int] = (0,),
        *,
        plans: AnyPlans | None = None,
        every: int = 1,
        policy: str | None = None,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        self.logger = logger
        self.rows = tuple(dict.fromkeys(check_int("rows", row, minimum=0) for row in rows))
        self.plans = None if plans is None else as_plans(plans)
        self.every = check_int("every", every, minimum=1)
        self.policy = policy
        self._running: dict[int, _Row] = {}

    def clone(self) -> RolloutRecorder:
        """A recorder into the same recording, which has seen nothing yet."""
        copied = super().clone()
        copied._running = {}
        return copied

    def set_container(self, container: Transform | EnvBase) -> None:
        """Join an environment; what is drawn of its models is prepared now, in half a second for each."""
        super().set_container(container)
        env = base_env(self)
        if env is None:
            return
        if not isinstance(env, LanguageWorldEnv):
            raise TypeError(f"RolloutRecorder needs a LanguageWorldEnv in its own process, got {type(env).__name__}")
        refuse_changed(self, "observation")
        for row in self.rows:
            if row >= len(env.row_tasks):
                raise ValueError(f"rows must be below {len(env.row_tasks)}, the environment's rows, got {row}")
        if self.plans is not None:
            self.plans.require(env.row_tasks[row] for row in self.rows)
        self._running = {row: _Row(env, row, self.logger) for row in self.rows}

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        for row in _named(tensordict.get("_reset", None), self.rows):
            running = self._running[row]
            self._end(running)
            running.begin(recorded=running.ended % self.every == 0)
        return tensordict_reset

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        # All at once: to get them one by one takes as long as the rest.
        before, after = dict(tensordict.items()), dict(next_tensordict.items())
        done = after["done"].numpy(force=True).reshape(-1)
        for row in _named(before.get("_step"), self.rows):
            running = self._running[row]
            running.take(before, after)
            if done[row]:
                self._end(running)
        return next_tensordict

    def close(self) -> None:
        """Record what is unfinished; a second call does nothing."""
        for running in self._running.values():
            self._end(running)

    def _end(self, running: _Row) -> None:
        """Add the page of a row's episode if it has begun and is to be recorded."""
        rollout, motion = running.finish()
        if rollout is None:
            return
        about: dict[str, Any] = {"tasks": [running.task], "seed": running.seed, "policy": self.policy}
        heading, episode = read_rollout(rollout, self.plans, suite=running.suite, **about)
        episode = replace(episode, step_time=running.suite.step_time * running.frame_skip)
        self.logger.add_page(heading, episode, motion=motion)


class _Row:
    def __init__(self, env: LanguageWorldEnv, row: int, logger: RerunLogger) -> None:
        self.task = env.task_of_row[row]
        self.ended = 0
        self.seed, self.suite, self.frame_skip = env.seed, env.suite, env.frame_skip
        self._env, self._row = env, row
        self._part: Any = row if env.batch_size else ...
        # An engine of one's own may have no bodies.
        engine: Any = env.engine
        self._engine = engine if hasattr(engine, "poses") else None
        self._model = None if self._engine is None else self._engine.model(row)
        if self._model is not None:
            logger.prepare(self._model)
        # The episode so far: keys of the state and of what a step led to, with a place for each step there can be.
        self._said: dict[str, NDArray[Any]] = {}
        self._before: dict[str, NDArray[Any]] = {}
        self._after: dict[str, NDArray[Any]] = {}
        self._poses: tuple[NDArray[np.float32], ...] = ()
        self._steps, self._recorded, self._stepped = 0, False, False

    def begin(self, *, recorded: bool) -> None:
        self.seed = self._env.seed
        self._steps, self._recorded, self._stepped = 0, recorded, False
        self._before, self._after = {}, {}
        if recorded and self._engine is not None:
            most, bodies = self._env.max_steps + 1, self._engine.model(self._row).model.nbody
            self._poses = np.empty((most, bodies, 3), np.float32), np.empty((most, bodies, 4), np.float32)
            self._look()

    def take(self, before: Mapping[str, Tensor], after: Mapping[str, Tensor]) -> None:
        """Note a step: what it was decided on and what it led to."""
        self._stepped = True
        if not self._recorded:
            return
        if not self._before:
            self._said = {key: self._of(before[key]) for key in _OF_EPISODE if key in before}
            self._before = {key: self._column(before[key]) for key in _BEFORE if key in before}
            self._after = {key: self._column(after[key]) for key in _AFTER if key in after}
        step, part = self._steps, self._part
        # A copy: some environments write into their tensors again.
        for key, column in self._before.items():
            column[step] = before[key].numpy(force=True)[part]
        for key, column in self._after.items():
            column[step] = after[key].numpy(force=True)[part]
        self._steps = step + 1
        self._look()

    def finish(self) -> tuple[TensorDict | None, Motion | None]:
        """The episode so far, (T,), and its motion; afterwards none runs. None where no step was noted."""
        self.ended += self._stepped
        steps, self._steps, self._recorded, self._stepped = self._steps, 0, False, False
        if not steps:
            return None, None
        columns: Any = {key: np.full((steps, *value.shape), value) for key, value in self._said.items()}
        columns |= {key: column[:steps] for key, column in self._before.items()}
        columns["next"] = {key: column[:steps] for key, column in self._after.items()}
        rollout = TensorDict(columns, [steps])
        if self._model is None:
            return rollout, None
        positions, quaternions = self._poses
        return rollout, Motion(self._model, positions[: steps + 1], quaternions[: steps + 1])

    def _of(self, values: Tensor) -> NDArray[Any]:
        """This row's part of a tensor of all rows."""
        return np.array(values.numpy(force=True)[self._part])

    def _column(self, values: Tensor) -> NDArray[Any]:
        part = self._of(values)
        return np.empty((self._env.max_steps, *part.shape), part.dtype)

    def _look(self) -> None:
        if self._recorded and self._engine is not None:
            positions, quaternions = self._poses
            positions[self._steps], quaternions[self._steps] = self._engine.poses(self._row)


def _named(mask: Tensor | None, rows: Sequence[int]) -> Sequence[int]:
    """Those of ``rows`` that a mask names, all where there is none."""
    return rows if mask is None else [row for row in rows if mask.reshape(-1)[row]]
