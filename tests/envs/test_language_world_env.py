"""LanguageWorldEnv: its specs, seeds and options, compared with Meta-World's own environments."""

from functools import partial

import numpy as np
import pytest
import torch
from rows import ENGINES, FEW, STEPS, actions_of, advance, same, trajectories
from speed import first_fast
from tensordict import TensorDict
from torchrl.envs import SerialEnv, TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs import episode_seed


@pytest.mark.parametrize("contiguous", first_fast([True, False]))
def test_specs_of_mt50(mt50, plans, contiguous):
    assert len({len(plan.steps) for plan in plans.values()}) > 3, "plans of different lengths"
    check_env_specs(mt50, seed=1, return_contiguous=contiguous)
    transformed = TransformedEnv(mt50, lw.QAFTransform(plans))
    check_env_specs(transformed, seed=1, return_contiguous=contiguous)
    assert (transformed.batch_size, transformed.reset()["task_id"].tolist()) == ((50,), list(range(50)))


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_specs_when_an_episode_ends_within_the_check(reward, plans):
    env = lw.LanguageWorldEnv(["reach", "push"], num_envs=3, max_steps=2, reward=reward)
    check_env_specs(env, seed=0, break_when_any_done="both")
    check_env_specs(TransformedEnv(env, lw.QAFTransform(plans)), break_when_any_done="both")


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
    assert (env.row_tasks, state["task_id"].tolist()) == ((*FEW, *FEW), [lw.task_id(task) for task in env.row_tasks])
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


@pytest.mark.parametrize("engine", ENGINES)
def test_sparse_reward_is_the_success(engine):
    tasks = ["button-press-topdown", "handle-press", "reach"]
    rollout = lw.LanguageWorldEnv(tasks, seed=0, engine=engine).rollout(90, lw.ExpertActor(tasks))
    success, reward = rollout["next", "success"], rollout["next", "reward"]
    assert torch.equal(reward, success.float())
    assert success.any(1).all()
    assert not success.all()
    assert not rollout["next", "terminated"].any(), "success must not end an episode"
    assert not rollout["next", "done"].any()


PLANS = lw.load_plans("MT10")


def rollout(env, steps):
    return env.rollout(steps, lw.ExpertActor(env.tasks), break_when_any_done=False, auto_cast_to_device=False)


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_frame_skip_repeats_an_action_until_the_end_of_the_episode(reward):
    options = dict(tasks=["push", "reach"], seed=1, max_steps=18, reward=reward)
    env, plain = lw.LanguageWorldEnv(frame_skip=4, **options), lw.LanguageWorldEnv(**options)
    state, single = env.reset(), plain.reset()
    generator = torch.Generator().manual_seed(0)
    for length in (4, 4, 4, 4, 2):
        action = torch.rand(2, 4, generator=generator) * 2 - 1
        state = env.step(state.set("action", action))["next"]
        total, success = torch.zeros(2, 1), torch.zeros(2, 1, dtype=torch.bool)
        for _ in range(length):
            single = plain.step(single.set("action", action))["next"]
            total += single["reward"]
            success |= single["success"]
        torch.testing.assert_close(state["reward"], total)
        assert torch.equal(state["success"], success)
        assert all(torch.equal(state[key], single[key]) for key in ("observation", "done"))
    assert state["truncated"].all()


def test_terminate_on_success_ends_an_episode():
    ending = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4, terminate_on_success=True), 200)["next"]
    plain = rollout(lw.LanguageWorldEnv(["push", "reach"], num_envs=4), 200)["next"]
    assert torch.equal(ending["terminated"], ending["success"])
    assert torch.equal(ending["done"], ending["terminated"] | ending["truncated"])
    assert not (ending["terminated"] & ending["truncated"]).any()
    for row in range(4):
        first = int(plain["success"][row].flatten().int().argmax())
        assert int(ending["terminated"][row].flatten().int().argmax()) == first
        assert torch.equal(ending["observation"][row, : first + 1], plain["observation"][row, : first + 1])
    assert ending["episode"].max() > plain["episode"].max(), "the next episode begins"


@pytest.mark.parametrize("options", [{}, {"terminate_on_success": True}, {"frame_skip": 3}], ids=str)
def test_a_single_environment_has_no_dimension_of_rows(options):
    env = TransformedEnv(lw.LanguageWorldEnv("reach", batch_size=(), seed=2, **options), lw.QAFTransform(PLANS))
    check_env_specs(env)
    env.set_seed(2)
    data = env.rollout(5, lw.PlanConditionedActor(PLANS))
    assert data.batch_size == (5,)
    shapes = {"observation": (5, 39), "task_id": (5,), "action": (5, 4), "qaf": (5, PLANS.num_steps), "done": (5, 1)}
    assert {key: tuple(data[key].shape) for key in shapes} == shapes
    other = lw.LanguageWorldEnv("reach", num_envs=1, seed=2, **options)
    assert torch.equal(other.reset()["observation"][0], data["observation"][0])
    assert env.reset(episode=3)["episode"] == torch.tensor(3)
    make = partial(lw.LanguageWorldEnv, "reach", batch_size=(), **options)
    several = SerialEnv(2, [partial(make, worker=(w, 2)) for w in range(2)])
    assert several.rollout(3)["episode"].tolist() == [[0] * 3, [1] * 3]
    for each in (env, other, several):
        each.close()


def test_ids_of_a_spec_keep_their_rows_in_every_shape():
    """TorchRL calls policies on the zeros of a spec to find out what they write."""
    env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], num_envs=3), lw.QAFTransform(PLANS))
    spec = env.observation_spec["task_id"]
    ids = spec.zero()
    for changed, expected in (
        (spec.clone(), ids),
        (spec.to("cpu"), ids),
        (spec.expand(2, 3), ids.expand(2, 3)),
        (spec.unsqueeze(0), ids.unsqueeze(0)),
        (spec.unsqueeze(0).squeeze(0), ids),
        (spec[1:], ids[1:]),
        (spec.reshape(3, 1), ids.reshape(3, 1)),
        (spec.unflatten(0, (3, 1)), ids.reshape(3, 1)),
    ):
        assert torch.equal(changed.zero(), expected)
    assert torch.equal(spec.zero((2,)), ids.expand(2, 3))
