"""GrowingStorage: the newest rows and no others, trajectories that are told apart, states that go on."""

from __future__ import annotations

import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import Stream, own_rows
from torchrl.data import (
    LazyTensorStorage,
    RandomSampler,
    SamplerWithoutReplacement,
    SliceSampler,
    TensorDictReplayBuffer,
)

from lw_torchrl.data import CoLearningSampler, GrowingStorage, GrowingWriter, TaskBalancedSampler

IDS = ("collector", "traj_ids")
# (which collector, whether it is reset before, steps)
events = st.lists(st.tuples(st.integers(0, 1), st.integers(0, 3), st.integers(1, 6)), min_size=1, max_size=8)


def buffer(grow=30, sampler=None, batch_size=8, seed=0, **options):
    return TensorDictReplayBuffer(
        storage=GrowingStorage([own_rows([4, 3]), own_rows([5], first=-500.0)], grow=grow, **options),
        writer=GrowingWriter(),
        sampler=sampler or CoLearningSampler("grown"),
        collate_fn=lambda batch: batch,
        batch_size=batch_size,
        generator=torch.Generator().manual_seed(seed),
    )


def batches(events, envs, seed):
    """Batches of two collectors, each of which may be reset before."""
    streams = [Stream(number, envs, seed + number) for number in range(2)]
    found = []
    for number, reset, steps in events:
        if not reset:
            streams[number].reset()
        found.append(streams[number].batch(steps))
    return found


def chains(written):
    """Which trajectory each observation is of, told by what follows what."""
    known = {}
    for row in written.reshape(-1).unbind(0):
        at = float(row["observation"][0])
        known.setdefault(at, at)
        if not row["next", "done"]:
            known[at + 1] = known[at]
    return known


@settings(max_examples=40, deadline=None)
@given(events, st.integers(1, 3), st.integers(18, 60), st.integers(0, 99), st.booleans())
def test_it_holds_the_newest_rows_and_tells_trajectories_apart(events, envs, grow, seed, flat):
    replay = buffer(grow)
    given = batches(events, envs, seed)
    truth, number_of = chains(torch.cat([batch.reshape(-1) for batch in given])), {}
    written, owner = [], {}
    for batch in given:
        index = replay.extend(batch.reshape(-1) if flat else batch)
        assert index.shape == ((batch.numel(),) if flat else batch.shape)
        written = (written + batch.reshape(-1)["observation"][:, 0].tolist())[-grow:]
        rows = replay.storage[12:]
        assert sorted(rows["observation"][:, 0].tolist()) == sorted(written)
        assert torch.equal(replay.storage[index.reshape(-1)]["observation"], batch.reshape(-1)["observation"])
        assert torch.equal(rows["action"], (rows["observation"] * 0.37).sin()), "columns belong together"
        assert len(replay) == 12 + len(written)
        for at, number in zip(rows["observation"][:, 0].tolist(), rows[IDS].tolist(), strict=True):
            assert number_of.setdefault(truth[at], number) == number, "a trajectory keeps its number"
            assert owner.setdefault(number, truth[at]) == truth[at], "and no other ever has it"
        number_of = {one: number_of[one] for one in {truth[at] for at in written}}  # while a row of it is there
        assert min(owner) > int(replay.storage[:12][IDS].max())
    assert (replay.storage[:12] == buffer().storage[:12]).all(), "demonstrations stay"


def test_steps_of_rows_and_interleaved_rows_are_followed_too():
    batch = Stream(0, 3, 1).batch(7)
    whole, stepwise, turned = buffer(), buffer(), buffer()
    whole.extend(batch.clone())
    for step in batch.unbind(1):
        assert stepwise.add(step).shape == (3,)
    turned.extend(batch.transpose(0, 1).reshape(-1))
    numbers = [
        dict(zip(r.storage[12:]["observation"][:, 0].tolist(), r.storage[12:][IDS].tolist(), strict=True))
        for r in (whole, stepwise, turned)
    ]
    for other in numbers[1:]:
        pairs = {(numbers[0][at], other[at]) for at in other}
        assert len(pairs) == len(set(numbers[0].values())) == len(set(other.values()))


@settings(max_examples=30, deadline=None)
@given(events, st.integers(18, 40), st.integers(0, 99), st.sampled_from([0.25, 0.5]), st.integers(0, 8))
def test_exact_counts_of_rows_that_are_there_and_states_that_go_on(events, grow, seed, fraction, saved):
    replay = buffer(grow, CoLearningSampler("grown", target_fraction=fraction), n_steps=3, gamma=0.9)
    other = None
    for number, batch in enumerate(batches(events, 2, seed)):
        replay.extend(batch.clone())
        if other is not None:
            other.extend(batch.clone())
        if number == saved:
            other = buffer(grow, CoLearningSampler("grown", target_fraction=fraction), seed=7, n_steps=3, gamma=0.9)
            other.load_state_dict(replay.state_dict())
        there = replay.storage[12:]["observation"][:, 0].tolist()
        for _ in range(3):
            found = replay.sample()
            grown = found["observation"][:, 0] >= 0
            assert torch.equal(grown, found["is_target"])
            assert grown.sum() == 8 * fraction
            assert found["task_id"][~grown].unique(return_counts=True)[1].tolist() == [4 * (1 - fraction)] * 2
            assert set(found["observation"][grown, 0].tolist()) <= set(there)
            if other is not None:
                assert (other.sample() == found).all()
    if other is not None:
        assert (other.storage[:] == replay.storage[:]).all()


