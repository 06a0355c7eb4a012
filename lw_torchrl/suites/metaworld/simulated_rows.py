"""Rows (MuJoCo states that share models) and a base class for engines that simulate groups of rows in threads."""

import os
import threading
import weakref
from abc import abstractmethod
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import ceil
from time import perf_counter
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from lw_torchrl._util.workers import available_cores
from lw_torchrl.language.layout import Layout
from lw_torchrl.suites.cameras import SeenRows
from lw_torchrl.suites.engine import BodyPoses, EngineStep, RowModel, checked_step, seeds_of_rows
from lw_torchrl.suites.metaworld import observation as at
from lw_torchrl.suites.metaworld.compiled_rows import CompiledRows, addresses_of, find_row_kernel
from lw_torchrl.suites.metaworld.environments import UNSTABLE, WARNED_ALREADY, SharedModel
from lw_torchrl.suites.metaworld.observation import Array, Index, Mask, StateView
from lw_torchrl.suites.metaworld.tables import TaskReward, TaskSources

_VELOCITIES_DONE = int(mujoco.mjtStage.mjSTAGE_VEL)


class SimulatedRow:
    """A row of the engine: a MuJoCo state, the positions of bodies and sites chosen by the last reset, and a copy of
    the Meta-World environment. No other thread may use the ``shared`` model while this row simulates or resets."""

    def __init__(self, sources: TaskSources, shared: SharedModel, builder: Any, reward: TaskReward | None) -> None:
        self.sources = sources
        self.shared = shared
        self.program: Any = None
        self.builder = builder
        self._model = shared.model
        self._data = mujoco.MjData(shared.model)
        self.bodies = BodyPoses(self._data.xpos, self._data.xquat)  # views of the current state
        self._places = shared.compiled[0].copy(), shared.compiled[1].copy()
        self._substeps: int = builder.frame_skip
        self.mocap: Array = self._data.mocap_pos[0]  # a weld pulls the hand to this point
        self._control: Array = self._data.ctrl
        window = StateView(self._model, self._data)
        self._numbers = window.numbers
        self._sensor_index = at.sensor_index(window, sources, reward)
        self._has_matrix = sources.quaternion.startswith(at.MATRIX_OF)
        self._looked = False
        self._warnings: NDArray[np.int32] = self._data.warning.number[UNSTABLE]

    def reset(self, seed: int) -> Array:
        """Start an episode, which depends only on the seed, and return the first observation."""
        self.shared.restore()
        self._looked = False
        self.program = self.builder.on(self._data)
        observation = self.program.start_episode(seed)
        self._places[0][...], self._places[1][...] = self.shared.places
        self.shared.holder = self
        return observation

    def simulate(self, inputs: Array, outputs: Array) -> bool:
        """Write the inputs (mocap position, controls), simulate five physics steps, and fill the outputs (sensors).
        Return whether the simulation is stable."""
        self._take_model()
        self.mocap[...] = inputs[:3]
        self._control[...] = inputs[3:]
        if self._looked:
            self._substep_after_look()
        mujoco.mj_step(self._model, self._data, self._substeps - self._looked)
        mujoco.mj_forward(self._model, self._data)  # the next physics step starts its solver from these accelerations
        self._looked = True
        self.read_sensors(outputs)
        return bool((self._warnings == WARNED_ALREADY).all())

    def read_sensors(self, outputs: Array) -> None:
        """Fill (WIDTH,), or (REWARD_WIDTH,) with a dense reward, from the current state."""
        self._numbers.take(self._sensor_index, out=outputs, mode="clip")
        if self._has_matrix:
            outputs[at.QUATERNION] = at.quaternion_of_matrix(outputs[at.MATRIX].tolist())

    def describe(self) -> dict[str, Any]:
        """Return the arguments of :class:`~lw_torchrl.suites.metaworld.compiled_rows.CompiledRows` for this row."""
        return {
            "model": self._model,
            "places": self._places,
            "data": self._data._address,
            "substeps": self._substeps,
            "looks": True,
            "looks_ahead": True,
            "has_matrix": self._has_matrix,
            "inputs_at": addresses_of(self.mocap, self._control),
            "zeros_at": [],
            "outputs_at": self._numbers.ctypes.data + self._numbers.itemsize * self._sensor_index,
            "warnings_at": addresses_of(self._warnings),
        }

    def seen(self) -> tuple[RowModel, Any]:
        """Load this row's positions of bodies and sites into the shared model, then return the model and the data."""
        self._take_model()
        return RowModel(self.shared.path, self._model), self._data

    def _substep_after_look(self) -> None:
        """Do one ``mj_step`` when only the controls and the mocap body have changed since the last ``mj_forward``.

        The mocap body has no contacts and affects only the weld to the hand. So the contacts, inertia and velocities of
        the ``mj_forward`` are still valid, and reusing them saves a tenth of the time with bit-identical results. The
        Newton solver needs no projection of constraints. The next substep detects non-finite and too large values.
        """
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_makeConstraint(model, data)
        mujoco.mj_referenceConstraint(model, data)
        mujoco.mj_forwardSkip(model, data, _VELOCITIES_DONE, 1)  # 1: no sensors
        mujoco.mj_Euler(model, data)

    def _take_model(self) -> None:
        if self.shared.holder is not self:
            self.shared.load(self, self._places)


