"""Episodes of a reset: the next ones, those of ``episode=``, or those after a loaded state; never a tensordict's."""

import io
from functools import partial

import numpy as np
import pytest
import torch
from rows import ROWS, STEPS, others, same, trajectories
from speed import first_fast
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, ParallelEnv, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw

TASKS = ["push", "reach"]
pytestmark = pytest.mark.filterwarnings("ignore:No explicit `?device")


def make_env(seed: int = 5, num_envs: int = 3, **options) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(TASKS, num_envs=num_envs, seed=seed, max_steps=4, num_threads=1, **options)


def make_transformed(seed: int = 5) -> TransformedEnv:
    return TransformedEnv(make_env(seed), Compose(lw.QAFTransform(lw.load_plans("MT10")), StepCounter()))


def transformed(env) -> TransformedEnv:
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


FORK = {"mp_start_method": "fork"}
MAKERS = {
    "plain": make_env,
    "transformed": make_transformed,
    "serial": lambda seed=5: SerialEnv(2, make_transformed, create_env_kwargs={"seed": seed}),
    "outside": lambda seed=5: transformed(SerialEnv(2, make_env, create_env_kwargs={"seed": seed})),
    "parallel": lambda seed=5: transformed(ParallelEnv(2, make_transformed, create_env_kwargs={"seed": seed}, **FORK)),
    "parallel, no buffers": lambda seed=5: ParallelEnv(
        2, [partial(make_env, seed, worker=(w, 2)) for w in range(2)], use_buffers=False, **FORK
    ),
}


@pytest.mark.parametrize("name", first_fast(MAKERS, 2))
def test_loading_a_state_continues_with_the_next_episodes(name):
    env, other = MAKERS[name](), MAKERS[name](77)
    for _ in range(2):
        env.rollout(2)
    other.rollout(1)
    torch.save(env.state_dict(), file := io.BytesIO())
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    expected, loaded = env.reset(), other.reset()
    assert expected["episode"].min() >= 2, "the third episodes"
    still = torch.zeros(*env.batch_size, 4)
    moved = [each.step(td.clone().set("action", still)) for each, td in ((env, expected), (other, loaded))]
    for key in ("episode", "observation", ("next", "observation")):
        assert torch.equal(moved[0][key], moved[1][key])
    env.close()
    other.close()


def test_loading_a_state_ends_all_episodes():
    env = make_env()
    state = env.reset()
    env.load_state_dict(env.state_dict())
    with pytest.raises(RuntimeError, match=r"rows \[0, 1, 2\]"):
        env.step(state.set("action", torch.zeros(3, 4)))
    assert env.reset()["episode"].tolist() == [2, 1, 3]


def make_collector(make, policy) -> Collector:
    return Collector(make(), policy, frames_per_batch=30, total_frames=-1, auto_register_policy_transforms=False)


@pytest.mark.parametrize("name", ["transformed", "serial", "outside"])
def test_a_resumed_collector_continues_with_the_next_episodes(name):
    def episodes(collector) -> set[tuple[int, int]]:
        batch = next(iter(collector))
        return set(zip(batch["task_id"].flatten().tolist(), batch["episode"].flatten().tolist(), strict=True))

    first, second = (
        make_collector(MAKERS[name], TensorDictModule(nn.Linear(39, 4), ["observation"], ["action"])) for _ in range(2)
    )
    seen = episodes(first)
    second.load_state_dict(first.state_dict())
    second.reset()
    after = episodes(second)
    for collector in (first, second):
        collector.shutdown()
    assert len(after) >= 6
    assert not seen & after


def test_a_collector_continues_after_a_reset():
    """Its reset sets the environment's tensors to zero."""
    collector = make_collector(make_transformed, lw.PlanConditionedActor(lw.load_plans("MT10")))
    for _ in range(2):
        assert next(iter(collector))["qaf_plan"].all()
        collector.reset()
    collector.shutdown()


@pytest.mark.parametrize(("tasks", "num_envs"), [(TASKS, 4), (["push", "sweep"], 3)])
def test_a_state_of_other_rows_is_an_error(tasks, num_envs):
    env, foreign = make_env(), lw.LanguageWorldEnv(tasks, num_envs=num_envs, num_threads=1)
    env.reset()
    with pytest.raises(ValueError, match=f"state_dict .* other rows: {num_envs} rows"):
        env.load_state_dict(foreign.state_dict())
    assert (env.seed, env.reset()["episode"].tolist()) == (5, [2, 1, 3]), "the state must not change"


def test_a_transform_of_a_buffer_has_no_environments_state():
    transform = lw.QAFTransform(lw.load_plans("MT10"))
    state = transform.state_dict()
    transform.load_state_dict(state)
    env = make_transformed()
    with pytest.raises(ValueError, match="lacks episode counters"):
        env.transform[0].load_state_dict(state)


