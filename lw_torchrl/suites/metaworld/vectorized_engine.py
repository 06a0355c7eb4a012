"""The vectorized engine: bit-identical to Meta-World, at nearly the speed of the physics alone."""

import weakref
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.reproducibility import version_changes
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import check_task
from lw_torchrl.suites.metaworld import environments, simulated_rows
from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld.dense_reward import DenseReward, EpisodeStarts
from lw_torchrl.suites.metaworld.observation import Array, Index, Mask, Observer, SuccessFunction
from lw_torchrl.suites.metaworld.tables import reward_table, simulation_table

FINGERS = np.array([1.0, -1.0])  # one action value moves both fingers, in opposite directions


class VectorizedEngine(simulated_rows.ThreadedEngine):
    """An engine that simulates physics in threads and computes everything else in NumPy for all rows at once.

    With Numba (``lw_torchrl[fast]``, on Linux), one compiled call simulates all rows; without it, a warning states the
    reason. In both cases and for any number of threads, the results are bit-identical to those of
    :class:`~lw_torchrl.suites.metaworld.environments.MetaWorldEngine`. Rows with the same XML file share a compiled
    model.

    A row faults if the action is not finite, the simulation becomes unstable or MuJoCo raises an error. The row then
    repeats the last stable observation and is not simulated until it is reset; other rows are not affected.

    Args:
        tasks: the task of each row.
        reward: "sparse" for 1 at success and 0 otherwise, or "dense" for Meta-World's dense reward.
        num_threads: number of simulation threads; None for one per core.

    Raises:
        ImportError: this engine was not verified against the installed version of Meta-World or MuJoCo.

    Example:
        >>> engine = VectorizedEngine(["reach", "push"], num_threads=1)
        >>> engine.reset([0, 1], seeds=[7, 8]).shape
        (2, 39)
        >>> engine.step(np.zeros((2, 4), np.float32), np.array([True, True])).success
        array([False, False])
        >>> engine.close()
    """

    @typed
    def __init__(
        self, tasks: Sequence[str], *, reward: Literal["sparse", "dense"] = "sparse", num_threads: Count | None = None
    ) -> None:
        compared = environments.COMPARED_VERSIONS
        if changes := version_changes(compared, compared):
            raise ImportError(f"engine: unverified package versions ({', '.join(changes)}); use engine='metaworld'")
        dense, tasks = reward == "dense", [check_task(task) for task in tasks]
        super().__init__([environments.model_path(task) for task in tasks], METAWORLD, num_threads)
        rewards = [reward_table()[task] if dense else None for task in tasks]
        rows: dict[int, simulated_rows.SimulatedRow] = {}
        models: list[environments.SharedModel] = []
        # The models return to the pool even if the engine is never closed.
        self._return_models = weakref.finalize(self, environments.return_models, models)
        for group in self._groups:
            models.append(shared := environments.borrow_model(environments.model_path(tasks[group.rows[0]])))
            kinds = {tasks[row] for row in group.rows}
            programs = {task: environments.program_class(task)(shared.model) for task in kinds}
            for row in group.rows:
                sources, program = simulation_table()[tasks[row]], programs[tasks[row]]
                rows[row] = simulated_rows.SimulatedRow(sources, shared, program, rewards[row])
        self._rows = [rows[row] for row in range(len(tasks))]
        self._starts = EpisodeStarts([reward for reward in rewards if reward is not None]) if dense else None
        self._width = at.REWARD_WIDTH if dense else at.WIDTH
        n, builders = len(tasks), [row.builder for row in self._rows]
        bounds = [builder.sawyer_observation_space for builder in builders]
        self._low = np.array([space.low for space in bounds]).reshape(n, METAWORLD.size)
        self._high = np.array([space.high for space in bounds]).reshape(n, METAWORLD.size)
        self._mocap_low = np.array([builder.mocap_low for builder in builders]).reshape(n, 3)
        self._mocap_high = np.array([builder.mocap_high for builder in builders]).reshape(n, 3)
        (self._action_scale,) = {builder.action_scale for builder in builders} or {0.01}  # the same for all tasks

        self._mocap = np.zeros((n, 3))
        self._current = np.zeros((n, 18))
        self._running: _RunningRows | None = None
        self._compile()

    def _reset_row(self, row: int, seed: int) -> None:
        self._observation[row] = self._rows[row].reset(seed)
        self._mocap[row] = self._rows[row].mocap
        self._goal[row] = self._rows[row].program._target_pos
        if self._starts is not None:
            self._starts.begin(row, self._rows[row].program)

    def _observe_first(self, rows: Index) -> None:
        self._current[rows] = self._observation[rows, at.CURRENT]

    def close(self) -> None:
        """Stop the threads and make the models available to the next engine in this process."""
        super().close()
        self._running = None
        self._return_models()

    def _step_running(self, rows: Index, action: NDArray[Any], reward: Array, success: Mask) -> None:
        if self._running is None or not np.array_equal(self._running.rows, rows):  # the running rows seldom change
            self._running = _RunningRows(self, rows)
        running = self._running
        every = slice(None) if len(rows) == len(action) else rows  # a slice selects without a copy
        action = action[every]
        shift = np.minimum(np.maximum(action[:, :3], -1), 1) * self._action_scale
        mocap = np.minimum(np.maximum(self._mocap[every] + shift, running.mocap_low), running.mocap_high)
        self._mocap[every] = mocap
        inputs = np.concatenate((mocap, action[:, 3:] * FINGERS), axis=1)
        sensors = np.empty((len(rows), self._width))
        stable = self._simulate(rows, inputs, sensors)

        current = running.observer.observe(sensors)
        goal = self._goal[every]
        observation = np.concatenate((current, self._current[every], goal), axis=1)
        np.clip(observation, running.low, running.high, out=observation)
        achieved = running.success(sensors, goal)
        rewards = achieved if running.reward is None else running.reward(sensors, observation, goal, action)
        stable &= np.isfinite(observation).all(axis=1)
        if not stable.all():
            self._faulted[rows[~stable]] = True
            every, current, observation = rows[stable], current[stable], observation[stable]
            achieved, rewards = achieved[stable], rewards[stable]
        self._current[every] = current
        self._observation[every] = observation
        success[every] = achieved
        reward[every] = rewards


class _RunningRows:
    """The precomputed constants of a set of running rows."""

    def __init__(self, engine: VectorizedEngine, rows: Index) -> None:
        self.rows = rows
        members = [engine._rows[row] for row in rows]
        sources = [member.sources for member in members]
        self.observer = Observer(sources)
        self.success = SuccessFunction(sources, lambda k: members[k].program)
        self.reward = None if engine._starts is None else DenseReward(engine._starts, rows)
        self.low, self.high = engine._low[rows], engine._high[rows]
        self.mocap_low, self.mocap_high = engine._mocap_low[rows], engine._mocap_high[rows]