@dataclass
class RowGroup:
    """A group of rows that share a model and therefore run one after another; ``seconds`` is the last measured time per
    row."""

    rows: tuple[int, ...]
    seconds: float = 1.0


def split_into_groups(keys: Sequence[str], num_threads: int) -> list[RowGroup]:
    """Group rows by key, and split each group that has more than half as many rows as a thread's share."""
    by_key: dict[str, list[int]] = defaultdict(list)
    for row, key in enumerate(keys):
        by_key[key].append(row)
    largest = len(keys) if num_threads == 1 else ceil(len(keys) / (2 * num_threads))
    parts = [part for rows in by_key.values() for part in np.array_split(rows, ceil(len(rows) / largest))]
    return [RowGroup(tuple(part.tolist())) for part in parts]


class WorkerPool:
    """A pool of threads. The calling thread is one of them, so a pool of N threads starts N - 1 threads."""

    def __init__(self, num_threads: int) -> None:
        self._helpers = num_threads - 1
        self._start()

    def _start(self) -> None:
        self._process, self._idle = os.getpid(), True
        self._call: list[Callable[[], object] | None] = [_do_nothing]
        self._wake, self._busy = ([threading.Lock() for _ in range(self._helpers)] for _ in range(2))
        for wake, busy in zip(self._wake, self._busy, strict=True):
            wake.acquire()
            # A daemon thread, because it is inside acquire() when Python exits. It holds no reference to the pool.
            threading.Thread(target=_help, args=(wake, busy, self._call), name="lw_torchrl", daemon=True).start()
        self._stop = weakref.finalize(self, _stop, self._call, self._wake)
        self._stop.atexit = False

    def run(self, call: Callable[[], object], helpers: int) -> None:
        """Call ``call()`` in this thread and in at most ``helpers`` others at once. All work must be done when the call
        of this thread returns; the other calls may return later."""
        if self._process != os.getpid():  # a fork has the pool's locks, but not its threads
            self._stop.detach()
            self._start()
        if not self._idle:  # after an error or Ctrl-C, other threads may still be busy
            self._finish()
        self._idle = False
        self._call[0] = call
        for wake in self._wake[:helpers]:
            if wake.locked():  # otherwise the helper has not yet noticed its previous wake-up
                wake.release()
        call()
        self._call[0] = _do_nothing
        self._idle = True

    def _finish(self) -> None:
        """Prevent other threads from starting the call, and wait for the threads that have started it."""
        self._call[0] = _do_nothing
        for busy in self._busy if self._process == os.getpid() else ():
            with busy:
                pass
        self._idle = True

    def work(self, groups: Iterable[tuple[RowGroup, Sequence[int]]], do: Callable[[int], None]) -> None:
        """Call ``do(item)`` for every item of every ``(group, items)`` pair, slowest groups first. Only one thread at a
        time processes a group, in order, so the group's rows may share a model."""
        waiting = deque(sorted(groups, key=lambda job: job[0].seconds * len(job[1]), reverse=True))
        errors: list[BaseException] = []
        caller = threading.get_ident()

        def work_through() -> None:
            try:
                while True:
                    try:
                        group, items = waiting.popleft()
                    except IndexError:
                        return
                    start = perf_counter()
                    for item in items:
                        do(item)
                    group.seconds = (perf_counter() - start) / len(items)
            except BaseException as error:
                waiting.clear()
                errors.append(error)
            finally:
                if threading.get_ident() == caller:
                    self._finish()

        self.run(work_through, len(waiting) - 1)
        if errors:
            raise errors[0]

    def close(self) -> None:
        self._finish()
        self._stop()


def _do_nothing() -> None:
    pass


