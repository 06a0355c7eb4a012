"""load_demonstrations: rows for TorchRL's tools."""

import functools

import pytest
import torch
from collecting import open_replay, tree
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    OfflineToOnlineReplayBuffer,
    RandomSampler,
    TensorDictReplayBuffer,
    prefill_replay_buffer,
)
from torchrl.envs import TransformedEnv
from torchrl.trainers.algorithms.offline_to_online import OfflineToOnlineReplayBufferHook

import lw_torchrl as lw
from lw_torchrl.data import ROLLOUT
from lw_torchrl.data.dataset import MappedColumn


@pytest.fixture
def roots(dataset, other_dataset):
    return [dataset.root, other_dataset.root]


def test_rows_of_one_folder_stay_in_its_files_and_changes_stay_in_memory(roots):
    before = tree(roots[0])
    rows = lw.load_demonstrations(roots[0])
    assert type(rows) is TensorDict
    assert isinstance(rows["observation"], MappedColumn)
    assert (rows == lw.LanguageWorldExperienceReplay(roots[0])[:]).all()
    rows.zero_()
    assert tree(roots[0]) == before


def double(batch):
    return batch.set("twice", 2 * batch["action"])


def test_transforms_may_be_functions_and_samplers_factories(roots):
    opened = functools.partial(open_replay, roots[0])
    appended = opened()
    appended.append_transform(double)
    for replay in (appended, opened(transform=double), opened(transform=double, sampler=RandomSampler)):
        batch = replay.sample()
        assert torch.equal(batch["twice"], 2 * batch["action"])
        assert "twice" in replay[:].keys()
        assert "twice" not in replay.storage[:].keys()
    shared = TensorDictReplayBuffer(storage=opened().storage, batch_size=5)
    assert shared.sample().shape == (5,)


@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
def test_torchrls_tools_draw_batches_of_any_size(roots):
    replay = open_replay(roots[0], sampler=lw.TaskBalancedSampler())
    filled = prefill_replay_buffer(TensorDictReplayBuffer(storage=LazyTensorStorage(200)), replay, n_samples=51)
    assert len(filled) == 51


@pytest.fixture(scope="module")
def rollout():
    plans = lw.load_plans("MT10")
    env = TransformedEnv(lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=20), lw.QAFTransform(plans))
    rows = env.rollout(12, lw.PlanConditionedActor(plans)).detach()
    env.close()
    return rows


@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
@pytest.mark.parametrize("n_steps", [1, 3])
def test_rows_join_with_rollouts_of_the_environment(roots, rollout, n_steps):
    ahead = {"n_steps": n_steps, "gamma": 0.9} if n_steps > 1 else {}
    options = {"sampler": lw.TaskBalancedSampler(), "transform": lw.QAFTransform(lw.load_plans("MT10"))}
    offline = open_replay(roots[0], "executed", keys="rollout", **options, **ahead)
    keys = offline.sample(1).keys(True, True)
    rows = lw.data.n_step_returns(rollout, 3, 0.9) if ahead else rollout
    assert set(ROLLOUT) <= set(keys) <= set(rows.keys(True, True))
    replay = OfflineToOnlineReplayBuffer(offline, online_capacity=100, batch_size=8)
    replay.extend(rows.reshape(-1).select(*keys))
    batch = replay.sample()
    assert batch.shape == (8,)
    assert {key: batch[key].dtype for key in batch.keys(True, True)} == {key: rows[key].dtype for key in keys}
    hook = OfflineToOnlineReplayBufferHook(OfflineToOnlineReplayBuffer(offline, online_capacity=100), batch_size=8)
    assert hook.extend(rows).shape == (24,)
    assert hook.sample(rows).shape == (8,)


def test_rows_have_only_the_chosen_keys(roots):
    rows = lw.load_demonstrations(roots, keys=["action", "is_demonstration"])
    assert set(rows.keys(True, True)) == {"action", "is_demonstration"}
    with pytest.raises(ValueError, match=r"keys .* got 'next/reward'"):
        lw.load_demonstrations(roots, keys=[("next", "reward")])
    with pytest.raises(ValueError, match="keys='rollout' require label"):
        lw.load_demonstrations(roots, keys="rollout")
