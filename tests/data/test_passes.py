"""Groups that are kept up as rows come: those a fresh look finds, passes unbroken, the same after a restore."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import CoLearningSampler, TaskBalancedSampler
from lw_torchrl.data.passes import Passes, choose, spans
from lw_torchrl.data.samplers import GroupSampler
from lw_torchrl.language.tasks import task_id

TARGET = "coffee-push"
TASKS = torch.tensor([task_id(TARGET), 0, 1, 2])
writes = st.lists(st.tuples(st.integers(1, 12), st.integers(0, 3)), min_size=1, max_size=12)  # rows, batches after


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 9), st.integers(0, 9)), min_size=1, max_size=4), st.integers(0, 999))
def test_places_are_chosen_each_once(groups, seed):
    size, count = (torch.tensor(column) for column in zip(*((max(pair), min(pair)) for pair in groups), strict=True))
    first = size.cumsum(0) - size
    found = choose(first, size, count, torch.Generator().manual_seed(seed))
    assert len(found.unique()) == len(found)
    whole = [set(range(int(a), int(a + n))) for a, n in zip(first, size, strict=True)]
    assert [len(one & set(found.tolist())) for one in whole] == count.tolist()


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_place_is_as_likely(count):
    generator = torch.Generator().manual_seed(0)
    first, size = torch.tensor([0, 4]), torch.tensor([4, 4])
    found = torch.cat([choose(first, size, torch.tensor([count, 1]), generator) for _ in range(4000)]).bincount()
    expected = torch.tensor([1000.0 * count] * 4 + [1000.0] * 4)
    assert ((found - expected).abs() < 5 * expected.sqrt()).all()


def test_a_row_that_comes_may_be_next_or_last():
    places = []
    for seed in range(600):
        generator = torch.Generator().manual_seed(seed)
        passes = Passes(torch.arange(6), torch.tensor([6]), torch.tensor([2]))
        passes.exchange(torch.tensor([6, 7]), torch.tensor([0, 0]), generator)
        assert passes.compact()[:2].tolist() == [0, 1], "those that were drawn stay"
        assert sorted(passes.compact().tolist()) == list(range(8))
        places.append(passes.compact().tolist().index(6))
    counts = torch.tensor(places).bincount()[2:]
    assert len(counts) == 6
    assert ((counts - 100.0).abs() < 50).all()


@settings(max_examples=75, deadline=None)
@given(st.data(), st.lists(st.integers(1, 8), min_size=1, max_size=4), st.integers(0, 999))
def test_rows_go_and_come(data, sizes, seed):
    size = torch.tensor(sizes)
    total = int(size.sum())
    cursor = torch.tensor([data.draw(st.integers(0, n - 1)) for n in sizes])
    passes = Passes(torch.randperm(total), size, cursor.clone())
    groups = [
        set(passes.order[spans(passes.start, size)][a : a + n].tolist())
        for a, n in zip(passes.start.tolist(), sizes, strict=True)
    ]
    drawn = [set(passes.order[a : a + n].tolist()) for a, n in zip(passes.start.tolist(), cursor.tolist(), strict=True)]
    for _ in range(3):
        rows = torch.tensor(sorted(data.draw(st.sets(st.integers(0, total + 5), min_size=1))))
        label = torch.tensor([data.draw(st.integers(0, len(sizes) - 1)) for _ in rows])
        passes.exchange(rows, label, torch.Generator().manual_seed(seed))
        groups, drawn = ([one - set(rows.tolist()) for one in old] for old in (groups, drawn))
        for row, group in zip(rows.tolist(), label.tolist(), strict=True):
            groups[group].add(row)
        for group, (start, n, c) in enumerate(zip(passes.start, passes.size, passes.cursor, strict=True)):
            there = passes.order[start : start + n].tolist()
            assert sorted(there) == sorted(groups[group])
            if c == 0 and drawn[group] == groups[group]:
                drawn[group] = set()  # nothing was left of the pass, so the next one began
            assert set(there[:c]) == drawn[group]


def make(rows, kind, size, seed=0):
    sampler = TaskBalancedSampler() if kind == "balanced" else CoLearningSampler(TARGET)
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(size), sampler=sampler, generator=torch.Generator().manual_seed(seed)
    )


def written(number, start, seed):
    tasks = TASKS[torch.randint(4, (number,), generator=torch.Generator().manual_seed(seed + start))]
    return TensorDict({"task_id": tasks, "row": torch.arange(start, start + number)}, [number])


@settings(max_examples=50, deadline=None)
@given(writes, st.booleans(), st.integers(16, 40), st.integers(0, 99), st.integers(0, 11))
def test_groups_are_those_of_a_fresh_look_and_a_restored_buffer_goes_on(events, balanced, ring, seed, saved):
    kind = "balanced" if balanced else "co-learning"
    replay = make(None, kind, ring)
    first = TensorDict({"task_id": TASKS.repeat(4), "row": torch.arange(16)}, [16])
    replay.extend(first)
    replay.sample(12)
    count, other = 16, None
    for number, (size, batches) in enumerate(events):
        rows = written(size, count, seed)
        count += size
        replay.extend(rows.clone())
        if other is not None:
            other.extend(rows.clone())
        if number == saved:
            other = make(None, kind, ring, seed=5)
            other.load_state_dict(replay.state_dict())
        tasks = replay.storage[:]["task_id"]
        groups = len(tasks.unique())
        if kind == "co-learning" and (TASKS[0] not in tasks or groups == 1):
            return
        batch_size = groups * 2 if kind == "balanced" else (groups - 1) * 4
        for _ in range(batches):
            found = replay.sample(batch_size)
            if other is not None:
                assert (other.sample(batch_size) == found).all()
            assert set(found["row"].tolist()) <= set(range(count - ring, count))
            counts = found["task_id"].unique(return_counts=True)[1]
            assert counts.max() == (2 if kind == "balanced" else (groups - 1) * 2)
            passes, label = replay.sampler._passes, replay.sampler._label(replay.storage)
            assert torch.equal(label[passes.compact()], torch.repeat_interleave(passes.size))
            assert len(passes.compact()) == len(replay)


def test_a_pass_goes_on_as_rows_come():
    """Of each task, no row that stays comes twice before all others that stay came."""
    replay = make(None, "balanced", 1000)
    replay.extend(TensorDict({"task_id": TASKS.repeat(10), "row": torch.arange(40)}, [40]))
    seen = {int(task): [] for task in TASKS}
    for step in range(40):
        batch = replay.sample(4)
        for task, row in zip(batch["task_id"].tolist(), batch["row"].tolist(), strict=True):
            assert row not in seen[task], "each row once, while more come than are drawn"
            seen[task].append(row)
        replay.extend(TensorDict({"task_id": TASKS.repeat(2), "row": torch.arange(8) + 40 + 8 * step}, [8]))
    old = [row for rows in seen.values() for row in rows if row < 40]
    assert 5 < len(old) < 40, "old and new rows are mixed"


def test_what_comes_costs_no_look_at_all_rows(monkeypatch):
    replay = make(None, "balanced", 100)
    replay.extend(TensorDict({"task_id": TASKS.repeat(20), "row": torch.arange(80)}, [80]))
    replay.sample(8)
    monkeypatch.setattr(GroupSampler, "_group", lambda self, storage: pytest.fail("all rows are grouped again"))
    monkeypatch.setattr(TaskBalancedSampler, "_label", lambda self, storage: pytest.fail("all rows are looked at"))
    for _ in range(40):
        replay.extend(TensorDict({"task_id": TASKS.repeat(2), "row": torch.arange(8)}, [8]))
        replay.sample(8)


def test_rows_that_another_buffer_of_the_storage_writes_are_noticed():
    storage = LazyTensorStorage(8)
    one, other = (TensorDictReplayBuffer(storage=storage, sampler=TaskBalancedSampler()) for _ in range(2))
    one.extend(TensorDict({"task_id": TASKS[:2].repeat(4), "row": torch.arange(8)}, [8]))
    other.sample(4)
    one.extend(TensorDict({"task_id": TASKS[[2, 2, 2, 2, 3, 3, 3, 3]], "row": torch.arange(8)}, [8]))
    assert sorted(other.sample(4)["task_id"].tolist()) == sorted(TASKS[[2, 2, 3, 3]].tolist())


def test_a_state_taken_between_a_write_and_a_batch_can_be_restored():
    """It could not: the state said that there are no rows, and had their order."""
    replay = make(None, "balanced", 40)
    replay.extend(TensorDict({"task_id": TASKS.repeat(4), "row": torch.arange(16)}, [16]))
    drawn = replay.sample(8)["row"].tolist()
    replay.extend(TensorDict({"task_id": TASKS, "row": torch.arange(16, 20)}, [4]))
    other = TaskBalancedSampler()
    other.load_state_dict(replay.sampler.state_dict())
    index, _ = other.sample(TensorStorage(replay.storage[:]), 12)
    assert sorted(drawn + index.tolist()) == list(range(20))
