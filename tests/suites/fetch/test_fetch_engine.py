"""FetchEngine against gymnasium-robotics, bit for bit."""

import sys

import numpy as np
import pytest

pytest.importorskip("gymnasium_robotics")
from fetch_runs import IDS, engine_episode, gymnasium_episode, random_actions, scripted

from lw_torchrl.suites.fetch import FetchEngine
from lw_torchrl.suites.fetch import engine as fetch_engine

STEPS = 50


def assert_same(task: str, seed: int, actions: np.ndarray) -> None:
    engine = FetchEngine([task, task], reward="dense", num_threads=1)
    engine_episode(engine, 1, seed + 1, random_actions(seed, 7))  # an earlier episode must not matter
    found, expected = engine_episode(engine, 1, seed, actions), gymnasium_episode(task, seed, actions)
    engine.close()
    for name, numbers in expected.items():
        np.testing.assert_array_equal(found[name], numbers, err_msg=name)


@pytest.mark.parametrize("task", IDS)
def test_episode_has_gymnasiums_bits(task):
    assert_same(task, 3, random_actions(3, 15))


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, 1_000, 2**31])
@pytest.mark.parametrize("task", IDS)
def test_random_and_scripted_episodes_have_gymnasiums_bits(task, seed):
    assert_same(task, seed, random_actions(seed, STEPS))
    assert_same(task, seed, scripted(task, range(seed, seed + 1), STEPS)[0][:, 0])
    assert_same(task, seed, random_actions(seed, 10).astype(np.float64) * 1.5)  # clipped in double precision


def all_rows(tasks: list[str], threads: int) -> list[np.ndarray]:
    """Run eight steps of all rows; a row's seed and actions depend on its task."""
    engine = FetchEngine(tasks, num_threads=threads)
    names = sorted(IDS)
    seeds = [names.index(task) for task in tasks]
    found = [engine.reset(range(len(tasks)), seeds)]
    actions = [random_actions(seed, 8) for seed in seeds]
    for step in range(8):
        result = engine.step(np.stack([one[step] for one in actions]), np.ones(len(tasks), bool))
        found += [result.observation, result.reward]
    engine.close()
    return found


def test_results_depend_neither_on_threads_nor_on_the_order_of_rows():
    tasks = sorted(IDS)
    expected = all_rows(tasks, 1)
    for order, threads in (([0, 1, 2, 3], 3), ([2, 0, 3, 1], 2)):
        found = all_rows([tasks[row] for row in order], threads)
        assert all(np.array_equal(a, b[order]) for a, b in zip(found, expected, strict=True))


def test_inactive_rows_repeat_their_observation():
    engine = FetchEngine(["fetch/push", "fetch/reach"], num_threads=1)
    first = engine.reset([0, 1], [5, 6])
    result = engine.step(np.ones((2, 4), np.float32), np.array([True, False]))
    assert (result.observation[0] != first[0]).any()
    assert np.array_equal(result.observation[1], first[1])
    assert np.array_equal(result.observation[0, 11:22], first[0, :11])
    assert np.array_equal(engine.reset([0], [5]), first[:1])
    engine.close()


def test_fault_stays_in_its_row():
    engine = FetchEngine(["fetch/push"] * 3, num_threads=2)
    alone = FetchEngine(["fetch/push"], num_threads=1)
    first, active = engine.reset(range(3), range(3)), np.ones(3, bool)
    alone.reset([0], [0])
    engine._rows[2].data.qvel[:] = 1e12
    action = np.zeros((3, 4), np.float32)
    action[1] = np.nan
    result = engine.step(action, active)
    assert result.fault.tolist() == [False, True, True]
    assert np.array_equal(result.observation[1:], first[1:])
    assert np.array_equal(result.observation[:1], alone.step(action[:1], active[:1]).observation)
    assert engine.step(np.zeros((3, 4), np.float32), active).fault.tolist() == [False, True, True]
    assert np.array_equal(engine.reset([1, 2], [1, 2]), first[1:])
    assert not engine.step(np.zeros((3, 4), np.float32), active).fault.any()
    engine.close()
    alone.close()


def test_recording_shows_the_goal_and_changes_nothing():
    engine, other = (FetchEngine(["fetch/push"], num_threads=1) for _ in range(2))
    engine.reset([0], [0]), other.reset([0], [0])
    for action in random_actions(0, 5):
        poses, model = engine.poses(0), engine.row_model(0)
        assert poses.position.shape == (model.model.nbody, 3)
        assert model.path.endswith("push.xml")
        site = engine._rows[0].data.site("target0").xpos
        assert np.array_equal(site, engine._rows[0].goal)
        found, expected = (one.step(action[None], np.ones(1, bool)) for one in (engine, other))
        assert np.array_equal(found.observation, expected.observation)
    engine.close(), other.close()


def test_error_names_the_missing_extra(monkeypatch):
    builder = fetch_engine._builder
    monkeypatch.setattr(fetch_engine, "_builder", builder.__wrapped__)
    monkeypatch.setitem(sys.modules, "gymnasium_robotics.envs.fetch.push", None)
    with pytest.raises(ImportError, match=r"pip install 'lw_torchrl\[fetch\]'"):
        FetchEngine(["fetch/push"])
