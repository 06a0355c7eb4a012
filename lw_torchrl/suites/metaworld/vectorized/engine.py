"""The fast engine: Meta-World bit for bit, at nearly the speed of its physics."""

from __future__ import annotations

import os
import weakref
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._checks import check_choice, check_int
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import check_task
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import EngineStep, RowModel, checked_step, seeds_of_rows
from lw_torchrl.suites.metaworld.vectorized import observation as at
from lw_torchrl.suites.metaworld.vectorized import simulated_rows, task_programs
from lw_torchrl.suites.metaworld.vectorized.observation import Array, Index, Mask, Observer, SuccessFunction
from lw_torchrl.suites.metaworld.vectorized.rewards.dense_reward import DenseReward, EpisodeStarts
from lw_torchrl.suites.metaworld.vectorized.tables import reward_table, simulation_table

FINGERS = np.array([1.0, -1.0])  # the two fingers are driven against each other by one number of the action


def available_cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class VectorizedEngine(SeenRows):
    """Simulates all rows together: physics in threads, by default one a core, everything else in NumPy over all rows.

    Its numbers are those of :class:`~lw_torchrl.suites.metaworld.plain_engine.MetaWorldEngine`, bit for bit, whatever
    the number of threads. The rows of one XML file share a compiled model; each has a state of its own. Another
    Meta-World or MuJoCo than the one this engine was compared with is an ImportError.

    A row faults when its action is not finite, or when its simulation becomes unstable. It then repeats its last stable
    observation and is not simulated until it is reset; other rows are not affected.

    Example:
        >>> engine = VectorizedEngine(["reach", "push"], num_threads=1)
        >>> engine.reset([0, 1], seeds=[7, 8]).shape
        (2, 39)
        >>> engine.step(np.zeros((2, 4), np.float32), np.array([True, True])).success
        array([False, False])
        >>> engine.close()
    """

    def __init__(
        self, tasks: Sequence[str], *, reward: Literal["sparse", "dense"] = "sparse", num_threads: int | None = None
    ) -> None:
        task_programs.check_versions()
        dense = check_choice("reward", reward, ("sparse", "dense")) == "dense"
        num_threads = check_int("num_threads", available_cores() if num_threads is None else num_threads, minimum=1)
        tasks = [check_task(task) for task in tasks]
        self._groups = simulated_rows.split_into_groups([task_programs.model_path(task) for task in tasks], num_threads)
        rewards = [reward_table()[task] if dense else None for task in tasks]
        rows: dict[int, simulated_rows.SimulatedRow] = {}
        models: list[task_programs.SharedModel] = []
        # A borrowed model goes back even if the engine is never closed.
        self._return_models = weakref.finalize(self, task_programs.return_models, models)
        for group in self._groups:
            models.append(task_programs.borrow_model(task_programs.model_path(tasks[group.rows[0]])))
            here = {tasks[row] for row in group.rows}
            programs = {task: task_programs.program_class(task)(models[-1].model) for task in here}
            for row in group.rows:
                sources, program = simulation_table()[tasks[row]], programs[tasks[row]]
                rows[row] = simulated_rows.SimulatedRow(sources, models[-1], program, rewards[row])
        self._rows = [rows[row] for row in range(len(tasks))]
        self._starts = EpisodeStarts([reward for reward in rewards if reward is not None]) if dense else None
        self._width = at.REWARD_WIDTH if dense else at.WIDTH
        self._pool = simulated_rows.WorkerPool(num_threads)

        n, builders = len(tasks), [row.builder for row in self._rows]
        bounds = [builder.sawyer_observation_space for builder in builders]
        self._low = np.array([space.low for space in bounds]).reshape(n, METAWORLD.size)
        self._high = np.array([space.high for space in bounds]).reshape(n, METAWORLD.size)
        self._mocap_low = np.array([builder.mocap_low for builder in builders]).reshape(n, 3)
        self._mocap_high = np.array([builder.mocap_high for builder in builders]).reshape(n, 3)
        (self._action_scale,) = {builder.action_scale for builder in builders} or {0.01}  # all tasks share one

        self._mocap = np.zeros((n, 3))
        self._goal = np.zeros((n, 3))
        self._current = np.zeros((n, 18))
        self._observation = np.zeros((n, METAWORLD.size))
        self._started = np.zeros(n, dtype=bool)
        self._faulted = np.zeros(n, dtype=bool)
        self._running: _RunningRows | None = None

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> Array:
        index, seed_of = seeds_of_rows(rows, seeds)
        # A reset that fails half-way leaves rows that must not be stepped.
        self._started[index] = False

        def reset(row: int) -> None:
            self._observation[row] = self._rows[row].reset(seed_of[row])
            self._mocap[row] = self._rows[row].mocap
            self._goal[row] = self._rows[row].program._target_pos
            if self._starts is not None:
                self._starts.begin(row, self._rows[row].program)

        self._pool.work(self._by_group(index), reset)
        self._current[index] = self._observation[index, at.CURRENT]
        self._faulted[index] = False
        self._started[index] = True
        return self._observation[index]

    def step(self, action: NDArray[Any], active: Mask) -> EngineStep:
        n = len(self._rows)
        action, active = checked_step(action, active, self._started, METAWORLD.action_size)
        # NaN must not reach the physics: MuJoCo would silently restart the row.
        self._faulted |= active & ~np.isfinite(action).all(axis=1)
        reward, success = np.zeros(n), np.zeros(n, dtype=bool)
        running = active & ~self._faulted
        if running.any():
            key = running.tobytes()
            if self._running is None or self._running.key != key:  # the mask seldom changes
                self._running = _RunningRows(self, running, key)
            self._step_running(self._running, action, reward, success)
        return EngineStep(self._observation.copy(), reward, success, active & self._faulted)

    def _seen(self, row: int) -> tuple[RowModel, Any]:
        return self._rows[row].seen()

    def close(self) -> None:
        """End the threads and give the models back, for the next engine of this process."""
        super().close()
        self._pool.close()
        self._rows = []
        self._running = None
        self._return_models()

    def _step_running(self, running: _RunningRows, action: NDArray[Any], reward: Array, success: Mask) -> None:
        rows = running.rows
        action = action[rows]
        shift = np.minimum(np.maximum(action[:, :3], -1), 1) * self._action_scale
        mocap = np.minimum(np.maximum(self._mocap[rows] + shift, running.mocap_low), running.mocap_high)
        self._mocap[rows] = mocap
        sensors = np.empty((len(rows), self._width))
        warnings = np.empty((len(rows), 3), dtype=np.int32)
        control = action[:, 3:] * FINGERS

        def simulate(k: int) -> None:
            running.members[k].simulate(mocap[k], control[k], sensors[k], warnings[k])

        self._pool.work(running.groups, simulate)

        current = running.observer.current(sensors)
        goal = self._goal[rows]
        observation = np.concatenate((current, self._current[rows], goal), axis=1)
        np.clip(observation, running.low, running.high, out=observation)
        achieved = running.success(sensors, current, goal)
        rewards = achieved if running.reward is None else running.reward(sensors, observation, goal, action)
        warned = (warnings != task_programs.WARNED_ALREADY).any(axis=1)
        stable = np.isfinite(observation).all(axis=1) & ~warned
        if not stable.all():
            self._faulted[rows[~stable]] = True
            rows, current, observation = rows[stable], current[stable], observation[stable]
            achieved, rewards = achieved[stable], rewards[stable]
        self._current[rows] = current
        self._observation[rows] = observation
        success[rows] = achieved
        reward[rows] = rewards

    def _by_group(self, rows: Index) -> list[tuple[simulated_rows.RowGroup, list[int]]]:
        wanted = set(rows.tolist())
        found = [(group, [row for row in group.rows if row in wanted]) for group in self._groups]
        return [(group, members) for group, members in found if members]


class _RunningRows:
    """What is constant for one set of running rows."""

    def __init__(self, engine: VectorizedEngine, running: Mask, key: bytes) -> None:
        self.key = key
        self.rows = rows = np.flatnonzero(running)
        self.members = members = [engine._rows[row] for row in rows]
        sources = [member.sources for member in members]
        self.observer = Observer(sources)
        self.success = SuccessFunction(sources, lambda k: members[k].program)
        self.reward = None if engine._starts is None else DenseReward(engine._starts, rows)
        place = {row: k for k, row in enumerate(rows.tolist())}
        self.groups = [(group, [place[row] for row in items]) for group, items in engine._by_group(rows)]
        self.low, self.high = engine._low[rows], engine._high[rows]
        self.mocap_low, self.mocap_high = engine._mocap_low[rows], engine._mocap_high[rows]
