"""The vectorized engine against Meta-World's own environments, bit for bit."""

import os
import time
import warnings
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from metaworld.policies import ENV_POLICY_MAP
from scipy.spatial.transform import Rotation

import lw_torchrl as lw
from lw_torchrl._util import reproducibility
from lw_torchrl.suites.engine import EngineStep
from lw_torchrl.suites.metaworld import row_kernel
from lw_torchrl.suites.metaworld.environments import MetaWorldEngine, borrow_model, model_path, return_models
from lw_torchrl.suites.metaworld.observation import quaternion_of_matrix, row_norm
from lw_torchrl.suites.metaworld.simulated_rows import RowGroup, WorkerPool, split_into_groups
from lw_torchrl.suites.metaworld.tables import simulation_table
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

TASKS = list(simulation_table())

# Three pairs of tasks that share a model; then tasks with a dial, joints, constants and both kinds of quaternions.
SHARING = ["drawer-open", "drawer-close", "assembly", "disassemble", "stick-push", "stick-pull"]
VARIED = ["reach", "basketball", "dial-turn", "hammer", "lever-pull", "box-close"]


def same_bits(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return whether each row agrees in every bit, (rows,): 0.0 differs from -0.0, and NaN equals itself."""
    assert (left.dtype, left.shape) == (right.dtype, right.shape)
    left, right = np.ascontiguousarray(left), np.ascontiguousarray(right)
    return (left.view(np.uint8) == right.view(np.uint8)).reshape(len(left), -1).all(axis=1)


def differences(expected: EngineStep, got: EngineStep) -> set[tuple[int, str]]:
    """Return the (row, field) pairs in which two results differ."""
    pairs = zip(EngineStep._fields, expected, got, strict=True)
    return {(int(row), field) for field, a, b in pairs for row in np.flatnonzero(~same_bits(a, b))}


def play(engine, tasks: list[str], steps: int, *, seed: int = 0) -> list[np.ndarray]:
    """Reset all rows and step them with random actions; return the observations of each step."""
    n = len(tasks)
    rng = np.random.default_rng(seed)
    observations = [engine.reset(range(n), [seed + row for row in range(n)])]
    for _ in range(steps):
        observations.append(engine.step(rng.uniform(-1, 1, (n, 4)).astype(np.float32), np.ones(n, bool)).observation)
    return observations


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [TASKS[k : k + 10] for k in range(0, 50, 10)], ids=lambda tasks: tasks[0])
def test_all_tasks_have_metaworlds_bits(tasks):
    """Two episodes of 500 steps, with noisy actions of experts in single and in double precision."""
    n = len(tasks)
    rng = np.random.default_rng(TASKS.index(tasks[0]))
    oracle = MetaWorldEngine(tasks, reward="dense")
    engines = [VectorizedEngine(tasks, reward="dense", num_threads=threads) for threads in (1, 2)]
    policies = [ENV_POLICY_MAP[f"{task}-v3"]() for task in tasks]
    succeeded, wrong = np.zeros(n, bool), set()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Constant.* may be too high")
        for precision in (np.float32, np.float64):
            seeds = rng.integers(2**31, size=n).tolist()
            observation = oracle.reset(range(n), seeds)
            for engine in engines:
                agrees = same_bits(observation, engine.reset(range(n), seeds))
                wrong |= {(tasks[row], "reset") for row in np.flatnonzero(~agrees)}
            for _ in range(500):
                action = [policy.get_action(row) for policy, row in zip(policies, observation, strict=True)]
                noise = 0.2 * rng.random((n, 1)) * rng.normal(size=(n, 4))
                action = np.clip(action + noise, -1.0, 1.0).astype(precision)
                expected = oracle.step(action, np.ones(n, bool))
                for engine in engines:
                    got = engine.step(action, np.ones(n, bool))
                    wrong |= {(tasks[row], field) for row, field in differences(expected, got)}
                observation = expected.observation
                succeeded |= expected.success
    for engine in (oracle, *engines):
        engine.close()
    assert not wrong
    assert succeeded.sum() >= 8, "few successes were compared"


@pytest.mark.slow
@pytest.mark.parametrize("tasks", [SHARING * 2, VARIED], ids=["shared models", "varied tasks"])
def test_masks_and_resets_in_any_order_have_metaworlds_bits(tasks):
    """Rows that share models, stepped and reset in any mixture by one or two threads, act as if alone."""
    n = len(tasks)
    rng = np.random.default_rng(1)
    oracle, engines = MetaWorldEngine(tasks), [VectorizedEngine(tasks, num_threads=threads) for threads in (1, 2)]
    everyone = np.ones(n, bool)
    for k in (oracle, *engines):
        k.reset(range(n), range(n))
    for step in range(45):
        if step % 7 == 3:
            rows = rng.permutation(n)[: rng.integers(1, n)].tolist()
            seeds = rng.integers(1000, size=len(rows)).tolist()
            first = oracle.reset(rows, seeds)
            assert all(same_bits(first, engine.reset(rows, seeds)).all() for engine in engines)
        active = everyone if step % 5 == 0 else rng.random(n) < 0.6
        action = rng.uniform(-1, 1, (n, 4)).astype(rng.choice([np.float32, np.float64]))
        expected = oracle.step(action, active)
        for engine in engines:
            before = engine.step(np.zeros((n, 4)), ~everyone).observation
            got = engine.step(action, active)
            assert not differences(expected, got), f"step {step}"
            assert same_bits(before, got.observation)[~active].all()
            assert not got.reward[~active].any()
            assert not got.success[~active].any()


def test_reset_restores_the_compiled_model():
    """plate-slide moves a body that plate-slide-back, on the same model, does not move."""
    engine = VectorizedEngine(["plate-slide", "plate-slide-back"], num_threads=1)
    engine.reset([0], [0])
    moved, compiled = engine._rows[0]._places[0], engine._rows[0].shared.compiled[0]
    assert not np.array_equal(moved, compiled)
    engine.reset([1], [0])
    assert np.array_equal(engine._rows[1]._places[0], compiled)


def test_results_are_new_arrays():
    engine, action = VectorizedEngine(["reach", "push"], num_threads=1), np.ones((2, 4), np.float32)
    results = [engine.reset([0, 1], [0, 1]), *engine.step(action, np.ones(2, bool))]
    copies = [array.copy() for array in results]
    engine.step(-action, np.ones(2, bool))
    assert all(np.array_equal(a, b) for a, b in zip(results, copies, strict=True))
    results[1][:] = np.nan
    assert np.isfinite(engine.step(action, np.zeros(2, bool)).observation).all()


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    ("field", "value"), [("action", np.inf), ("qpos", np.nan), ("qvel", 1e12), ("qfrc_applied", np.inf)]
)
def test_fault_stays_in_its_row(field, value, threads, tmp_path, monkeypatch, capfd):
    """Rows 0 to 2 share a model; row 1 becomes unstable at step 5."""
    monkeypatch.chdir(tmp_path)
    tasks = ["push", "push", "push", "drawer-open"]
    engine = VectorizedEngine(tasks, num_threads=threads, reward="dense")
    twin = VectorizedEngine(tasks, num_threads=1, reward="dense")
    rng = np.random.default_rng(0)
    everyone = np.ones(4, bool)
    for k in (engine, twin):
        k.reset(range(4), range(4))
    for step in range(12):
        action = rng.uniform(-1, 1, (4, 4)).astype(np.float32)
        expected = twin.step(action, everyone)
        if step == 5:
            (action[1] if field == "action" else getattr(engine._rows[1]._data, field))[3] = value
        got = engine.step(action, everyone)
        assert got.fault.tolist() == [False, step >= 5, False, False]
        assert {row for row, _ in differences(expected, got)} == ({1} if step >= 5 else set())
        if step < 5:
            stable = got.observation[1]
        else:
            assert [*got.observation[1], got.reward[1], got.success[1]] == [*stable, 0.0, False]
    assert not engine.step(action, np.zeros(4, bool)).fault.any(), "an inactive row does not fault"

    assert same_bits(twin.reset([1], [77]), engine.reset([1], [77])).all()
    for _ in range(20):
        action = rng.uniform(-1, 1, (4, 4)).astype(np.float32)
        assert not differences(twin.step(action, everyone), engine.step(action, everyone))
    assert list(tmp_path.iterdir()) == [], "MuJoCo left a log behind"
    assert capfd.readouterr() == ("", "")


def memory() -> int:
    """Return this process's memory in bytes."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads /proc")
def test_rows_need_little_memory_and_models_are_reused():
    tasks = ["reach", "push"] * 40
    VectorizedEngine(["reach", "push"], num_threads=1).close()
    before, start = memory(), time.perf_counter()
    engine = VectorizedEngine(tasks, num_threads=1)
    engine.reset(range(80), range(80))
    engine.step(np.zeros((80, 4)), np.ones(80, bool))
    assert (memory() - before) / 80 < 1.2e6
    assert time.perf_counter() - start < 5.0, "80 rows take about 0.6 s; 80 compiled models would take 10 s"
    second = VectorizedEngine(tasks, num_threads=1)
    models, others = ({id(row.shared) for row in k._rows} for k in (engine, second))
    assert len(models) == len(others) == 2
    assert not models & others, "engines that are open share no model"
    engine.close()
    again = VectorizedEngine(tasks, num_threads=1)
    assert {id(row.shared) for row in again._rows} == models


def test_collected_engine_returns_its_models():
    engine = VectorizedEngine(["plate-slide"], num_threads=1)
    engine.reset([0], [5])
    shared = engine._rows[0].shared
    assert not np.array_equal(shared.places[0], shared.compiled[0])
    del engine
    borrowed = borrow_model(model_path("plate-slide"))
    assert borrowed is shared
    assert np.array_equal(shared.places[0], shared.compiled[0])
    return_models([borrowed])


def test_reset_changes_only_places_of_bodies_and_sites():
    """Each row keeps its places of bodies and sites only, so a reset must change nothing else."""

    def arrays(model) -> dict[str, bytes]:
        fields = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
        return {name: field.tobytes() for name, field in fields.items() if isinstance(field, np.ndarray)}

    engine = VectorizedEngine(TASKS, num_threads=1)
    edited = set()
    for number, row in enumerate(engine._rows):
        before = arrays(row.shared.model)
        engine.reset([number], [number])
        edited |= {name for name, field in arrays(row.shared.model).items() if field != before[name]}
    assert edited == {"body_pos", "site_pos"}


@pytest.mark.parametrize(("package", "other"), [("metaworld", "3.2.0"), ("mujoco", "3.4.0")])
def test_plain_engine_runs_other_versions_with_one_warning_unless_vectorized_is_asked_for(monkeypatch, package, other):
    assert isinstance(lw.LanguageWorldEnv("reach", num_threads=1).engine, VectorizedEngine)
    monkeypatch.setattr(reproducibility, "version", lambda name: other if name == package else metadata.version(name))
    changed = rf"{package} 3\.\d\.\d, now {other}"
    lw.suites.metaworld._warn_once.cache_clear()
    make_envs = lambda: [lw.LanguageWorldEnv("reach", num_threads=2, max_steps=2) for _ in range(2)]  # noqa: E731
    with pytest.warns(UserWarning, match=f"{changed}.*4 times slower.*pip install metaworld==") as caught:
        envs = make_envs()
    assert [warning.filename for warning in caught if "slower" in str(warning.message)] == [__file__]
    for env in envs:
        env.rollout(2)
        assert isinstance(env.engine, MetaWorldEngine)
        env.close()
    for make in (lambda: VectorizedEngine(["reach"]), lambda: lw.LanguageWorldEnv("reach", engine="vectorized")):
        with pytest.raises(ImportError, match=f"^engine: .*{changed}.*engine='metaworld'"):
            make()


def test_quaternions_have_scipys_bits():
    random = Rotation.from_quat(np.random.default_rng(0).normal(size=(3000, 4))).as_matrix()
    quarters = [np.round(Rotation.from_euler("xyz", k, degrees=True).as_matrix()) for k in np.ndindex(4, 4, 4)]
    matrices = np.concatenate((random, quarters))
    one_by_one = np.stack([Rotation.from_matrix(matrix).as_quat() for matrix in matrices])
    for convert in (quaternion_of_matrix, row_kernel.quaternion_of_matrix):
        assert same_bits(one_by_one, np.array([convert(tuple(m.ravel().tolist())) for m in matrices])).all()


def test_norms_have_numpys_bits():
    vectors = np.random.default_rng(0).normal(size=(20000, 3)) * 0.1
    assert same_bits(np.array([np.linalg.norm(v) for v in vectors]), row_norm(vectors)).all()


def test_rows_of_a_model_form_a_group_unless_a_thread_would_idle():
    keys = ["a", "b", "a", "c", "a", "b"]
    assert {group.rows for group in split_into_groups(keys, 1)} == {(0, 2, 4), (1, 5), (3,)}
    assert {group.rows for group in split_into_groups(["a"] * 8, 2)} == {(0, 1), (2, 3), (4, 5), (6, 7)}
    assert len(split_into_groups([str(k % 36) for k in range(1000)], 2)) == 36


@pytest.mark.parametrize("threads", [1, 4])
def test_worker_pool_does_each_item_once_and_a_group_in_order(threads):
    pool = WorkerPool(threads)
    done: list[list[int]] = [[] for _ in range(20)]

    def do(item: int) -> None:
        done[item // 5].append(-1)
        time.sleep(1e-4)  # another thread in this group would write in between
        done[item // 5][-1] = item

    pool.work([(RowGroup(range(k, k + 5)), range(k, k + 5)) for k in range(0, 100, 5)], do)
    assert done == [[*range(k, k + 5)] for k in range(0, 100, 5)]
    pool.close()


@pytest.mark.parametrize("threads", [1, 3])
def test_error_in_a_thread_reaches_the_caller(threads):
    pool = WorkerPool(threads)

    def do(item: int) -> None:
        if item == 7:
            raise ZeroDivisionError("item 7")

    with pytest.raises(ZeroDivisionError, match="item 7"):
        pool.work([(RowGroup([k]), [k]) for k in range(20)], do)
    pool.close()
