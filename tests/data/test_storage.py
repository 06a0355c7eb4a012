"""JoinedStorage: the rows that indexing the parts' concatenation would give, and no column in memory twice."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import ImmutableDatasetWriter, SamplerWithoutReplacement, SliceSampler, TensorDictReplayBuffer

from lw_torchrl.data import JoinedStorage

lengths = st.lists(st.integers(0, 7), min_size=1, max_size=4).filter(any)


def part(length, first=0):
    rows = torch.arange(first, first + length)
    return TensorDict(
        {
            "x": rows,
            "third": rows // 3,
            "y": torch.stack([rows, -rows], 1).float(),
            "next": {"done": (rows % 3 == 0)[:, None]},
        },
        [length],
    )


def parts(lengths):
    return [part(length, 100 * number) for number, length in enumerate(lengths)]


@settings(max_examples=75, deadline=None)
@given(st.data(), lengths, st.booleans())
def test_it_is_the_concatenation_of_the_chosen_rows(data, lengths, choose):
    joined = parts(lengths)
    rows = None
    expected = torch.cat(joined)
    if choose:
        rows = [
            data.draw(st.none() | st.lists(st.integers(0, n - 1), max_size=9).map(lambda r: torch.tensor(r, dtype=int)))
            if n
            else None
            for n in lengths
        ]
        expected = torch.cat([p if r is None else p[r] for p, r in zip(joined, rows, strict=True)])
    storage = JoinedStorage(joined, rows)
    total = len(expected)
    assert len(storage) == total
    assert (storage[:] == expected).all()
    assert torch.equal(storage.column("y"), expected["y"])
    assert torch.equal(storage.column(("next", "done")), expected["next", "done"])
    if not total:
        return
    assert torch.equal(storage.part(), expected["x"] // 100)
    index = torch.tensor(data.draw(st.lists(st.integers(-total, total - 1), max_size=60)), dtype=torch.int64)
    mask = torch.tensor(data.draw(st.lists(st.booleans(), min_size=total, max_size=total)))
    for at in (index, index.tolist(), index[:, None], mask, slice(1, None, 2), slice(-3, None)):
        found, wanted = storage[at], expected[torch.arange(total)[at]]
        assert found.batch_size == wanted.batch_size
        assert (found == wanted).all()
    one = storage[-1]
    assert one.batch_size == ()
    assert (one == expected[-1]).all()
    for outside in (total, -total - 1):
        with pytest.raises(IndexError):
            storage[outside]
        assert outside not in storage
    assert storage.contains(torch.tensor([-total, 0, total - 1, total])).tolist() == [True, True, True, False]


def test_it_shares_the_memory_of_the_parts():
    base, target = parts([5, 3])
    storage = JoinedStorage([base, target], [torch.tensor([4, 1]), None])
    base["y"][1] = 77
    target["x"][2] = 9
    assert storage[1]["y"].tolist() == [77, 77]
    assert storage[-1]["x"] == 9


def test_a_batch_is_the_callers():
    base = part(6)
    for at in (slice(None), [0, 1], 0):
        storage = JoinedStorage([base])
        storage[at]["x"].fill_(-5)
        storage[at]["next"].fill_("done", False)
    assert base["x"].tolist() == list(range(6))
    assert bool(base["next", "done"].any())


def test_nothing_can_be_written():
    storage = JoinedStorage(parts([3, 2]))
    replay = TensorDictReplayBuffer(storage=storage, collate_fn=lambda batch: batch, batch_size=2)
    for write in (
        lambda: storage.set(0, part(1)),
        lambda: storage.__setitem__(0, part(1)),
        lambda: replay.extend(part(2)),
        replay.empty,
    ):
        with pytest.raises(RuntimeError, match="read-only"):
            write()
    assert (storage[:] == torch.cat(parts([3, 2]))).all()


def test_its_state_is_its_length(tmp_path):
    storage, other = JoinedStorage(parts([3, 2])), JoinedStorage(parts([3, 3]))
    assert storage.state_dict() == {"length": 5}
    storage.load_state_dict(storage.state_dict())
    storage.dumps(tmp_path / "storage")
    storage.loads(tmp_path / "storage")
    for restore in (lambda: other.load_state_dict({"length": 5}), lambda: other.loads(tmp_path / "storage")):
        with pytest.raises(ValueError, match="state_dict must be of 6 rows, got one of 5"):
            restore()


def test_torchrls_own_samplers_work_on_it():
    def replay(sampler):
        return TensorDictReplayBuffer(
            storage=JoinedStorage(parts([6, 9])),
            sampler=sampler,
            writer=ImmutableDatasetWriter(),
            collate_fn=lambda batch: batch,
            batch_size=6,
        )

    whole = replay(SamplerWithoutReplacement(drop_last=False))
    seen = torch.cat([whole.sample()["x"] for _ in range(3)]).tolist()
    assert sorted(seen) == [*range(6), *range(100, 109)]
    slices = replay(SliceSampler(slice_len=3, traj_key="third", cache_values=True)).sample()["x"].view(2, 3)
    assert (slices.diff(dim=1) == 1).all()


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        (([],), ValueError, "parts must hold at least one tensordict"),
        ((parts([2, 2]), [None, torch.tensor([2])]), IndexError, r"rows\[1\] must be in \[0, 2\)"),
        (([part(2), part(2).exclude("y")],), ValueError, r"parts\[1\] must have the columns of parts\[0\].* in y$"),
        (
            ([part(2), part(2).set("y", torch.zeros(2, 3))],),
            ValueError,
            r"column y must be torch.float32 of shape \(2,",
        ),
        (
            ([part(2), part(2).set("x", torch.zeros(2))],),
            ValueError,
            "column x must be torch.int64 .* got torch.float32",
        ),
    ],
)
def test_parts_that_do_not_fit_are_refused(given, error, message):
    with pytest.raises(error, match=message):
        JoinedStorage(*given)
