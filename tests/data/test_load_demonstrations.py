"""load_demonstrations and n_step_returns: rows for TorchRL's tools, with TorchRL's own numbers."""

import functools
from itertools import pairwise

import pytest
import torch
from collecting import open_replay, tree
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import MultiStep, OfflineToOnlineReplayBuffer, RandomSampler, TensorDictReplayBuffer
from torchrl.envs import TransformedEnv
from torchrl.modules import ValueOperator
from torchrl.objectives.value import TD0Estimator
from torchrl.trainers.algorithms.offline_to_online import OfflineToOnlineReplayBufferHook

import lw_torchrl as lw
from lw_torchrl.data import ROLLOUT, n_step_returns
from lw_torchrl.data.dataset import MappedColumn


def test_rows_of_one_folder_stay_in_its_files_and_changes_stay_in_memory(both):
    before = tree(both[0])
    rows = lw.load_demonstrations(both[0])
    assert type(rows) is TensorDict
    assert isinstance(rows["observation"], MappedColumn)
    assert (rows == lw.LanguageWorldExperienceReplay(both[0])[:]).all()
    rows.zero_()
    assert tree(both[0]) == before


def double(batch):
    return batch.set("twice", 2 * batch["action"])


def test_transforms_may_be_functions_and_samplers_factories(both):
    opened = functools.partial(open_replay, both[0])
    appended = opened()
    appended.append_transform(double)
    for replay in (appended, opened(transform=double), opened(transform=double, sampler=RandomSampler)):
        batch = replay.sample()
        assert torch.equal(batch["twice"], 2 * batch["action"])
        assert "twice" in replay[:].keys()
        assert "twice" not in replay.storage[:].keys()
    shared = TensorDictReplayBuffer(storage=opened().storage, batch_size=5)
    assert shared.sample().shape == (5,)


@pytest.fixture(scope="module")
def rollout():
    plans = lw.load_plans("MT10")
    env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=20), lw.QAFTransform(plans))
    rows = env.rollout(12, lw.PlanConditionedActor(plans)).detach()
    env.close()
    return rows


@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
@pytest.mark.parametrize("n_steps", [1, 3])
def test_rows_join_with_rollouts_of_the_environment(both, rollout, n_steps):
    ahead = {"n_steps": n_steps, "gamma": 0.9} if n_steps > 1 else {}
    options = {"sampler": lw.TaskBalancedSampler(), "transform": lw.QAFTransform(lw.load_plans("MT10"))}
    offline = open_replay(both[0], "executed", keys="rollout", **options, **ahead)
    keys = offline.sample(1).keys(True, True)
    rows = n_step_returns(rollout, 3, 0.9) if ahead else rollout
    assert set(ROLLOUT) <= set(keys) <= set(rows.keys(True, True))
    replay = OfflineToOnlineReplayBuffer(offline, online_capacity=100, batch_size=8)
    replay.extend(rows.reshape(-1).select(*keys))
    batch = replay.sample()
    assert batch.shape == (8,)
    assert {key: batch[key].dtype for key in batch.keys(True, True)} == {key: rows[key].dtype for key in keys}
    hook = OfflineToOnlineReplayBufferHook(OfflineToOnlineReplayBuffer(offline, online_capacity=100), batch_size=8)
    assert hook.extend(rows).shape == (24,)
    assert hook.sample(rows).shape == (8,)


def test_rows_have_only_the_chosen_keys(both):
    rows = lw.load_demonstrations(both, keys=["action", "is_demonstration"])
    assert set(rows.keys(True, True)) == {"action", "is_demonstration"}
    with pytest.raises(ValueError, match=r"keys .* got 'next/reward'"):
        lw.load_demonstrations(both, keys=[("next", "reward")])
    with pytest.raises(ValueError, match="keys='rollout' require label"):
        lw.load_demonstrations(both, keys="rollout")


def make_rows(lengths):
    """Return trajectories of these lengths, one after another."""
    total = sum(lengths)
    observation = torch.arange(total, dtype=torch.float32)[:, None] + torch.zeros(total, 2)
    ids = torch.repeat_interleave(torch.tensor(lengths))
    done = torch.ones(total, 1, dtype=torch.bool)
    done[:-1, 0] = ids[1:] != ids[:-1]
    after = {"observation": observation + 1, "reward": (observation[:, :1] * 1.7).cos()}
    after |= {"done": done, "truncated": done.clone(), "terminated": torch.zeros_like(done)}
    columns = {"observation": observation, "action": (observation * 0.37).sin(), "collector": {"traj_ids": ids}}
    return TensorDict({**columns, "next": after}, [total])


steps = st.integers(2, 7)
gammas = st.sampled_from([0.5, 0.97, 1.0])


def torchrls(rows, n_steps, gamma):
    """Return TorchRL's n-step returns of trajectories, each (T,) rows."""
    oracle = MultiStep(gamma, n_steps)
    oracle.done_keys = ()  # otherwise done and terminated would stay those of the first step
    return torch.cat([oracle(trajectory.unsqueeze(0))[0] for trajectory in rows])


def trajectories(rows):
    ids = rows["collector", "traj_ids"]
    cuts = [0, *((ids[1:] != ids[:-1]).nonzero().flatten() + 1).tolist(), len(ids)]
    return [rows[a:b] for a, b in pairwise(cuts)]


def check(actual, expected):
    for key in (*(("next", key) for key in ("observation", "done", "terminated", "truncated")), "steps_to_next_obs"):
        assert torch.equal(actual[key], expected[key]), key
    torch.testing.assert_close(actual["next", "reward"], expected["next", "reward"], rtol=5e-7, atol=1e-6)
    for key in ("observation", "action"):
        assert torch.equal(actual[key], expected[key])


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(1, 9), min_size=1, max_size=5), steps, gammas)
def test_n_step_returns_equal_torchrls(lengths, n_steps, gamma):
    rows = make_rows(lengths)
    check(n_step_returns(rows, n_steps, gamma), torchrls(trajectories(rows), n_steps, gamma))


@settings(max_examples=20, deadline=None)
@given(st.integers(1, 4), st.integers(1, 9), steps, st.integers(0, 99))
def test_a_batch_of_a_collector_is_cut_at_its_end(envs, time, n_steps, seed):
    """(N, T) rows, with and without the ids of trajectories."""
    ends = torch.rand(envs, time, generator=torch.Generator().manual_seed(seed)) < 0.3
    rows = make_rows([time] * envs).reshape(envs, time)
    rows["next", "done"] = ends.unsqueeze(-1)
    rows["collector", "traj_ids"] = torch.arange(envs)[:, None] * time + ends.cumsum(1) - ends.long()
    ahead = n_step_returns(rows, n_steps, 0.9)
    assert ahead.shape == rows.shape
    check(ahead.reshape(-1), torchrls([trajectory for row in rows for trajectory in trajectories(row)], n_steps, 0.9))
    assert (n_step_returns(rows.exclude("collector"), n_steps, 0.9) == ahead.exclude("collector")).all()


def test_a_value_estimator_discounts_by_the_steps():
    rows = make_rows([5])
    ahead = n_step_returns(rows, 3, 0.9)
    value = ValueOperator(torch.nn.Linear(2, 1), in_keys=["observation"])
    target = TD0Estimator(gamma=0.9, value_network=value).value_estimate(ahead)
    after = value.module(ahead["next", "observation"])
    expected = ahead["next", "reward"] + 0.9 ** torch.tensor([[3.0], [3.0], [3.0], [2.0], [1.0]]) * after
    torch.testing.assert_close(target, expected.detach())