def test_every_row_that_is_there_can_be_drawn_and_none_is_favoured():
    replay = buffer(20, batch_size=200)
    replay.extend(Stream(0, 2, 0).batch(8))
    replay.extend(Stream(1, 2, 1).batch(4))
    seen = torch.cat([replay.sample()["index"] for _ in range(50)])
    counts = seen[seen >= 12].bincount()[12:]
    assert len(counts) == 20
    assert counts.min() > 150, "250 of each are expected, give or take 16"
    assert counts.max() < 350


@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement])
def test_other_samplers_draw_from_all_rows(sampler):
    replay, stream = buffer(20, sampler()), Stream(0, 2, 0)
    for _ in range(4):
        replay.extend(stream.batch(8))
        seen = {at for _ in range(60) for at in replay.sample()["observation"][:, 0].tolist()}
        assert seen == set(replay.storage[:]["observation"][:, 0].tolist())


@pytest.mark.parametrize("cached", [True, False])
def test_slices_never_join_what_does_not_follow(cached):
    sampler = SliceSampler(slice_len=3, cache_values=cached, strict_length=True)
    replay, stream = buffer(21, sampler, batch_size=300), Stream(0, 1, 3)
    joined = set()
    for number in range(12):
        if number % 3 == 0:
            stream.reset()
        replay.extend(stream.batch(5))
        found = replay.sample().reshape(100, 3)
        assert torch.equal(found["observation"][:, 1:], found["next", "observation"][:, :-1])
        joined |= set(found["observation"][..., 0].flatten().tolist())
    assert any(at >= 0 for at in joined)


def test_rows_with_gaps_are_told():
    with pytest.warns(UserWarning, match="19 of 20 rows differ from .* of the row before"):
        buffer().extend(own_rows([40], first=0.0)[::2])
    assert len(buffer().storage) == 12


def test_one_trajectory_longer_than_the_ring_is_not_joined_at_the_edge():
    replay = buffer(10, SliceSampler(slice_len=3), batch_size=300)
    for batch in own_rows([35], first=0.0).split(7):
        replay.extend(batch)
        found = replay.sample().reshape(100, 3)
        assert torch.equal(found["observation"][:, 1:], found["next", "observation"][:, :-1])
    assert len(replay.storage[12:][IDS].unique()) == 1


def test_nothing_has_come_yet():
    replay = buffer()
    with pytest.raises(ValueError, match="target 'grown': extend the buffer before the first sample"):
        replay.sample()
    replay.extend(Stream(0, 2, 0).batch(3))
    assert replay.sample()["is_target"].sum() == 4
    assert replay.write_count == 6
    numbers = replay.storage[12:][IDS]
    replay.empty()
    assert len(replay) == 12
    with pytest.raises(ValueError, match="extend the buffer before the first sample"):
        replay.sample()
    replay.extend(Stream(0, 2, 0).batch(3))
    assert replay.storage[12:][IDS].min() > numbers.max()


def test_targets_and_storages_that_do_not_belong_together_are_refused():
    replay = buffer(sampler=CoLearningSampler("reach"))
    replay.extend(Stream(0, 2, 0).batch(3))
    with pytest.raises(ValueError, match="target must be 'grown', since the buffer grows, got 'reach'"):
        replay.sample()
    plain = TensorDictReplayBuffer(storage=LazyTensorStorage(20), sampler=CoLearningSampler("grown"), batch_size=8)
    plain.extend(own_rows([4, 4]))
    with pytest.raises(ValueError, match="target 'grown' needs a growing buffer"):
        plain.sample()
    replay = buffer(batch_size=6)
    replay.extend(Stream(0, 2, 0).batch(3))
    with pytest.raises(ValueError, match=r"batch_size must be a multiple of 4, .* got 6; the nearest are 4 and 8"):
        replay.sample()
    weights = replay.sampler.row_weights(replay.storage)
    assert weights[12:].tolist() == pytest.approx([0.5 / 6] * 6)
    assert float(weights.sum()) == pytest.approx(1.0)


def changed(name, value):
    batch = Stream(0, 2, 0).batch(3)
    return batch.exclude(name) if value is None else batch.set(name, value)


