"""States of samplers: exact resuming, errors for other rows; and samplers in several processes."""

import pytest
import torch
from tensordict import TensorDict
from torch.utils.data import DataLoader, IterableDataset, get_worker_info
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import TaskBalancedSampler


def make(tasks=(1, 1, 1, 2, 2, 2, 2, 2), batch_size=4, seed=0):
    """Return a buffer whose passes have begun."""
    rows = TensorDict({"task_id": torch.tensor(tasks), "row": torch.arange(len(tasks))}, [len(tasks)])
    replay = TensorDictReplayBuffer(
        storage=TensorStorage(rows),
        sampler=TaskBalancedSampler(),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )
    replay.sample()
    return replay


@pytest.mark.parametrize("tasks", [(1, 1, 1, 2, 2, 2, 2), (1, 1, 1, 1, 2, 2, 2, 2), (1,) * 8])
def test_the_state_of_other_rows_is_an_error_at_the_next_batch(tasks):
    state = make().sampler.state_dict()
    replay = make(tasks, batch_size=12)
    replay.sampler.load_state_dict(state)
    for _ in range(2):
        with pytest.raises(ValueError, match="state_dict must fit the storage's"):
            replay.sample()


def test_the_state_of_an_unused_sampler_starts_anew():
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


def test_a_damaged_file_is_an_error(tmp_path):
    replay = make()
    replay.sampler.dumps(tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=rf"path: '{tmp_path}' holds no sampler's state"):
        replay.sampler.loads(tmp_path)
    assert len(replay.sample()) == 4


def open_anew(replay, worker):
    return make((0, 1) * 40, batch_size=8, seed=worker)


def set_sampler(replay, worker):
    replay.set_sampler(TaskBalancedSampler())
    replay.set_rng(torch.Generator().manual_seed(worker))
    return replay


def keep(replay, worker):
    return replay


class Batches(IterableDataset):
    def __init__(self, prepare):
        self.prepare, self.replay = prepare, make((0, 1) * 40, batch_size=8)

    def __iter__(self):
        replay = self.prepare(self.replay, get_worker_info().id)
        for _ in range(3):
            yield replay.sample()["row"].tolist()


def drawn(prepare, workers):
    return list(DataLoader(Batches(prepare), batch_size=None, num_workers=workers, multiprocessing_context="fork"))


@pytest.mark.parametrize("prepare", [open_anew, set_sampler])
def test_workers_draw_different_batches_and_repeat_them(prepare):
    batches = drawn(prepare, 2)
    assert len({tuple(batch) for batch in batches}) == 6
    assert batches == drawn(prepare, 2)


def test_workers_that_would_draw_the_same_rows_are_an_error():
    with pytest.raises(RuntimeError, match="2 workers of the DataLoader would draw the same rows"):
        drawn(keep, 2)
