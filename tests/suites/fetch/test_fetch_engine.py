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


def test_results_depend_neither_on_threads_nor_on_the_order_of_rows():
    """Rows rest at random: they repeat their observation."""

    def play(order: list[int], threads: int) -> list[np.ndarray]:
        engine, rng = FetchEngine([sorted(IDS)[row] for row in order], num_threads=threads), np.random.default_rng(0)
        arrays = [engine.reset(range(4), order)]
        for _ in range(8):
            action, active = rng.uniform(-1, 1, (4, 4)).astype(np.float32)[order], (rng.random(4) < 0.7)[order]
            result = engine.step(action, active)
            assert np.array_equal(result.observation[~active], arrays[-1][~active])
            arrays.append(result.observation)
        engine.close()
        return arrays

    expected = play([0, 1, 2, 3], 1)
    for order, threads in (([0, 1, 2, 3], 3), ([2, 0, 3, 1], 2)):
        assert all(np.array_equal(a, b[order]) for a, b in zip(play(order, threads), expected, strict=True))


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
        (path, model), data = engine._seen(0)
        assert engine.poses(0).position.shape == (model.nbody, 3)
        assert path.endswith("push.xml")
        assert np.array_equal(data.site("target0").xpos, engine._rows[0].goal)
        result, expected = (each.step(action[None], np.ones(1, bool)) for each in (engine, other))
        assert np.array_equal(result.observation, expected.observation)
    engine.close(), other.close()


def test_error_names_the_missing_extra(monkeypatch):
    builder = fetch_engine._builder
    monkeypatch.setattr(fetch_engine, "_builder", builder.__wrapped__)
    monkeypatch.setitem(sys.modules, "gymnasium_robotics.envs.fetch.push", None)
    with pytest.raises(ImportError, match=r"pip install 'lw_torchrl\[fetch\]'"):
        FetchEngine(["fetch/push"])
