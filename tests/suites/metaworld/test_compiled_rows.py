"""The compiled simulation: the bits of Python threads, errors of MuJoCo, forks, threads and Ctrl-C."""

import ctypes
import os
import signal
import sys
import threading
import time
import warnings
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from numba import njit
from numba.core.caching import CompileResultCacheImpl
from test_vectorized_engine import SHARING, TASKS, VARIED, differences, memory, play, same_bits

from lw_torchrl.suites.metaworld import row_kernel, simulated_rows
from lw_torchrl.suites.metaworld.compiled_rows import CompiledRows, addresses_of, find_row_kernel
from lw_torchrl.suites.metaworld.environments import WARNED_ALREADY
from lw_torchrl.suites.metaworld.simulated_rows import RowGroup, WorkerPool
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

STATE = ("qpos", "qvel", "qacc", "qacc_warmstart", "xpos", "xquat", "site_xpos", "efc_force", "time")


def state_differences(engine: VectorizedEngine, other: VectorizedEngine) -> list[tuple[int, str]]:
    """Return the (row, field) pairs in which the simulators' states differ."""
    pairs = [(a._data, b._data) for a, b in zip(engine._rows, other._rows, strict=True)]
    same = lambda a, b, name: np.array_equal(getattr(a, name), getattr(b, name))  # noqa: E731
    return [(row, name) for row, (a, b) in enumerate(pairs) for name in STATE if not same(a, b, name)]


def python_engine(tasks: list[str], **options) -> VectorizedEngine:
    """Make an engine that simulates in Python threads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated_rows, "find_row_kernel", lambda: None)
        return VectorizedEngine(tasks, **options)


MAKERS = [pytest.param(VectorizedEngine, id="compiled"), pytest.param(python_engine, id="python")]


def test_simulation_is_compiled_by_default():
    assert VectorizedEngine(["reach"])._compiled is not None
    assert python_engine(["reach"])._compiled is None


@pytest.mark.parametrize("tasks", [SHARING * 2 + VARIED, pytest.param(TASKS, marks=pytest.mark.slow)], ids=len)
def test_masks_and_resets_have_the_bits_of_python_threads(tasks):
    """Compare all results and the whole states, for any number of threads, in single and in double precision."""
    n, rng = len(tasks), np.random.default_rng(2)
    python = python_engine(tasks, num_threads=1, reward="dense")
    engines = [VectorizedEngine(tasks, num_threads=threads, reward="dense") for threads in (1, 3)]
    engines.append(python_engine(tasks, num_threads=2, reward="dense"))
    for engine in (python, *engines):
        engine.reset(range(n), range(n))
    for step in range(30):
        if step % 7 == 3:
            rows = rng.permutation(n)[: rng.integers(1, n)].tolist()
            for engine in (python, *engines):
                engine.reset(rows, [step + row for row in rows])
        active = rng.random(n) < (1.0 if step % 5 == 0 else 0.6)
        action = rng.uniform(-1, 1, (n, 4)).astype(rng.choice([np.float32, np.float64]))
        action[:, 2] -= 0.4  # downwards, to make contacts
        expected = python.step(action, active)
        for engine in engines:
            assert not differences(expected, engine.step(action, active)), f"step {step}"
            assert not state_differences(engine, python), f"step {step}"


def test_shortened_substep_has_the_bits_of_a_whole_one(monkeypatch):
    """The first substep reuses the last step's mj_forward. Compare all tasks, with a reset in between."""
    n, rng = len(TASKS), np.random.default_rng(0)
    engine, plain = VectorizedEngine(TASKS, num_threads=1), python_engine(TASKS, num_threads=1)
    for row in plain._rows:
        monkeypatch.setattr(row, "_substep_after_look", lambda row=row: mujoco.mj_step(row._model, row._data))
    for step in range(20):
        action = rng.uniform(-1, 1, (n, 4)).astype(np.float32)
        action[:, 2] -= 0.5
        for k in (engine, plain):
            if step % 10 == 0:
                k.reset(range(n), range(step, step + n))
            k.step(action, np.ones(n, bool))
        assert not state_differences(engine, plain), f"step {step}"
    assert sum(row._data.ncon for row in engine._rows) > n


