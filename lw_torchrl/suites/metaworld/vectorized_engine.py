"""The vectorized engine: Meta-World bit for bit, at nearly the speed of its physics."""

import weakref
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.reproducibility import version_changes
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.language.tasks import check_task
from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld import simulated_rows, task_programs
from lw_torchrl.suites.metaworld.dense_reward import DenseReward, EpisodeStarts
from lw_torchrl.suites.metaworld.observation import Array, Index, Mask, Observer, SuccessFunction
from lw_torchrl.suites.metaworld.tables import reward_table, simulation_table

FINGERS = np.array([1.0, -1.0])  # one number of the action moves both fingers, in opposite directions


class VectorizedEngine(simulated_rows.ThreadedEngine):
    """An engine that simulates all rows together: physics in threads, everything else in NumPy over all rows.

    Its numbers equal those of :class:`~lw_torchrl.suites.metaworld.plain_engine.MetaWorldEngine`, bit for bit, for any
    number of threads. Rows of one XML file share a compiled model.

    A row faults if its action is not finite or its simulation becomes unstable. It then repeats its last stable
    observation and is not simulated until its reset; other rows are not affected.

    Args:
        tasks: the task of each row.
        reward: "sparse" for the success as 0 or 1, or "dense" for Meta-World's own.
        num_threads: number of threads that simulate; None for one per core.

    Raises:
        ImportError: this engine was not compared with the installed version of Meta-World or MuJoCo.

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
        compared = task_programs.COMPARED_VERSIONS
        if changes := version_changes(compared, compared):
            raise ImportError(
                f"engine: the vectorized engine was compared with other versions ({', '.join(changes)}); install "
                "those, or use engine='metaworld', which runs any version"
            )
        dense, tasks = reward == "dense", [check_task(task) for task in tasks]
        super().__init__([task_programs.model_path(task) for task in tasks], METAWORLD, num_threads)
        rewards = [reward_table()[task] if dense else None for task in tasks]
        rows: dict[int, simulated_rows.SimulatedRow] = {}
        models: list[task_programs.SharedModel] = []
        # Models are returned even if the engine is never closed.
        self._return_models = weakref.finalize(self, task_programs.return_models, models)
        for group in self._groups:
            models.append(task_programs.borrow_model(task_programs.model_path(tasks[group.rows[0]])))
            programs = {
                task: task_programs.program_class(task)(models[-1].model) for task in {tasks[row] for row in group.rows}
            }
            for row in group.rows:
                sources, program = simulation_table()[tasks[row]], programs[tasks[row]]
                rows[row] = simulated_rows.SimulatedRow(sources, models[-1], program, rewards[row])
        self._rows = [rows[row] for row in range(len(tasks))]
        self._starts = EpisodeStarts([reward for reward in rewards if reward is not None]) if dense else None
        self._width = at.REWARD_WIDTH if dense else at.WIDTH
        n, builders = len(tasks), [row.builder for row in self._rows]
        bounds = [builder.sawyer_observation_space for builder in builders]
        self._low = np.array([space.low for space in bounds]).reshape(n, METAWORLD.size)
        self._high = np.array([space.high for space in bounds]).reshape(n, METAWORLD.size)
        self._mocap_low = np.array([builder.mocap_low for builder in builders]).reshape(n, 3)
        self._mocap_high = np.array([builder.mocap_high for builder in builders]).reshape(n, 3)
        (self._action_scale,) = {builder.action_scale for builder in builders} or {0.01}  # all tasks share one

        self._mocap = np.zeros((n, 3))
        self._current = np.zeros((n, 18))
        self._running: _RunningRows | None = None

    def _reset_row(self, row: int, seed: int) -> None:
        self._observation[row] = self._rows[row].reset(seed)
        self._mocap[row] = self._rows[row].mocap
        self._goal[row] = self._rows[row].program._target_pos
        if self._starts is not None:
            self._starts.begin(row, self._rows[row].program)

    def _observe_first(self, rows: Index) -> None:
        self._current[rows] = self._observation[rows, at.CURRENT]

    def close(self) -> None:
        """End the threads and return the models, for the next engine of this process."""
        super().close()
        self._running = None
        self._return_models()

    def _step_running(self, rows: Index, action: NDArray[Any], reward: Array, success: Mask) -> None:
        if self._running is None or not np.array_equal(self._running.rows, rows):  # they seldom change
            self._running = _RunningRows(self, rows)
        running, action = self._running, action[rows]
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


class _RunningRows:
    """The constants of a set of running rows, prepared once."""

    def __init__(self, engine: VectorizedEngine, rows: Index) -> None:
        self.rows = rows
        self.members = members = [engine._rows[row] for row in rows]
        sources = [member.sources for member in members]
        self.observer = Observer(sources)
        self.success = SuccessFunction(sources, lambda k: members[k].program)
        self.reward = None if engine._starts is None else DenseReward(engine._starts, rows)
        place = {row: k for k, row in enumerate(rows.tolist())}
        self.groups = [(group, [place[row] for row in items]) for group, items in engine._by_group(rows)]
        self.low, self.high = engine._low[rows], engine._high[rows]
        self.mocap_low, self.mocap_high = engine._mocap_low[rows], engine._mocap_high[rows]