def _help(wake: threading.Lock, busy: threading.Lock, call: list[Callable[[], object] | None]) -> None:
    while True:
        wake.acquire()
        with busy:
            if (now := call[0]) is None:
                return
            now()
            del now  # else the rows of a step stay in memory


def _stop(call: list[Callable[[], object] | None], wakes: Sequence[threading.Lock]) -> None:
    call[0] = None
    for wake in wakes:
        if wake.locked():
            wake.release()


class ThreadedEngine(SeenRows):
    """Base class for engines that simulate physics in parallel threads (one per core by default); rows with the same
    key share a MuJoCo model."""

    _rows: list[Any]  # each has ``seen`` and ``bodies``

    def __init__(self, keys: Sequence[str], layout: Layout, num_threads: int | None) -> None:
        threads = max(1, min(num_threads or available_cores(), len(keys)))
        self._groups, self._pool = split_into_groups(keys, threads), WorkerPool(threads)
        self._layout = layout
        self._goal = np.zeros((len(keys), 3))
        self._observation = np.zeros((len(keys), layout.size))
        self._started, self._faulted = np.zeros((2, len(keys)), dtype=bool)
        self._compiled: CompiledRows | None = None

    def _compile(self) -> None:
        """Set up the Numba kernel to simulate the rows, if Numba is available."""
        if (kernel := find_row_kernel()) is not None:
            self._compiled = CompiledRows(kernel, self._rows, [group.rows for group in self._groups])

    def _simulate(self, rows: Index, inputs: Array, outputs: Array) -> Mask:
        """Simulate rows with inputs (rows, K), fill outputs (rows, W), and return a bool mask (rows,) of the stable
        rows. Without the kernel, Python threads compute the same bits, but make ten slow Python calls per row."""
        if self._compiled is not None:
            return self._compiled.simulate(rows, inputs, outputs, self._pool.run)
        stable = np.zeros(len(rows), dtype=bool)
        place = {row: k for k, row in enumerate(rows.tolist())}

        def simulate(row: int) -> None:
            k = place[row]
            with suppress(mujoco.FatalError):
                stable[k] = self._rows[row].simulate(inputs[k], outputs[k])

        self._pool.work(self._by_group(rows), simulate)
        return stable

    @abstractmethod
    def _reset_row(self, row: int, seed: int) -> None:
        """Start an episode in a row; called in a worker thread."""

    @abstractmethod
    def _observe_first(self, rows: Index) -> None:
        """Write the first observations of the rows that were just reset."""

    @abstractmethod
    def _step_running(self, rows: Index, action: NDArray[Any], reward: Array, success: Mask) -> None:
        """Step ``rows``, given the actions of all rows; write their observations, rewards, success flags and faults."""

    def reset(self, rows: Sequence[int], seeds: Sequence[int]) -> Array:
        index, seed_of = seeds_of_rows(rows, seeds)
        # If the reset fails half-way, the rows stay marked as not started, so they cannot be stepped.
        self._started[index] = False
        self._pool.work(self._by_group(index), lambda row: self._reset_row(row, seed_of[row]))
        if self._compiled is not None:
            self._compiled.forget(index)
        self._observe_first(index)
        self._faulted[index] = False
        self._started[index] = True
        return self._observation[index]

    def step(self, action: NDArray[Any], active: Mask) -> EngineStep:
        action, active = checked_step(action, active, self._started, self._layout.action_size)
        # NaN must not reach the physics: MuJoCo would silently restart the row.
        self._faulted |= active & ~np.isfinite(action).all(axis=1)
        reward, success = np.zeros(len(active)), np.zeros(len(active), dtype=bool)
        if (rows := np.flatnonzero(active & ~self._faulted)).size:
            # If the step is interrupted, the rows stay marked as not started, so they must be reset.
            self._started[rows] = False
            self._step_running(rows, action, reward, success)
            self._started[rows] = True
        return EngineStep(self._observation.copy(), reward, success, active & self._faulted)

    def _by_group(self, rows: Index) -> list[tuple[RowGroup, list[int]]]:
        chosen = set(rows.tolist())
        groups = [(group, [row for row in group.rows if row in chosen]) for group in self._groups]
        return [(group, members) for group, members in groups if members]

    def _seen(self, row: int) -> tuple[RowModel, Any]:
        return self._rows[row].seen()

    def poses(self, row: int) -> BodyPoses:
        """Return the current poses of all bodies of a row. The shared model is not used, so other rows may use it."""
        position, quaternion = self._rows[row].bodies
        return BodyPoses(position.copy(), quaternion.copy())

    def close(self) -> None:
        super().close()
        self._pool.close()
        self._compiled = None
        self._rows = []
