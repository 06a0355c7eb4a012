"""CoLearningSampler: exact counts in any ratio, passes without repetition, states that resume exactly."""

from fractions import Fraction
from math import lcm

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import CoLearningSampler
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.tasks import Task, task_id

TARGET = "coffee-push"
OTHERS = [i for i in range(50) if i != task_id(TARGET)]
base_sizes = st.lists(st.integers(1, 9), min_size=1, max_size=6)  # rows of each base task
target_size = st.integers(1, 9)
fractions = st.integers(2, 9).flatmap(lambda q: st.integers(1, q - 1).map(lambda p: Fraction(p, q)))
multiples = st.integers(1, 3)  # of the smallest batch that is exact
seeds = st.integers(0, 2**31)


def smallest(base, fraction):
    """Return the smallest batch size whose shares are whole numbers, by counting."""
    size = 1
    while (size * fraction).denominator > 1 or (size * (1 - fraction) / base).denominator > 1:
        size += 1
    return size


def make_rows(base, target, shuffled=0):
    tasks = torch.cat([torch.full((n,), OTHERS[4 * i]) for i, n in enumerate(base)])
    tasks = torch.cat([tasks, torch.full((target,), task_id(TARGET))])
    order = torch.randperm(len(tasks), generator=torch.Generator().manual_seed(shuffled))
    return TensorDict({"task_id": tasks[order], "row": torch.arange(len(tasks))}, [len(tasks)])


def with_episodes(*episodes):
    """Return rows of (task_id, length) episodes."""
    task = torch.cat([torch.full((length,), task) for task, length in episodes])
    ids = torch.cat([torch.full((length,), 10 + 3 * number) for number, (_, length) in enumerate(episodes)])
    rows = TensorDict({"task_id": task, "row": torch.arange(len(task))}, [len(task)])
    return rows.set(("collector", "traj_ids"), ids)


def make_replay(rows, batch_size, sampler=None, seed=0):
    return TensorDictReplayBuffer(
        storage=TensorStorage(rows),
        sampler=sampler or CoLearningSampler(TARGET),
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )


def joined(*parts):
    """Join the rows of several datasets as load_demonstrations does."""
    return torch.cat([part.set("dataset", torch.full(part.shape, number)) for number, part in enumerate(parts)])


def drawn(replay, number):
    return [replay.sample()["row"].tolist() for _ in range(number)]


@settings(max_examples=50, deadline=None)
@given(base_sizes, target_size, fractions, multiples, seeds)
def test_batches_have_exactly_the_targets_fraction(base, target, fraction, multiple, seed):
    size = multiple * smallest(len(base), fraction)
    sampler = CoLearningSampler(TARGET, target_fraction=float(fraction) if seed % 2 else fraction)
    replay = make_replay(make_rows(base, target), size, sampler, seed)
    for _ in range(4):
        batch = replay.sample()
        assert batch["is_target"].dtype == torch.bool
        assert batch["is_target"].shape == batch["task_id"].shape == (size,)
        assert int(batch["is_target"].sum()) == size * fraction
        assert torch.equal(batch["is_target"], batch["task_id"] == task_id(TARGET))
        tasks, counts = batch["task_id"][~batch["is_target"]].unique(return_counts=True)
        assert tasks.tolist() == [OTHERS[4 * i] for i in range(len(base))]
        assert counts.tolist() == [size * (1 - fraction) / len(base)] * len(base)


@settings(max_examples=30, deadline=None)
@given(base_sizes, target_size, fractions, seeds)
def test_every_row_of_a_task_comes_once_before_any_comes_again(base, target, fraction, seed):
    rows = make_rows(base, target)
    sampler = CoLearningSampler(TARGET, target_fraction=fraction)
    replay = make_replay(rows, smallest(len(base), fraction), sampler, seed)
    batches = [replay.sample() for _ in range(10)]
    for task in rows["task_id"].unique():
        everything = sorted(rows["row"][rows["task_id"] == task].tolist())
        of_task = torch.cat([batch["row"][batch["task_id"] == task] for batch in batches]).tolist()
        for start in range(0, len(of_task), len(everything)):
            piece = of_task[start : start + len(everything)]
            assert len(set(piece)) == len(piece)
            assert sorted(piece) == everything or start + len(everything) > len(of_task)