BAD = [
    (changed(("next", "reward"), None), "batch lacks the columns next/reward, which"),
    (changed(IDS, None), "batch lacks the columns collector/traj_ids, which"),
    (changed("observation", torch.zeros(2, 3, 3)), r"column observation must be torch.float32 of shape \(2,\) a row"),
    (changed("task_id", torch.zeros(2, 3)), "column task_id must be torch.int64 .* got torch.float32"),
    (changed(("next", "reward"), torch.full((2, 3, 1), torch.nan)), "column next/reward holds NaN"),
    (changed("action", torch.full((2, 3, 2), 1.5)), r"action must be the executed action, in \[-1, 1\], got 1.5"),
    (changed("steps_to_next_obs", torch.ones(2, 3)), "of MultiStep; leave that out"),
    (changed(("collector", "mask"), torch.ones(2, 3).tril().bool()), "padding of split_trajs=True"),
    (Stream(0, 2, 0).batch(16), "batch must have 1 to 30 rows, as many as grow says, got 32"),
]


@pytest.mark.parametrize(("batch", "message"), BAD)
def test_rows_that_do_not_fit_are_refused_and_nothing_is_written(batch, message):
    replay = buffer()
    replay.extend(Stream(1, 2, 0).batch(3))
    before = replay.storage.state_dict()
    with pytest.raises(ValueError, match=message):
        replay.extend(batch)
    assert len(replay) == 12 + 6
    assert all(torch.equal(before["rows"][key], leaf) for key, leaf in replay.storage.state_dict()["rows"].items())


def test_what_was_done_is_the_action_and_other_columns_are_left_out():
    replay = buffer()
    batch = changed("action", torch.full((2, 3, 2), 7.0))
    batch["next", "executed_action"], batch["loc"] = torch.full((2, 3, 2), 0.5), torch.zeros(2, 3, 4)
    replay.extend(batch)
    assert (replay.storage[12:]["action"] == 0.5).all()
    assert "loc" not in replay.sample().keys()


def test_it_is_of_one_process():
    storage = GrowingStorage([own_rows([3])], grow=9)
    storage.extend(Stream(0, 2, 0).batch(3))
    assert (pickle.loads(pickle.dumps(storage))[:] == storage[:]).all()
    torch_spawn = torch.multiprocessing.get_context("spawn")
    with pytest.raises(RuntimeError, match="a growing buffer cannot be shared between processes"):
        torch_spawn.Process(target=print, args=(storage,)).start()


def test_another_writer_is_refused():
    storage = GrowingStorage([own_rows([3])], grow=5)
    replay = TensorDictReplayBuffer(storage=storage, batch_size=2, collate_fn=lambda batch: batch)
    with pytest.raises(RuntimeError, match="only a GrowingWriter writes"):
        replay.extend(own_rows([2]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"length": 13}, "must be of 12 rows, got one of 13"),
        ({"grow": 31}, "of a buffer with grow=30, got 31"),
        ({"count": 7}, "observation must be finite"),
        ({"rows": {}}, "rows must hold the columns"),
    ],
)
def test_a_state_of_another_buffer_is_refused_and_nothing_changes(change, message):
    storage, other = buffer().storage, buffer().storage
    for one in (storage, other):
        one.extend(Stream(0, 2, 0).batch(3))
    with pytest.raises(ValueError, match=message):
        storage.load_state_dict(other.state_dict() | change)
    assert (storage[:] == other[:]).all()


def test_the_storage_alone_goes_through_a_folder(tmp_path):
    storage, other = buffer().storage, buffer().storage
    storage.extend(Stream(0, 2, 0).batch(3))
    storage.dumps(tmp_path)
    other.loads(tmp_path)
    assert (storage[:] == other[:]).all()


@pytest.mark.parametrize("options", [{}, {"n_steps": 3, "gamma": 0.9}])
@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement, TaskBalancedSampler])
def test_every_sampler_gives_rows_that_say_whether_they_are_demonstrations(sampler, options):
    replay = buffer(10, sampler(), **options)
    assert replay.sample()["is_demonstration"].all()
    for batch in batches([(0, 1, 3), (1, 0, 2), (0, 1, 5)], 2, seed=0):
        replay.extend(batch)
        sample = replay.sample()
        assert torch.equal(sample["is_demonstration"], sample["index"] < 12)
        assert torch.equal(sample["is_demonstration"], sample["observation"][:, 0] < 0)
    assert torch.equal(replay.storage.column("is_demonstration"), torch.arange(22) < 12)
    balanced = buffer(10, TaskBalancedSampler("is_demonstration"))
    balanced.extend(batch)
    assert balanced.sample()["is_demonstration"].sum() == 4


def test_parts_that_say_so_themselves_are_demonstrations_all_the_same():
    said = own_rows([4, 3]).set("is_demonstration", torch.zeros(7, dtype=torch.bool))
    storage = GrowingStorage([said], grow=10)
    storage.extend(Stream(0, 2, seed=0).batch(3))
    assert storage[:]["is_demonstration"].tolist() == [True] * 7 + [False] * 6
    assert "is_demonstration" not in storage.state_dict()["rows"]
