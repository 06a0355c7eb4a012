"""TaskBalancedSampler: exact counts, no row twice in a pass, and batches that can be repeated."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyStackStorage,
    LazyTensorStorage,
    ListStorage,
    TensorDictReplayBuffer,
)

from lw_torchrl.data import TaskBalancedSampler

sizes = st.lists(st.integers(1, 9), min_size=1, max_size=5)  # rows of each task
counts = st.integers(1, 12)  # rows of a task in a batch
seeds = st.integers(0, 2**31)


def make_rows(sizes, first_task=3, shuffled=0):
    tasks = torch.cat([torch.full((size,), first_task + 2 * i) for i, size in enumerate(sizes)])
    order = torch.randperm(len(tasks), generator=torch.Generator().manual_seed(shuffled))
    return TensorDict({"task_id": tasks[order], "row": torch.arange(len(tasks))}, [len(tasks)])


def make_replay(rows, batch_size, seed=0, capacity=None, sampler=None):
    replay = TensorDictReplayBuffer(
        storage=LazyTensorStorage(capacity or len(rows)),
        sampler=sampler or TaskBalancedSampler(),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )
    if len(rows):
        replay.extend(rows)
    return replay


def drawn(replay, number):
    return [replay.sample()["row"].tolist() for _ in range(number)]


@settings(max_examples=30, deadline=None)
@given(sizes, counts, seeds)
def test_batches_hold_equal_numbers_of_every_task(sizes, count, seed):
    replay = make_replay(make_rows(sizes), count * len(sizes), seed)
    for _ in range(5):
        tasks, rows_of_task = replay.sample()["task_id"].unique(return_counts=True)
        assert tasks.tolist() == [3 + 2 * i for i in range(len(sizes))]
        assert rows_of_task.tolist() == [count] * len(sizes)


@settings(max_examples=30, deadline=None)
@given(sizes, counts, seeds)
def test_every_row_of_a_task_comes_once_before_any_comes_again(sizes, count, seed):
    rows = make_rows(sizes)
    replay = make_replay(rows, count * len(sizes), seed)
    batches = [replay.sample() for _ in range(8)]
    for i in range(len(sizes)):
        of_task = torch.cat([batch["row"][batch["task_id"] == 3 + 2 * i] for batch in batches]).tolist()
        everything = sorted(rows["row"][rows["task_id"] == 3 + 2 * i].tolist())
        for start in range(0, len(of_task) - sizes[i] + 1, sizes[i]):
            assert sorted(of_task[start : start + sizes[i]]) == everything
        rest = of_task[len(of_task) // sizes[i] * sizes[i] :]
        assert len(set(rest)) == len(rest)


@settings(max_examples=20, deadline=None)
@given(sizes, counts, seeds, st.integers(0, 5))
def test_a_restored_state_gives_the_same_batches(sizes, count, seed, before):
    rows = make_rows(sizes)
    replay = make_replay(rows, count * len(sizes), seed)
    drawn(replay, before)
    state = replay.sampler.state_dict()
    generator = torch.Generator()
    generator.set_state(replay._rng.get_state())
    expected = drawn(replay, 5)
    other = make_replay(rows, count * len(sizes), seed + 1)
    drawn(other, 1)
    other.sampler.load_state_dict(state)
    other.set_rng(generator)
    assert drawn(other, 5) == expected


@settings(max_examples=40, deadline=None)
@given(sizes, st.lists(st.integers(1, 30), min_size=1, max_size=20), seeds)
def test_other_batch_sizes_are_rounded_and_totals_stay_equal(sizes, batch_sizes, seed):
    replay = make_replay(make_rows(sizes), None, seed)
    batches = [replay.sample(size) for size in batch_sizes]
    assert [len(batch) for batch in batches] == batch_sizes
    drawn_of = torch.cat([batch["task_id"] for batch in batches]).bincount(minlength=3 + 2 * len(sizes))[3::2]
    assert drawn_of.max() - drawn_of.min() <= 2
    other = make_replay(make_rows(sizes), None, seed + 1)
    other.load_state_dict(replay.state_dict())
    for size in batch_sizes:
        assert torch.equal(other.sample(size)["row"], replay.sample(size)["row"])


@pytest.mark.parametrize("tail", [(), (1,), (10,), (2, 3)])
@pytest.mark.parametrize("kind", [LazyTensorStorage, ListStorage])
def test_rows_may_hold_their_task_in_any_shape(tail, kind):
    """Such as rows that are pieces of trajectories, (n, T)."""
    task = torch.arange(8).view(8, *[1] * len(tail)).expand(8, *tail) % 2
    rows = TensorDict({"task_id": task, "row": torch.arange(8)}, [8])
    replay = make_replay(rows, 4, sampler=TaskBalancedSampler(), capacity=12) if kind is LazyTensorStorage else None
    if replay is None:
        replay = TensorDictReplayBuffer(storage=ListStorage(12), sampler=TaskBalancedSampler(), batch_size=4)
        replay.extend(rows)
    for _ in range(4):
        batch = replay.sample()
        assert batch["task_id"].shape == (4, *tail)
        assert (batch["row"] % 2).bincount().tolist() == [2, 2]
    replay.extend(rows[:2])
    assert len(replay.sample()) == 4


@settings(max_examples=20, deadline=None)
@given(sizes, counts, seeds)
def test_ran_out_is_true_at_the_end_of_a_pass_over_the_largest_task(sizes, count, seed):
    replay = make_replay(make_rows(sizes), count * len(sizes), seed)
    largest = max(sizes)
    for batch in range(1, 9):
        replay.sample()
        ended = batch * count // largest > (batch - 1) * count // largest
        assert replay.sampler.ran_out == ended


def test_a_buffer_that_grows_is_grouped_again():
    replay = make_replay(make_rows([4, 4]), None, capacity=100)
    replay.sample(4)
    more = make_rows([6], first_task=20)
    replay.extend(more.set("row", more["row"] + 8))
    batch = replay.sample(6)
    assert batch["task_id"].bincount(minlength=21)[[3, 5, 20]].tolist() == [2, 2, 2]
    drawn_rows = {row for _ in range(10) for row in replay.sample(6)["row"].tolist()}
    assert drawn_rows == set(range(14))


def test_an_emptied_buffer_can_be_filled_again():
    replay = make_replay(make_rows([4, 4]), 4, capacity=8)
    drawn(replay, 1)
    replay.empty()
    replay.extend(make_rows([2, 6], first_task=30))
    assert replay.sample()["task_id"].bincount(minlength=33)[[30, 32]].tolist() == [2, 2]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 4)), min_size=1, max_size=12), seeds)
def test_writes_to_a_full_storage_repeat_no_row_in_a_pass(rounds, seed):
    """Rows of a task that were not drawn yet come before those that were, whatever is written in between."""
    replay = make_replay(make_rows([9, 9]), 4, seed, capacity=30)
    value, drawn_now = 18, {3: set(), 5: set()}  # values that are in the ring and were drawn in the task's pass
    for count, batches in rounds:
        for _ in range(batches):
            batch = replay.sample()
            stored = replay[:]
            for task, seen in drawn_now.items():
                there = set(stored["row"][stored["task_id"] == task].tolist())
                seen &= there
                if seen == there:
                    seen.clear()
                for row in batch["row"][batch["task_id"] == task].tolist():
                    assert row in there
                    assert row not in seen
                    seen.add(row)
                    if seen == there:
                        seen.clear()
        task = torch.tensor([(3, 5)[number % 2] for number in range(count)])
        replay.extend(TensorDict({"task_id": task, "row": torch.arange(value, value + count)}, [count]))
        value += count


def make_grid(steps, *tasks):
    """Return a collector's batch: an environment for each task, by steps."""
    task = torch.tensor(tasks)[:, None].expand(-1, steps)
    return TensorDict({"task_id": task, "row": torch.arange(task.numel()).view(task.shape)}, task.shape)


