"""TaskBalancedSampler and CoLearningSampler: exact shares, passes without repetition, states, several processes."""

from fractions import Fraction
from math import lcm
from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torch.utils.data import DataLoader, IterableDataset, get_worker_info
from torchrl.data import LazyMemmapStorage, LazyStackStorage, LazyTensorStorage, ListStorage
from torchrl.data.replay_buffers import TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import CoLearningSampler, TaskBalancedSampler
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.tasks import Task, task_id

TARGET = "coffee-push"
BASE = [number for number in range(50) if number != task_id(TARGET)][::4]
fractions = st.integers(2, 9).flatmap(lambda q: st.integers(1, q - 1).map(lambda p: Fraction(p, q)))
seeds = st.integers(0, 2**31)


def make_rows(tasks):
    return TensorDict({"task_id": torch.as_tensor(tasks), "row": torch.arange(len(tasks))}, [len(tasks)])


def make_replay(rows, batch_size, sampler, seed=0, storage=TensorStorage):
    generator = torch.Generator().manual_seed(seed)
    empty = storage is not TensorStorage
    storage = storage(30) if empty else storage(rows)
    replay = TensorDictReplayBuffer(storage=storage, sampler=sampler, batch_size=batch_size, generator=generator)
    if empty:
        replay.extend(rows)
    return replay


class Case(NamedTuple):
    """Rows, the share of each task in a batch, and the target's share for a CoLearningSampler."""

    rows: TensorDict
    shares: dict[int, Fraction]
    fraction: Fraction | None

    @property
    def unit(self):
        """The smallest batch size that can be divided exactly."""
        return lcm(*(share.denominator for share in self.shares.values()))

    def sampler(self, of=lambda fraction: fraction, **options):
        if self.fraction is None:
            return TaskBalancedSampler(**options)
        return CoLearningSampler(TARGET, target_fraction=of(self.fraction), **options)


@st.composite
def cases(draw, is_target=None):
    fraction = draw(fractions if is_target else st.none() | fractions)
    sizes = draw(st.lists(st.integers(1, 9), min_size=1 if fraction is None else 2, max_size=6))
    shares = dict.fromkeys(BASE[: len(sizes)], Fraction(1, len(sizes)))
    if fraction is not None:
        base = BASE[: len(sizes) - 1]
        shares = {task_id(TARGET): fraction, **dict.fromkeys(base, (1 - fraction) / len(base))}
    tasks = torch.repeat_interleave(torch.tensor([*shares]), torch.tensor(sizes))
    order = torch.randperm(len(tasks), generator=torch.Generator().manual_seed(draw(seeds)))
    return Case(make_rows(tasks[order]), shares, fraction)