def test_a_rollout_from_a_state_starts_the_next_episodes(any_env):
    any_env.set_seed(3)
    last = any_env.rollout(STEPS)[:, -1]["next"]
    further = any_env.rollout(2, auto_reset=False, tensordict=last.exclude("reward"))
    assert further["episode"][:, 0].tolist() == [2, 2, 2, 3, 3, 3]
    assert any_env.rollout(1, tensordict=last.exclude("reward"))["episode"][:, 0].tolist() == [4, 4, 4, 5, 5, 5]


@pytest.mark.parametrize("name", ["serial", "outside", "parallel", "parallel, no buffers"])
@pytest.mark.slow
def test_batched_environments_start_next_or_requested_episodes(name):
    env = MAKERS[name]()
    env.set_seed(3)
    state = env.rollout(4)[..., -1]["next"].exclude("reward")
    before = state["episode"].clone()
    following = env.reset(state)
    assert not (following["episode"] == before).any()
    if name != "outside":
        partial = env.reset(following.clone().set("_reset", torch.tensor([[True] * 3, [False] * 3]).unsqueeze(-1)))
        assert (partial["episode"] == following["episode"]).tolist() == [[False] * 3, [True] * 3]
    requested = env.reset(list_of_kwargs=[{"episode": 5}, {"episode": torch.tensor([8, 9, 7])}])
    assert requested["episode"].tolist() == [[5, 5, 5], [8, 9, 7]]
    assert (env.reset(episode=4)["episode"] == 4).all()
    env.close()


def test_a_reset_starts_the_requested_episodes(any_env):
    any_env.set_seed(3)
    assert any_env.reset(episode=torch.tensor([2, 0, 2, 0, 2, 9]))["episode"].tolist() == [2, 0, 2, 0, 2, 9]
    assert any_env.reset()["episode"].tolist() == [2, 2, 2, 3, 3, 3], "a requested episode counts as a reset"
    state = any_env.reset()
    partial = any_env.reset(state.clone().set("_reset", ~others(1)), episode=9)
    assert partial["episode"].tolist() == [4, 9, 4, 5, 5, 5]
    assert torch.equal(partial["observation"][1], any_env.reset(episode=np.int64(9))["observation"][1])
    assert same(partial, state, others(1))


def test_a_requested_episode_has_the_same_trajectory(any_env):
    any_env.set_seed(3)
    expected = trajectories(any_env, STEPS) | trajectories(any_env, STEPS)
    any_env.set_seed(3)
    actual = trajectories(any_env, STEPS, any_env.reset(episode=torch.tensor([3, 1, 0, 2, 2, 1])))
    assert len(actual) == ROWS
    assert all(same(expected[key], actual[key]) for key in actual)


@pytest.mark.parametrize(
    "episode",
    [
        *(
            torch.tensor([0, 1, 2, -3, 0, 0]),
            torch.zeros(ROWS, 2, dtype=torch.int64),
            torch.zeros(5, dtype=torch.int64),
        ),
        *(torch.zeros(ROWS), torch.ones(ROWS, dtype=torch.bool), [0] * ROWS, -1, 2**63, 1.0, True),
    ],
    ids=str,
)
def test_a_wrong_episode_is_an_error(any_env, episode):
    any_env.set_seed(0)
    any_env.reset()
    with pytest.raises((TypeError, ValueError), match="episode"):
        any_env.reset(episode=episode)
    assert any_env.reset()["episode"].tolist() == [2, 2, 2, 3, 3, 3], "the error must not count as a reset"


@pytest.mark.parametrize("mask", [torch.tensor([1, 0]), torch.tensor([1.0, 0.0]), torch.ones(2, 2, dtype=torch.bool)])
def test_a_wrong_mask_is_an_error(mask):
    env = make_env(num_envs=2)
    state = env.reset()
    with pytest.raises(ValueError, match="_reset"):
        env.reset(TensorDict({"_reset": mask}, [2]))
    action = torch.zeros(2, 4)
    with pytest.raises(ValueError, match="_step"):
        env.step(state.clone().set("action", action).set("_step", mask))
    for _ in range(4):
        state = env.step(state.set("action", action))["next"]
    assert state["truncated"].all(), "the wrong step must not count"
    assert env.reset()["episode"].tolist() == [1, 1]


@pytest.mark.parametrize(("seed", "following"), [(-1, None), (2**70, None), (0, 795726461)])
def test_the_seed_is_any_integer(seed, following):
    """``set_seed`` returns the seed that TorchRL's environments return."""
    env, other = make_env(num_envs=2), make_env(seed, num_envs=2)
    assert env.set_seed(seed) in (range(2**32) if following is None else [following])
    assert (env.seed, env.set_seed(seed, static_seed=True)) == (seed, seed)
    assert torch.equal(env.reset()["observation"], other.reset()["observation"])