def test_first_step_of_an_episode_is_not_shortened(monkeypatch):
    """Positions computed in a reset may be older than its last change."""
    calls, engine = [], python_engine(["push"], num_threads=1)
    monkeypatch.setattr(engine._rows[0], "_substep_after_look", lambda: calls.append(1))
    for expected in ([], [], [1]):
        if not expected:
            engine.reset([0], [0])
        engine.step(np.zeros((1, 4)), np.ones(1, bool))
        assert calls == expected


class SmallRow:
    """A row with a model of its own, a falling ball with a mocap body."""

    def __init__(self, integrator: int = 0) -> None:
        body = "<body><freejoint/><geom size='.1'/></body><body mocap='true' name='target'/>"
        self.model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
        self.model.opt.integrator = integrator
        self.data = mujoco.MjData(self.model)
        self.data.warning.number[:] = WARNED_ALREADY

    def describe(self) -> dict:
        return {
            "model": self.model, "data": self.data._address, "substeps": 2, "looks": True,
            "inputs_at": addresses_of(self.data.mocap_pos[0]), "zeros_at": addresses_of(self.data.qpos[:1]),
            "outputs_at": addresses_of(self.data.qpos), "warnings_at": addresses_of(self.data.warning.number[4:7]),
        }  # fmt: skip


@pytest.mark.parametrize("threads", [1, 2])
def test_error_of_mujoco_is_caught_in_its_row(threads):
    rows = [SmallRow(), SmallRow(integrator=17), SmallRow(), SmallRow()]
    compiled, pool = CompiledRows(row_kernel, rows, [[0, 1, 2, 3]]), WorkerPool(threads)
    outputs = np.zeros((3, 7))
    find_handler = row_kernel._mujoco._mjPRIVATE__get_tls_error_fn
    find_handler.restype = ctypes.c_void_p
    handler = find_handler()
    for _ in range(100):
        stable = compiled.simulate(np.array([0, 1, 2]), np.ones((3, 3)), outputs, pool.run)
        assert stable.tolist() == [True, False, True]
    assert np.array_equal(outputs[0], rows[0].data.qpos)
    assert (rows[0].data.time, rows[0].data.mocap_pos.tolist()) == (pytest.approx(0.4), [[1.0, 1.0, 1.0]])
    assert (rows[3].data.time, find_handler()) == (0.0, handler)
    with pytest.raises(mujoco.FatalError):
        mujoco.mj_step(rows[1].model, rows[1].data)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("make", MAKERS)
def test_error_of_mujoco_is_a_fault_until_the_reset(make, threads):
    """Row 1 has too little memory, which is an error of MuJoCo that ends a process by default."""
    tasks = ["push", "push", "door-open"]
    engine, twin = make(tasks, num_threads=threads), VectorizedEngine(tasks, num_threads=1)
    for k in (engine, twin):
        k.reset(range(3), range(3))
    action, everyone = np.full((3, 4), 0.3), np.ones(3, bool)
    twin.step(action, everyone)
    first = engine.step(action, everyone).observation[1]
    data = engine._rows[1]._data
    memory, data.narena = data.narena, 4000
    for _ in range(3):
        expected, got = twin.step(action, everyone), engine.step(action, everyone)
        assert (got.fault.tolist(), {row for row, _ in differences(expected, got)}) == ([False, True, False], {1})
        assert np.array_equal(got.observation[1], first)
    data.narena = memory
    assert same_bits(engine.reset([1], [5]), twin.reset([1], [5])).all()
    for _ in range(10):
        assert not differences(twin.step(action, everyone), engine.step(action, everyone))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e12, 1e300])
@pytest.mark.parametrize("field", ["qpos", "qvel", "qacc_warmstart", "qfrc_applied", "xfrc_applied", "mocap_quat"])
def test_extreme_states_have_the_results_of_python_threads(field, value):
    """None of these ends the process; what faults in Python threads faults in compiled code."""
    tasks = [*SHARING, *VARIED]
    n = len(tasks)
    engines = [python_engine(tasks, num_threads=1), VectorizedEngine(tasks, num_threads=2)]
    for engine in engines:
        engine.reset(range(n), range(n))
        for row in range(0, n, 2):
            getattr(engine._rows[row]._data, field)[:] = value
    for step in range(3):
        results = [engine.step(np.full((n, 4), 0.1 * step), np.ones(n, bool)) for engine in engines]
        assert not differences(*results)
        assert not results[0].fault[1::2].any()


