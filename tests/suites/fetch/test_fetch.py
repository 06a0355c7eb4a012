"""The Fetch suite: its engine against gymnasium-robotics, bit for bit; its tasks, skills and plans."""

import sys

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("gymnasium_robotics")
import gymnasium
import gymnasium_robotics

import lw_torchrl as lw
from lw_torchrl.language.canonical import explain_canonical
from lw_torchrl.language.skills import skills_for
from lw_torchrl.suites.fetch import TASKS, FetchEngine, load_plans, load_skills
from lw_torchrl.suites.fetch import engine as fetch_engine
from lw_torchrl.transforms.qaf import plan_program

gymnasium.register_envs(gymnasium_robotics)
IDS = {"fetch/pick-and-place": "PickAndPlace", "fetch/push": "Push", "fetch/reach": "Reach", "fetch/slide": "Slide"}
ORIGINS = {"fetch/slide": (0.395, 0.75, 0.3955)}  # in Fetch's axes; the others have (0.745, 0.75, 0.40675)


def random_actions(seed: int, steps: int) -> np.ndarray:
    """Draw actions (steps, 4) float32 in [-1, 1]."""
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 4)).astype(np.float32)


def ours(task: str, positions: np.ndarray) -> np.ndarray:
    x, y, z = (positions - np.array(ORIGINS.get(task, (0.745, 0.75, 0.40675)))).T
    return np.array([-y, x, z])


def observed(task: str, env: gymnasium.Env, told: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the 11 present numbers and the 3 of the goal from a state of gymnasium-robotics."""
    numbers, lift = told["observation"], np.array([0.0, 0.0, 0.03])
    thing = task != "fetch/reach"
    fingers = numbers[9:11] if thing else numbers[3:5]
    now = np.zeros(11)
    now[:3] = ours(task, numbers[:3]) + lift
    now[3] = np.clip((fingers[0] + fingers[1]) / 0.1, 0.0, 1.0)
    if thing:
        w, x, y, z = env.unwrapped.data.body("object0").xquat
        now[4:7], now[7:] = ours(task, told["achieved_goal"]), (w, -y, x, z)
    goal = ours(task, told["desired_goal"])
    return now, goal if thing else goal + lift


def gymnasium_episode(task: str, seed: int, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Run our actions (steps, 4) in a new environment of gymnasium-robotics without its time limit."""
    env = gymnasium.make(f"Fetch{IDS[task]}Dense-v4", max_episode_steps=1_000)
    now, goal = observed(task, env, env.reset(seed=seed)[0])
    episode: dict[str, list] = {"observation": [[*now, *now, *goal]], "reward": [], "success": [], "state": []}
    for right, away, up, effort in actions:
        state, reward, _, _, info = env.step(np.array([away, -right, up, -effort], dtype=actions.dtype))
        before = now
        now, goal = observed(task, env, state)
        values = [*now, *before, *goal], reward, bool(info["is_success"]), physics(env.unwrapped.data)
        for name, value in zip(episode, values, strict=True):
            episode[name].append(value)
    env.close()
    return {name: np.array(numbers) for name, numbers in episode.items()}


def physics(data) -> np.ndarray:
    """Return the positions and velocities of all joints."""
    return np.concatenate((data.qpos, data.qvel))


def engine_episode(engine: FetchEngine, row: int, seed: int, actions: np.ndarray) -> dict[str, np.ndarray]:
    """Run actions in one row while the others rest."""
    first = engine.reset([row], [seed])[0]
    episode: dict[str, list] = {"observation": [first], "reward": [], "success": [], "state": []}
    active = np.arange(len(engine._rows)) == row
    for action in actions:
        result = engine.step(active[:, None] * action, active)
        for name in ("observation", "reward", "success"):
            episode[name].append(getattr(result, name)[row])
        episode["state"].append(physics(engine._rows[row].data))
    return {name: np.array(numbers) for name, numbers in episode.items()}


def scripted(task: str, seeds: range, steps: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Run the plan with scripted skills; return actions (steps, rows, 4), successes and numbers of true steps."""
    plans = lw.Plans([load_plans()[task]])
    actor, program = lw.ScriptedSkillActor(plans, skills=load_skills()), plan_program(plans)
    rows = len(seeds)
    engine = FetchEngine([task] * rows)
    numbers, task_id = engine.reset(range(rows), seeds), torch.full((rows,), lw.task_id(task))
    actions, successes, true = [], [], []
    for _ in range(steps):
        observation = torch.from_numpy(numbers).float()
        qaf = program(observation, task_id)
        state = actor(TensorDict({"observation": observation, "task_id": task_id, "qaf": qaf}, [rows]))
        result = engine.step(state["action"].numpy(), np.ones(rows, bool))
        assert not result.fault.any()
        numbers = result.observation
        actions.append(state["action"].numpy())
        successes.append(result.success)
        true.append(qaf.sum(-1).numpy())
    engine.close()
    return np.array(actions), np.array(successes), np.array(true)


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


def test_error_names_the_missing_extra(monkeypatch):
    monkeypatch.setattr(fetch_engine, "_builder", fetch_engine._builder.__wrapped__)
    monkeypatch.setitem(sys.modules, "gymnasium_robotics.envs.fetch.push", None)
    with pytest.raises(ImportError, match=r"pip install 'lw_torchrl\[fetch\]'"):
        FetchEngine(["fetch/push"])


def test_every_step_has_a_scripted_skill_and_is_understood():
    plans, skills = load_plans(), load_skills()
    assert list(plans) == list(TASKS) == sorted(IDS)
    for plan in plans.values():
        assert {step.skill for step in plan.steps} <= set(skills_for(plan.definition, skills))
        canonical = explain_canonical(plan)
        assert (canonical.left_out, canonical.source) == ((), "plan")


def test_plans_and_tasks_can_be_saved(tmp_path):
    plans = load_plans()
    lw.save_plans(plans, tmp_path)
    assert lw.load_plans(tmp_path, tasks={**lw.TASKS, **TASKS}).fingerprint == plans.fingerprint
    assert lw.Plans.from_json(plans.to_json()).fingerprint == plans.fingerprint
    assert all(lw.Task.from_json(name, task.to_json()) == task for name, task in TASKS.items())
    assert len({lw.task_id(name) for name in TASKS}) == len(TASKS)


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_plans_survive_every_format(format):
    for name, plan in load_plans().items():
        assert lw.decode_plan(lw.encode_plan(plan, format), TASKS[name], format, skills=load_skills()).plan == plan


def test_plan_succeeds():
    _, success, _ = scripted("fetch/pick-and-place", range(4), 30)
    assert success.any(0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "least"),
    [("fetch/reach", 0.98), ("fetch/push", 0.95), ("fetch/pick-and-place", 0.95), ("fetch/slide", 0.35)],
)
def test_plans_succeed_within_fetchs_fifty_steps(task, least):
    _, success, true = scripted(task, range(50), 50)
    assert success.any(0).mean() >= least
    assert (true == 1).all(), "exactly one condition holds at each moment"
