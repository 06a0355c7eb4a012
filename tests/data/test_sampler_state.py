"""States of samplers: of other rows refused, and a fresh start when rows were written."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import TaskBalancedSampler

TARGET = "coffee-push"


def make(tasks=(1, 1, 1, 2, 2, 2, 2, 2), sampler=None, batch_size=4):
    rows = TensorDict({"task_id": torch.tensor(tasks), "row": torch.arange(len(tasks))}, [len(tasks)])
    replay = TensorDictReplayBuffer(
        storage=TensorStorage(rows),
        sampler=sampler or TaskBalancedSampler(),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(0),
    )
    replay.sample()
    return replay


@pytest.mark.parametrize(
    "change",
    [{"order": None}, {"order": torch.arange(7)}, {"cursor": torch.tensor([3, 0])}, {"size": torch.tensor([8])}],
)
def test_a_state_that_does_not_fit_together_is_refused(change):
    one, other = make(), make()
    with pytest.raises(ValueError, match="state_dict must hold"):
        one.sampler.load_state_dict(one.sampler.state_dict() | change)
    assert [one.sample()["row"].tolist() for _ in range(4)] == [other.sample()["row"].tolist() for _ in range(4)]


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ((1, 1, 1, 2, 2, 2, 2), "the storage's 7 rows, got one of 8"),
        ((1, 1, 1, 1, 2, 2, 2, 2), "the storage's rows, got one whose groups differ"),
        ((1, 1, 1, 1, 1, 1, 1, 1), "the storage's rows, got one whose groups differ"),
    ],
)
def test_the_state_of_other_rows_is_refused_at_the_next_batch(tasks, message):
    state = make().sampler.state_dict()
    replay = make(tasks, batch_size=12)
    replay.sampler.load_state_dict(state)
    for _ in range(2):
        with pytest.raises(ValueError, match=f"state_dict must be of {message}"):
            replay.sample()


def test_the_state_of_a_sampler_that_drew_nothing_is_a_fresh_start():
    replay = make()
    replay.sampler.load_state_dict(TaskBalancedSampler().state_dict())
    assert sorted(replay.sample()["task_id"].tolist()) == [1, 1, 2, 2]


def test_rows_that_are_written_after_a_state_was_restored_are_grouped_again():
    sampler = make().sampler
    sampler.load_state_dict(sampler.state_dict())
    sampler.extend(torch.arange(2))
    rows = TensorDict({"task_id": torch.tensor([1, 1, 2, 2, 3, 3])}, [6])
    index, _ = sampler.sample(TensorStorage(rows), 3)
    assert sorted(rows["task_id"][index].tolist()) == [1, 2, 3]


def test_a_damaged_file_is_refused(tmp_path):
    replay = make()
    replay.sampler.dumps(tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=rf"path: '{tmp_path}' holds no sampler's state"):
        replay.sampler.loads(tmp_path)
    assert len(replay.sample()) == 4