@settings(max_examples=80, deadline=None)
@given(cases(), st.integers(1, 3), seeds)
def test_batches_hold_exact_shares_and_every_row_comes_once_before_any_comes_again(case, multiple, seed):
    size, drawn = multiple * case.unit, {task: [] for task in case.shares}
    replay = make_replay(case.rows, size, case.sampler(float if seed % 2 else Fraction), seed)
    of_task = {task: case.rows["row"][case.rows["task_id"] == task].tolist() for task in case.shares}
    longest = max(len(of_task[task]) / (size * share) for task, share in case.shares.items())
    for number in range(1, 12):
        batch = replay.sample()
        assert len(batch) == size
        assert replay.sampler.ran_out == (number // longest > (number - 1) // longest)
        assert case.fraction is None or torch.equal(batch["is_target"], batch["task_id"] == task_id(TARGET))
        for task, share in case.shares.items():
            rows = batch["row"][batch["task_id"] == task].tolist()
            assert len(rows) == size * share
            drawn[task] += rows
    for task, everything in of_task.items():
        for start in range(0, len(drawn[task]), len(everything)):
            piece = drawn[task][start : start + len(everything)]
            assert len({*piece}) == len(piece)
            assert sorted(piece) == everything or start + len(everything) > len(drawn[task])


@settings(max_examples=30, deadline=None)
@given(cases(), st.integers(1, 300))
def test_with_exact_other_batch_sizes_are_errors_with_the_nearest(case, size):
    unit = case.unit
    replay = make_replay(case.rows, None, case.sampler(exact=True))
    if size % unit == 0:
        assert len(replay.sample(size)) == size
        return
    near = [n for n in (size // unit * unit, size // unit * unit + unit) if n]
    with pytest.raises(ValueError, match=f"batch_size must be a multiple of {unit},") as caught:
        replay.sample(size)
    assert str(caught.value).endswith(f"nearest to {size}: " + " and ".join(map(str, near)))
    assert len(replay.sample(near[-1])) == near[-1]


@settings(max_examples=60, deadline=None)
@given(cases(), st.lists(st.integers(1, 40), min_size=1, max_size=20), seeds)
def test_shares_are_rounded_and_a_restored_state_continues_with_the_same_batches(case, sizes, seed):
    replay, other = (make_replay(case.rows, None, case.sampler(), each) for each in (seed, seed + 1))
    batches = [replay.sample(size) for size in sizes]
    assert [len(batch) for batch in batches] == sizes
    tasks = torch.cat([batch["task_id"] for batch in batches])
    for task, share in case.shares.items():
        assert abs(int((tasks == task).sum()) - share * sum(sizes)) <= 1
    other.sample(3)
    other.load_state_dict(replay.state_dict())
    for size in sizes:
        assert (other.sample(size) == replay.sample(size)).all()
        assert other.sampler.ran_out == replay.sampler.ran_out


@pytest.mark.parametrize("changed", [{"target": "reach"}, {"target_fraction": 0.25}])
def test_the_state_of_another_target_or_ratio_is_an_error(changed):
    other = CoLearningSampler(**{"target": TARGET, **changed})
    with pytest.raises(ValueError, match=f"state_dict has a different {next(iter(changed))}"):
        other.load_state_dict(CoLearningSampler(TARGET).state_dict())


def test_the_target_of_joined_datasets_is_in_the_last_one():
    target = task_id(TARGET)
    rows = make_rows([1] * 4 + [target] * 4 + [2] * 4 + [target] * 3).set("dataset", torch.tensor([0] * 12 + [1] * 3))
    replay = make_replay(rows, 8, CoLearningSampler(TARGET))
    batches = torch.cat([replay.sample() for _ in range(8)])
    assert batches["row"][batches["is_target"]].unique().tolist() == [12, 13, 14]
    assert batches["row"][~batches["is_target"]].unique().tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    expected = [0.0625] * 4 + [0.0] * 4 + [0.0625] * 4 + [1 / 6] * 3
    assert replay.sampler.row_weights(replay.storage).tolist() == pytest.approx(expected)
    only_base = make_rows([target] * 3 + [1] * 4).set("dataset", torch.tensor([0] * 3 + [1] * 4))
    assert make_replay(only_base, 8, CoLearningSampler(TARGET)).sample()["is_target"].sum() == 4


@pytest.mark.parametrize("name", [TARGET, "stack-blocks", "suite/stack-blocks"])
def test_the_target_is_a_name_an_id_or_a_task(name):
    task = Task(name, "Stack.", (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("block", (4, 5, 6))))
    rows = make_rows([1] * 4 + [task_id(name)] * 2)
    for target in (name, task_id(name), task):
        assert make_replay(rows, 4, CoLearningSampler(target)).sample()["is_target"].sum() == 2


@settings(max_examples=25, deadline=None)
@given(cases(is_target=True), seeds)
def test_row_weights_are_frequencies_of_rows(case, seed):
    replay = make_replay(case.rows, case.unit, case.sampler(), seed)
    batches = lcm(*case.rows["task_id"].unique(return_counts=True)[1].tolist())  # whole passes of every task
    counts = sum(replay.sample()["row"].bincount(minlength=len(case.rows)) for _ in range(min(batches, 20)))
    weights = replay.sampler.row_weights(replay.storage)
    assert weights.sum().item() == pytest.approx(1.0)
    if batches <= 20:
        torch.testing.assert_close(weights, counts / counts.sum())


@pytest.mark.parametrize("tail", [(), (1,), (10,), (2, 3)])
@pytest.mark.parametrize("storage", [LazyTensorStorage, ListStorage, LazyStackStorage, LazyMemmapStorage])
def test_rows_may_hold_their_task_in_any_shape_in_any_storage(tail, storage):
    """Such as rows that are pieces of trajectories, (n, T)."""
    task = torch.arange(8).view(8, *[1] * len(tail)).expand(8, *tail) % 2
    replay = make_replay(make_rows(task), 4, TaskBalancedSampler(), storage=storage)
    for _ in range(4):
        batch = replay.sample()
        assert batch["task_id"].shape == (4, *tail)
        assert (batch["row"] % 2).bincount().tolist() == [2, 2]
    replay.extend(make_rows(task)[:2])
    assert len(replay.sample()) == 4


def test_a_buffer_that_grows_or_is_emptied_is_grouped_again():
    replay = make_replay(make_rows([3, 5] * 4), 6, TaskBalancedSampler(), storage=LazyTensorStorage)
    replay.sample()
    more = make_rows([20] * 6)
    replay.extend(more.set("row", more["row"] + 8))
    batches = [replay.sample() for _ in range(11)]
    assert all(batch["task_id"].bincount()[[3, 5, 20]].tolist() == [2, 2, 2] for batch in batches)
    assert {row for batch in batches for row in batch["row"].tolist()} == {*range(14)}
    replay.empty()
    replay.extend(make_rows([30, 30, 32, 32, 32, 32]))
    assert replay.sample()["task_id"].bincount()[[30, 32]].tolist() == [3, 3]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 12), st.integers(0, 4)), min_size=1, max_size=12), seeds)