def test_pool_works_in_a_fork_of_a_process_with_threads():
    tasks = ["push", "reach", "door-open"]
    engine, twin = VectorizedEngine(tasks, num_threads=3), VectorizedEngine(tasks, num_threads=1)
    play(engine, tasks, 5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of forks of a process with threads
        child = os.fork()
    if not child:
        status = 1
        try:
            signal.alarm(60)
            ours, others = play(engine, tasks, 5, seed=1), play(twin, tasks, 5, seed=1)
            busy = sum(thread.name == "lw_torchrl" for thread in threading.enumerate())
            status = 0 if busy == 2 and all(same_bits(a, b).all() for a, b in zip(ours, others, strict=True)) else 2
        finally:
            os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    play(engine, tasks, 5)


@pytest.mark.parametrize("steps", [200, pytest.param(10_000, marks=pytest.mark.slow)])
def test_engines_in_two_python_threads_do_not_disturb_each_other(steps):
    tasks = ["coffee-pull", "coffee-push", "reach"]
    results: dict[int, np.ndarray] = {}

    def run(number: int) -> None:
        engine = VectorizedEngine(tasks, num_threads=number)
        results[number] = play(engine, tasks, steps)[-1]
        engine.close()

    threads = [threading.Thread(target=run, args=(number,)) for number in (1, 2, 3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    expected = play(python_engine(tasks, num_threads=1), tasks, steps)[-1]
    assert all(same_bits(expected, result).all() for result in results.values())
    assert len(results) == 3


@pytest.mark.slow
@pytest.mark.parametrize("make", MAKERS)
def test_rows_of_an_interrupted_step_must_be_reset(make):
    """Press Ctrl-C at random moments of 30 runs."""
    tasks = [*SHARING, *VARIED] * 2
    n, rng, action = len(tasks), np.random.default_rng(0), np.full((24, 4), 0.3)
    engine, everyone, interrupted = make(tasks, num_threads=3), np.ones(24, bool), 0
    expected = play(VectorizedEngine(tasks, num_threads=1), tasks, 3)[-1]
    engine.reset(range(n), range(n))
    for wait in rng.uniform(0.005, 0.03, 30):
        pressed = threading.Timer(wait, os.kill, (os.getpid(), signal.SIGINT))
        try:
            pressed.start()
            while True:
                engine.step(action, everyone)
        except KeyboardInterrupt:
            pressed.join()
        if not engine._started.all():
            interrupted += 1
            with pytest.raises(RuntimeError, match="row 0 must be reset"):
                engine.step(action, everyone)
            engine.reset(range(n), range(n))
    assert interrupted > 3
    assert same_bits(play(engine, tasks, 3)[-1], expected).all()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda patch: patch.setitem(sys.modules, "numba", None), "ModuleNotFoundError: import of numba halted"),
        (lambda patch: patch.setattr(CompileResultCacheImpl, "_locator_classes", []), "no locator available"),
        (lambda patch: patch.setenv("NUMBA_DISABLE_JIT", "1"), "NUMBA_DISABLE_JIT"),
        (lambda patch: patch.delattr("numba.extending.intrinsic"), "cannot import name 'intrinsic'"),
        (lambda patch: patch.setattr(mujoco, "_functions", SimpleNamespace(__file__=None)), "AttributeError.*mj_step"),
    ],
)
def test_engine_warns_once_and_simulates_in_python_threads(change, reason, monkeypatch):
    expected = play(VectorizedEngine(["reach"], num_threads=1), ["reach"], 3)[-1]
    monkeypatch.delitem(sys.modules, "lw_torchrl.suites.metaworld.row_kernel")
    monkeypatch.delattr("lw_torchrl.suites.metaworld.row_kernel")
    find_row_kernel.cache_clear()
    change(monkeypatch)
    try:
        with pytest.warns(UserWarning, match=f"Python threads.*{reason}.*NUMBA_CACHE_DIR") as caught:
            engines = [VectorizedEngine(["reach"], num_threads=1) for _ in range(2)]
        assert ([engine._compiled for engine in engines], len(caught)) == ([None, None], 1)
        assert same_bits(play(engines[0], ["reach"], 3)[-1], expected).all()
    finally:
        find_row_kernel.cache_clear()


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
@pytest.mark.parametrize("steps", [5_000, pytest.param(100_000, marks=pytest.mark.slow)])
def test_memory_stays_flat(steps):
    engine, rng = VectorizedEngine(["reach", "door-close"], num_threads=2), np.random.default_rng(0)
    active = np.ones(2, bool)
    action = rng.uniform(-1, 1, (100, 2, 4))
    engine.reset([0, 1], [0, 1])
    for step in range(steps):
        if step == 1000:
            before = memory()
        engine.step(action[step % 100], active)
    assert memory() - before < 2e6