@pytest.mark.parametrize("capacity", [200, 60], ids=["not full", "full"])
def test_every_row_of_a_storage_of_two_dimensions_comes_once(capacity):
    storage = LazyTensorStorage(capacity, ndim=2)
    replay = TensorDictReplayBuffer(storage=storage, sampler=TaskBalancedSampler(), batch_size=9)
    for _ in range(2):
        replay.extend(make_grid(20, 3, 5, 5, 7)[:, : 20 if capacity == 200 else 15])
    batches = [replay.sample() for _ in range(20)]
    for batch in batches:
        assert batch["task_id"].bincount().tolist() == [0, 0, 0, 3, 0, 3, 0, 3]
        assert (storage[batch["index"].unbind(-1)]["row"] == batch["row"]).all()
    rows = len(storage) // 4
    indices = torch.cat([batch["index"][batch["task_id"] == 3] for batch in batches])[:rows]
    assert len(indices.unique(dim=0)) == rows


@pytest.mark.parametrize("storage", [ListStorage, LazyStackStorage, LazyMemmapStorage])
def test_other_storages_work_too(storage):
    replay = TensorDictReplayBuffer(storage=storage(20), sampler=TaskBalancedSampler(), batch_size=4)
    replay.extend(make_rows([7, 3]))
    assert replay.sample()["task_id"].bincount().tolist() == [0, 0, 0, 2, 0, 2]