def test_writes_to_a_full_storage_repeat_no_row_in_a_pass(rounds, seed):
    """Rows of a task that were not drawn yet come before those that were, whatever is written in between."""
    replay = make_replay(make_rows([3, 5] * 9), 4, TaskBalancedSampler(), seed, LazyTensorStorage)
    value, drawn_now = 18, {3: set(), 5: set()}  # values that are in the ring and were drawn in the task's pass
    for count, batches in rounds:
        for _ in range(batches):
            batch, stored = replay.sample(), replay[:]
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
        written = make_rows([(3, 5)[number % 2] for number in range(count)])
        replay.extend(written.set("row", written["row"] + value))
        value += count


@pytest.mark.parametrize("capacity", [200, 60], ids=["not full", "full"])
def test_every_row_of_a_storage_of_two_dimensions_comes_once(capacity):
    storage = LazyTensorStorage(capacity, ndim=2)
    replay = TensorDictReplayBuffer(storage=storage, sampler=TaskBalancedSampler(), batch_size=9)
    task = torch.tensor([3, 5, 5, 7])[:, None].expand(-1, 20)  # a collector's batch: a task in each environment
    grid = TensorDict({"task_id": task, "row": torch.arange(80).view(4, 20)}, [4, 20])
    for _ in range(2):
        replay.extend(grid[:, : 20 if capacity == 200 else 15])
    batches = [replay.sample() for _ in range(20)]
    for batch in batches:
        assert batch["task_id"].bincount().tolist() == [0, 0, 0, 3, 0, 3, 0, 3]
        assert (storage[batch["index"].unbind(-1)]["row"] == batch["row"]).all()
    rows = len(storage) // 4
    indices = torch.cat([batch["index"][batch["task_id"] == 3] for batch in batches])[:rows]
    assert len(indices.unique(dim=0)) == rows


def begun(tasks=(1, 1, 1, 2, 2, 2, 2, 2), batch_size=4, seed=0):
    """Return a buffer whose passes have begun."""
    replay = make_replay(make_rows(tasks), batch_size, TaskBalancedSampler(), seed)
    replay.sample()
    return replay


@pytest.mark.parametrize("tasks", [(1, 1, 1, 2, 2, 2, 2), (1, 1, 1, 1, 2, 2, 2, 2), (1,) * 8])
def test_the_state_of_other_rows_is_an_error_at_the_next_batch(tasks):
    replay = begun(tasks, batch_size=12)
    replay.sampler.load_state_dict(begun().sampler.state_dict())
    for _ in range(2):
        with pytest.raises(ValueError, match="state_dict must fit the storage's"):
            replay.sample()


def test_the_state_of_an_unused_sampler_starts_anew():
    replay = begun()
    replay.sampler.load_state_dict(TaskBalancedSampler().state_dict())
    assert sorted(replay.sample()["task_id"].tolist()) == [1, 1, 2, 2]


def test_rows_that_are_written_after_a_state_was_restored_are_grouped_again():
    sampler, rows = begun().sampler, make_rows([1, 1, 2, 2, 3, 3])
    sampler.load_state_dict(sampler.state_dict())
    sampler.extend(torch.arange(2))
    index, _ = sampler.sample(TensorStorage(rows), 3)
    assert sorted(rows["task_id"][index].tolist()) == [1, 2, 3]


def test_a_damaged_file_is_an_error(tmp_path):
    replay = begun()
    replay.sampler.dumps(tmp_path)
    (file,) = tmp_path.iterdir()
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.raises(ValueError, match=rf"path: '{tmp_path}' holds no sampler's state"):
        replay.sampler.loads(tmp_path)
    assert len(replay.sample()) == 4


def open_anew(replay, worker):
    return begun((0, 1) * 40, 8, worker)


def set_sampler(replay, worker):
    replay.set_sampler(TaskBalancedSampler())
    replay.set_rng(torch.Generator().manual_seed(worker))
    return replay


class Batches(IterableDataset):
    def __init__(self, prepare):
        self.prepare, self.replay = prepare, begun((0, 1) * 40, 8)

    def __iter__(self):
        replay = self.prepare(self.replay, get_worker_info().id)
        for _ in range(3):
            yield replay.sample()["row"].tolist()


def drawn_by_workers(prepare):
    return list(DataLoader(Batches(prepare), batch_size=None, num_workers=2, multiprocessing_context="fork"))


@pytest.mark.parametrize("prepare", [open_anew, set_sampler])
def test_workers_draw_different_batches_and_repeat_them(prepare):
    batches = drawn_by_workers(prepare)
    assert len({tuple(batch) for batch in batches}) == 6
    assert batches == drawn_by_workers(prepare)


def test_workers_that_would_draw_the_same_rows_are_an_error():
    with pytest.raises(RuntimeError, match="2 workers of the DataLoader would draw the same rows"):
        drawn_by_workers(lambda replay, worker: replay)