def busy_call(done: list[bool], error: type[BaseException] | None):
    """Return a function that takes 50 ms in another thread, while the main thread returns or raises at once."""
    started = threading.Event()

    def call(item: int = 0) -> None:
        if threading.current_thread() is not threading.main_thread():
            started.set()
            time.sleep(0.05)
            done.append(True)
        else:
            assert started.wait(10)
            if error is not None:
                raise error

    return call


@pytest.mark.parametrize("error", [None, ZeroDivisionError])
def test_pool_waits_for_a_thread_that_is_still_busy(error):
    pool, done = WorkerPool(2), []
    with nullcontext() if error is None else pytest.raises(error):
        pool.work([(RowGroup([k]), [k]) for k in range(2)], busy_call(done, error))
    assert done == [True]
    pool.close()


def test_next_call_waits_for_a_thread_of_an_interrupted_call():
    pool, done = WorkerPool(2), []
    with pytest.raises(KeyboardInterrupt):
        pool.run(busy_call(done, KeyboardInterrupt), 1)
    pool.run(lambda: done.append(bool(done)), 0)
    assert done == [True, True]
    pool.close()


def test_no_two_threads_take_the_same_row():
    @njit(nogil=True)
    def take(counts: np.ndarray, taken: np.ndarray) -> None:
        for k in range(len(taken)):
            taken[k] = row_kernel.add_atomically(counts.ctypes.data, 1)

    counts, taken = np.zeros(1, np.int64), np.zeros((3, 1_000_000), np.int64)
    take(counts, taken[0, :0])
    threads = [threading.Thread(target=take, args=(counts, numbers)) for numbers in taken]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(np.sort(taken.ravel()), np.arange(taken.size))


@pytest.mark.parametrize("last", range(3))
def test_call_returns_when_all_rows_are_done(last):
    """Row ``last`` takes a second; the thread that does not simulate it waits."""
    rows = [SmallRow() for _ in range(3)]
    compiled, pool = CompiledRows(row_kernel, rows, [[0, 1, 2]]), WorkerPool(3)
    compiled._table["substeps"][last] = 200_000
    for now in (2, 4):
        compiled.simulate(np.arange(3), np.ones((3, 3)), np.zeros((3, 7)), pool.run)
        steps = [now * 100_000 if row == last else now for row in range(3)]
        assert [round(row.data.time / row.model.opt.timestep) for row in rows] == steps
    pool.close()


def test_engine_has_no_more_threads_than_rows():
    before = set(threading.enumerate())
    engine = VectorizedEngine(["reach", "push"], num_threads=16)
    assert len(set(threading.enumerate()) - before) == 1
    engine.close()


def test_closed_and_collected_pools_end_their_threads():
    before = set(threading.enumerate())
    closed, collected = WorkerPool(3), WorkerPool(2)
    threads = set(threading.enumerate()) - before
    assert len(threads) == 3
    for pool in (closed, collected):
        pool.run(lambda: None, 2)
    closed.close()
    del collected, pool
    for thread in threads:
        thread.join(10)
    assert not any(thread.is_alive() for thread in threads)
