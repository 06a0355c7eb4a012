"""Episodes of a reset: the next ones, or those of ``episode=``, never those in a tensordict."""

import numpy as np
import pytest
import torch
from rows import ROWS, STEPS, others, same, trajectories
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, SerialEnv, StepCounter, TransformedEnv

import lw_torchrl as lw


def make_env() -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv(["push", "reach"], num_envs=2, seed=3, max_steps=3, num_threads=1)


def make_transformed() -> TransformedEnv:
    return TransformedEnv(make_env(), lw.QAFTransform(lw.load_plans("MT10")))


BATCHED = {
    "serial": lambda: SerialEnv(2, make_transformed),
    "serial, plain": lambda: SerialEnv(2, make_env),
    "parallel": lambda: ParallelEnv(2, make_transformed, mp_start_method="fork"),
    "parallel, no buffers": lambda: ParallelEnv(2, make_env, mp_start_method="fork", use_buffers=False),
    "transformed outside": lambda: TransformedEnv(SerialEnv(2, make_env), StepCounter()),
}


def test_a_rollout_from_a_state_starts_the_next_episodes(any_env):
    any_env.set_seed(3)
    last = any_env.rollout(STEPS)[:, -1]["next"]
    further = any_env.rollout(2, auto_reset=False, tensordict=last.exclude("reward"))
    assert further["episode"][:, 0].tolist() == [2, 2, 2, 3, 3, 3]
    assert any_env.rollout(1, tensordict=last.exclude("reward"))["episode"][:, 0].tolist() == [4, 4, 4, 5, 5, 5]


@pytest.mark.filterwarnings("ignore:No explicit `?device")
@pytest.mark.parametrize("name", BATCHED)
@pytest.mark.slow
def test_batched_environments_start_next_or_requested_episodes(name):
    env = BATCHED[name]()
    env.set_seed(3)
    state = env.rollout(3)[..., -1]["next"].exclude("reward")
    before = state["episode"].clone()
    following = env.reset(state)
    assert not (following["episode"] == before).any()
    if name != "transformed outside":
        mask = torch.tensor([[True, True], [False, False]]).unsqueeze(-1)
        partial = env.reset(following.clone().set("_reset", mask))
        assert (partial["episode"] == following["episode"]).tolist() == [[False, False], [True, True]]
    requested = env.reset(list_of_kwargs=[{"episode": 5}, {"episode": torch.tensor([8, 9])}])
    assert requested["episode"].tolist() == [[5, 5], [8, 9]]
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
    env = make_env()
    state = env.reset()
    with pytest.raises(ValueError, match="_reset"):
        env.reset(TensorDict({"_reset": mask}, [2]))
    action = torch.zeros(2, 4)
    with pytest.raises(ValueError, match="_step"):
        env.step(state.clone().set("action", action).set("_step", mask))
    for _ in range(3):
        state = env.step(state.set("action", action))["next"]
    assert state["truncated"].all(), "the wrong step must not count"
    assert env.reset()["episode"].tolist() == [1, 1]
    env.close()


@pytest.mark.parametrize(("seed", "following"), [(-1, None), (2**70, None), (0, 795726461)])
def test_the_seed_is_any_integer(seed, following):
    """``set_seed`` returns the seed that TorchRL's environments return."""
    env, other = make_env(), lw.LanguageWorldEnv(["push", "reach"], num_envs=2, seed=seed, num_threads=1)
    assert env.set_seed(seed) in (range(2**32) if following is None else [following])
    assert (env.seed, env.set_seed(seed, static_seed=True)) == (seed, seed)
    assert torch.equal(env.reset()["observation"], other.reset()["observation"])
    env.close()
    other.close()
