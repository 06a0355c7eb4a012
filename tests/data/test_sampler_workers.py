"""Samplers in several processes: each draws batches of its own, and the same ones in every run."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.utils.data import DataLoader, IterableDataset, get_worker_info
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw


def make_replay(seed=0):
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(80),
        sampler=lw.TaskBalancedSampler(),
        batch_size=8,
        generator=torch.Generator().manual_seed(seed),
    )
    replay.extend(TensorDict(task_id=torch.arange(80) % 2, row=torch.arange(80), batch_size=[80]))
    return replay


def opened_anew(replay, worker):
    return make_replay(worker)


def with_its_own_sampler(replay, worker):
    replay.set_sampler(lw.TaskBalancedSampler())
    replay.set_rng(torch.Generator().manual_seed(worker))
    return replay


class Batches(IterableDataset):
    def __init__(self, prepare):
        self.prepare, self.replay = prepare, make_replay()
        self.replay.sample()  # passes are under way

    def __iter__(self):
        replay = self.prepare(self.replay, get_worker_info().id)
        for _ in range(3):
            yield replay.sample()["row"].tolist()


def drawn(prepare, workers):
    return list(DataLoader(Batches(prepare), batch_size=None, num_workers=workers, multiprocessing_context="fork"))


@pytest.mark.parametrize("prepare", [opened_anew, with_its_own_sampler])
def test_each_worker_draws_its_own_batches_and_the_same_in_every_run(prepare):
    found = drawn(prepare, 2)
    assert len({tuple(batch) for batch in found}) == 6
    assert found == drawn(prepare, 2)


def test_several_workers_that_would_draw_the_same_rows_are_refused():
    with pytest.raises(
        RuntimeError, match="each of the DataLoader's 2 workers would draw the same rows: in each, open"
    ):
        drawn(lambda replay, worker: replay, 2)


@pytest.mark.slow
def test_one_worker_goes_on_where_the_buffer_stood():
    replay = make_replay()
    replay.sample()
    assert drawn(lambda replay, worker: replay, 1) == [replay.sample()["row"].tolist() for _ in range(3)]
