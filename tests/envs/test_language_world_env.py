"""LanguageWorldEnv: its specs and seeds, compared with Meta-World's own environments."""

import numpy as np
import pytest
import torch
from rows import ENGINES, FEW, STEPS, actions_of, advance, same, trajectories
from speed import first_fast
from tensordict import TensorDict
from torchrl.envs import TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs import episode_seed


@pytest.mark.parametrize("contiguous", first_fast([True, False]))
def test_specs_of_mt50(mt50, plans, contiguous):
    assert len({len(plan.steps) for plan in plans.values()}) > 3, "plans of different lengths"
    check_env_specs(mt50, seed=1, return_contiguous=contiguous)
    transformed = TransformedEnv(mt50, lw.QAFTransform(plans))
    check_env_specs(transformed, seed=1, return_contiguous=contiguous)
    assert transformed.batch_size == (50,)
    assert transformed.reset()["task_id"].tolist() == list(range(50))


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_specs_when_an_episode_ends_within_the_check(reward, plans):
    env = lw.LanguageWorldEnv(["reach", "push"], num_envs=3, max_steps=2, reward=reward)
    check_env_specs(env, seed=0, break_when_any_done="both")
    check_env_specs(TransformedEnv(env, lw.QAFTransform(plans)), break_when_any_done="both")
    env.close()


def test_keys_shapes_and_types(env):
    env.set_seed(0)
    state = env.rand_step(env.reset())
    flags = {key: ((6, 1), torch.bool) for key in ("success", "fault", "done", "terminated", "truncated")}
    ids = {key: ((6,), torch.int64) for key in ("task_id", "episode")}
    actions = {key: ((6, 4), torch.float32) for key in ("action", "executed_action")}
    expected = flags | ids | actions | {"observation": ((6, 39), torch.float32), "reward": ((6, 1), torch.float32)}
    for part, absent in ((state.exclude("next"), "reward"), (state["next"], "action")):
        shapes = {key: (tuple(value.shape), value.dtype) for key, value in part.items()}
        assert shapes == {key: value for key, value in expected.items() if key != absent}
    assert env.row_tasks == (*FEW, *FEW)
    assert state["task_id"].tolist() == [lw.task_id(task) for task in env.row_tasks]
    assert (env.action_spec.space.low.unique(), env.action_spec.space.high.unique()) == (-1.0, 1.0)


@pytest.mark.parametrize(
    ("tasks", "num_envs"), [(["reach"], 4), (["reach", "push"], 2), (["push", "sweep", "reach", "assembly"], 9)]
)
def test_results_depend_neither_on_other_rows_nor_on_other_tasks(env, tasks, num_envs):
    env.set_seed(5)
    expected = trajectories(env, STEPS) | trajectories(env, STEPS)
    other = lw.LanguageWorldEnv(tasks, num_envs=num_envs, seed=5, reward="dense")
    actual = trajectories(other, STEPS) | trajectories(other, STEPS)
    other.close()
    shared = expected.keys() & actual.keys()
    assert len(shared) >= 4
    assert all(same(expected[key], actual[key]) for key in shared)


def test_episodes_are_numbered_by_row_and_reset():
    """The m-th reset of the r-th of a task's R rows is episode m·R + r."""
    env = lw.LanguageWorldEnv(["reach", "push", "door-open"], num_envs=7, seed=0)
    assert env.row_tasks == ("door-open", "push", "reach", "door-open", "push", "reach", "door-open")
    rank, rows = [0, 0, 0, 1, 1, 1, 2], [3, 2, 2, 3, 2, 2, 3]
    resets = [0] * 7
    state = env.reset()
    rng = np.random.default_rng(0)
    for _ in range(5):
        assert state["episode"].tolist() == [m * n + r for m, n, r in zip(resets, rows, rank, strict=True)]
        mask = torch.from_numpy(rng.random(7) < 0.5)
        resets = [m + int(reset) for m, reset in zip(resets, mask, strict=True)]
        state = env.reset(state.clone().set("_reset", mask))
    assert max(resets) > min(resets)
    env.set_seed(0)
    assert env.reset()["episode"].tolist() == rank, "set_seed must begin at episode 0"
    env.close()