@settings(max_examples=30, deadline=None)
@given(base_sizes, target_size, fractions, st.integers(1, 300))
def test_with_exact_other_batch_sizes_are_errors_with_the_nearest(base, target, fraction, size):
    unit = smallest(len(base), fraction)
    sampler = CoLearningSampler(TARGET, target_fraction=fraction, exact=True)
    replay = make_replay(make_rows(base, target), None, sampler)
    if size % unit == 0:
        assert len(replay.sample(size)) == size
        return
    near = [n for n in (size // unit * unit, size // unit * unit + unit) if n]
    with pytest.raises(ValueError, match=f"batch_size must be a multiple of {unit},") as caught:
        replay.sample(size)
    assert str(caught.value).endswith("the nearest are " + " and ".join(map(str, near)))
    assert len(replay.sample(near[-1])) == near[-1]


@settings(max_examples=25, deadline=None)
@given(base_sizes, target_size, seeds, st.integers(0, 6))
def test_a_restored_state_gives_the_same_batches(base, target, seed, before):
    rows, size = make_rows(base, target), lcm(2, 2 * len(base))
    replay = make_replay(rows, size, seed=seed)
    drawn(replay, before)
    state = replay.state_dict()
    expected = [(batch["row"].tolist(), replay.sampler.ran_out) for batch in (replay.sample() for _ in range(6))]
    other = make_replay(rows, size, seed=seed + 1)
    drawn(other, 3)
    other.load_state_dict(state)
    assert [(batch["row"].tolist(), other.sampler.ran_out) for batch in (other.sample() for _ in range(6))] == expected


@pytest.mark.parametrize(
    ("other", "name"),
    [(CoLearningSampler("reach"), "target"), (CoLearningSampler(TARGET, target_fraction=0.25), "target_fraction")],
)
def test_the_state_of_another_target_or_ratio_is_an_error(other, name):
    replay = make_replay(make_rows([3, 3], 3), 4)
    drawn(replay, 1)
    with pytest.raises(ValueError, match=f"state_dict has a different {name}"):
        other.load_state_dict(replay.sampler.state_dict())


@settings(max_examples=20, deadline=None)
@given(base_sizes, target_size, fractions, seeds)
def test_ran_out_is_true_at_the_end_of_the_longest_pass(base, target, fraction, seed):
    size = smallest(len(base), fraction)
    replay = make_replay(make_rows(base, target), size, CoLearningSampler(TARGET, target_fraction=fraction), seed)
    shares = [int(size * fraction)] + [int(size * (1 - fraction)) // len(base)] * len(base)
    passes = [Fraction(rows, share) for rows, share in zip([target, *base], shares, strict=True)]
    longest = max(passes)
    for batch in range(1, 12):
        replay.sample()
        assert replay.sampler.ran_out == (batch // longest > (batch - 1) // longest)


def test_the_target_of_joined_datasets_is_in_the_last_one():
    base = with_episodes((1, 4), (task_id(TARGET), 4), (2, 4))
    target = with_episodes((task_id(TARGET), 3)).apply(lambda column: column + 0)
    target["row"] += 100
    replay = make_replay(joined(base, target), 8)
    batches = [replay.sample() for _ in range(8)]
    assert torch.cat([b["row"][b["is_target"]] for b in batches]).unique().tolist() == [100, 101, 102]
    assert torch.cat([b["row"][~b["is_target"]] for b in batches]).unique().tolist() == [0, 1, 2, 3, 8, 9, 10, 11]
    only_base = joined(target, with_episodes((1, 4)))
    assert int(make_replay(only_base, 8).sample()["is_target"].sum()) == 4


@settings(max_examples=30, deadline=None)
@given(base_sizes, target_size, fractions, st.lists(st.integers(1, 40), min_size=1, max_size=20), seeds)
def test_shares_are_rounded_and_later_batches_make_up_for_it(base, target, fraction, sizes, seed):
    replay = make_replay(make_rows(base, target), None, CoLearningSampler(TARGET, target_fraction=fraction), seed)
    batches = [replay.sample(size) for size in sizes]
    assert [len(batch) for batch in batches] == sizes
    tasks = torch.cat([batch["task_id"] for batch in batches])
    share = [fraction] + [(1 - fraction) / len(base)] * len(base)
    for part, task in zip(share, [task_id(TARGET), *OTHERS[: 4 * len(base) : 4]], strict=True):
        assert abs(int((tasks == task).sum()) - part * sum(sizes)) < 2


@pytest.mark.parametrize("name", [TARGET, "stack-blocks", "suite/stack-blocks"])
def test_the_target_is_a_name_an_id_or_a_task(name):
    task = Task(name, "Stack.", (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("block", (4, 5, 6))))
    rows = TensorDict({"task_id": torch.tensor([1] * 4 + [task_id(name)] * 2), "row": torch.arange(6)}, [6])
    for target in (name, task_id(name), task):
        assert make_replay(rows, 4, CoLearningSampler(target)).sample()["is_target"].sum() == 2


@settings(max_examples=25, deadline=None)
@given(base_sizes, target_size, fractions, seeds)
def test_row_weights_are_frequencies_of_rows(base, target, fraction, seed):
    rows = make_rows(base, target, shuffled=seed)
    size = smallest(len(base), fraction)
    replay = make_replay(rows, size, CoLearningSampler(TARGET, target_fraction=fraction), seed)
    batches = lcm(*base, target)  # then every row of a group has come equally often
    counts = torch.zeros(len(rows))
    for _ in range(min(batches, 20)):
        counts.index_add_(0, replay.sample()["row"], torch.ones(size))
    weights = replay.sampler.row_weights(replay.storage)
    assert weights.sum().item() == pytest.approx(1.0)
    if batches <= 20:
        torch.testing.assert_close(weights, counts / counts.sum())


def test_rows_that_are_left_out_have_no_weight():
    parts = with_episodes((3, 4), (task_id(TARGET), 2), (7, 4)), with_episodes((task_id(TARGET), 2))
    sampler = CoLearningSampler(TARGET)
    replay = make_replay(joined(*parts), 4, sampler)
    weights = sampler.row_weights(replay.storage)
    assert weights.tolist() == pytest.approx([0.0625] * 4 + [0.0] * 2 + [0.0625] * 4 + [0.25] * 2)