@pytest.mark.slow
def test_every_task_starts_and_moves_as_in_metaworld(mt50, metaworld_env):
    """After other episodes in its row, each task's episode equals that of a fresh Meta-World environment."""
    mt50.set_seed(3)
    mt50.rollout(7)
    mt50.reset(TensorDict({"_reset": torch.arange(50) % 3 == 0}, [50]))
    mt50.rollout(4)
    states = [mt50.reset(episode=17)]
    actions = torch.stack([actions_of(number, 17, 8) for number in range(50)], 1)
    for action in actions:
        states.append(advance(mt50, states[-1], action))
    mt50.set_seed(3)
    first = mt50.reset()["observation"].numpy()
    observations = torch.stack([state["observation"] for state in states], 1).numpy()
    rewards = torch.stack([state["reward"] for state in states[1:]], 1).numpy()
    wrong = []
    for number, task in enumerate(lw.MT50):
        own = metaworld_env(task)
        own.seed(episode_seed(task, 3, 17))
        expected = [own.reset()[0], *(own.step(action)[:2] for action in actions[:, number].numpy())]
        steps = [expected[0], *(observation for observation, _ in expected[1:])]
        own.seed(episode_seed(task, 3, 0))
        pairs = {
            "trajectory": (observations[number], np.array(steps, np.float32)),
            "reward": (rewards[number].flatten(), np.array([reward for _, reward in expected[1:]], np.float32)),
            "episode 0": (first[number], own.reset()[0].astype(np.float32)),
        }
        wrong += [(task, name) for name, (ours, theirs) in pairs.items() if not np.array_equal(ours, theirs)]
        own.close()
    assert not wrong
    assert (observations[:, 0] != observations[:, -1]).any(-1).all(), "every task must move"


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("scale", first_fast([1.0, 3.0]))
def test_eighty_steps_and_dense_rewards_equal_metaworlds(metaworld_env, scale, engine):
    """Also with actions out of range, which Meta-World clips."""
    tasks = ["button-press-topdown", "coffee-pull", "drawer-open", "handle-press", "pick-place", "stick-push"]
    env = lw.LanguageWorldEnv(tasks, seed=2, reward="dense", engine=engine)
    expert = lw.ExpertActor(tasks)
    state = env.reset()
    for own, task in zip(owns := [metaworld_env(task) for task in tasks], tasks, strict=True):
        own.seed(episode_seed(task, 2, 0))
        own.reset()
    successes = 0
    generator = torch.Generator().manual_seed(0)
    for _ in range(80):
        noise = torch.randn(6, 4, generator=generator) * 0.2 * scale
        # Some of Meta-World's rewards use the gripper's effort before it is clipped, so it stays in range.
        action = expert(state.select("observation", "task_id"))["action"] * scale + noise
        action[:, 3].clamp_(-1, 1)
        state = advance(env, state, action)
        for row, own in enumerate(owns):
            observation, reward, _, _, info = own.step(action[row].numpy())
            assert np.array_equal(state["observation"][row].numpy(), observation.astype(np.float32)), tasks[row]
            assert state["success"][row].item() == bool(info["success"])
            if scale == 1.0 and (action[row].abs() <= 1).all():
                assert state["reward"][row].item() == np.float32(reward)
            successes += bool(info["success"])
    assert successes > 10, "the test needs successes"
    env.close()


@pytest.mark.parametrize("engine", ENGINES)
def test_sparse_reward_is_the_success(engine):
    tasks = ["button-press-topdown", "handle-press", "reach"]
    env = lw.LanguageWorldEnv(tasks, seed=0, engine=engine)
    rollout = env.rollout(90, lw.ExpertActor(tasks))
    success, reward = rollout["next", "success"], rollout["next", "reward"]
    assert torch.equal(reward, success.float())
    assert success.any(1).all()
    assert not success.all()
    assert not rollout["next", "terminated"].any(), "success must not end an episode"
    assert not rollout["next", "done"].any()
    env.close()
