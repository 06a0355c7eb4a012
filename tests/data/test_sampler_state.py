"""States of samplers that are none, or of other rows: refused by name, and the sampler goes on as it was."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from lw_torchrl.data import CoLearningSampler, JoinedStorage, TaskBalancedSampler
from lw_torchrl.language.tasks import task_id

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


def ints(*numbers):
    return torch.tensor(numbers, dtype=torch.int64)


BAD = {
    "length": [None, "8", -1, 7, 10**30, ints(1, 2), torch.tensor(8.0), torch.tensor(True), True],
    "ran_out": [None, 1, torch.tensor(1), "yes"],
    "order": [
        None,
        [0, 1, 2, 3, 4, 5, 6, 7],
        ints(0, 1, 2, 3, 4, 5, 6, 8),
        ints(0, 1, 2, 3, 4, 5, 6, -1),
        ints(0, 1, 2, 3, 4, 5, 6, 6),
        ints(0, 1, 2, 3, 4, 5, 6),
        ints(),
        torch.arange(8.0),
        torch.arange(8, dtype=torch.int32),
        torch.arange(8)[None],
    ],
    "start": [None, ints(0, 4), ints(0), ints(3, 0), ints(0, -3), torch.tensor([0.0, 3.0])],
    "size": [None, ints(3, 6), ints(8, 0), ints(-1, 9), ints(2**62, 2**62), ints(), torch.tensor([[3, 5]])],
    "cursor": [None, ints(-1, 0), ints(3, 0), ints(0, 5), ints(0), ints(0, 2**62), torch.tensor([0.0, 1.0])],
}


@pytest.mark.parametrize(("name", "bad"), [(name, bad) for name, values in BAD.items() for bad in values])
def test_a_state_that_is_none_is_refused_and_nothing_changes(name, bad):
    one, other = make(), make()
    state = {**other.sampler.state_dict(), name: bad}
    if bad is None:
        del state[name]
    with pytest.raises(ValueError, match=r"state_dict: (length|ran_out|order|start|size|cursor) must be"):
        one.sampler.load_state_dict(state)
    assert [one.sample()["row"].tolist() for _ in range(4)] == [other.sample()["row"].tolist() for _ in range(4)]


numbers = st.lists(st.integers(-2, 9) | st.integers(-(2**63), 2**63 - 1), max_size=9)


@settings(max_examples=150, deadline=None)
@given(st.dictionaries(st.sampled_from(["order", "start", "size", "cursor"]), numbers), st.integers(-1, 10))
def test_whatever_the_numbers_a_state_is_refused_or_gives_rows_of_its_tasks(changed, length):
    replay = make()
    state = replay.sampler.state_dict() | {key: torch.tensor(value, dtype=int) for key, value in changed.items()}
    try:
        replay.sampler.load_state_dict(state | {"length": torch.tensor(length)})
        batches = [replay.sample() for _ in range(5)]
    except ValueError:
        return
    for batch in batches:
        assert sorted(batch["task_id"].tolist()) == [1, 1, 2, 2]


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ((1, 1, 1, 2, 2, 2, 2), "the storage's 7 rows, got one of 8"),
        ((1, 1, 1, 1, 2, 2, 2, 2), "the storage's rows, got one whose groups are others"),
        ((2, 2, 2, 2, 2, 1, 1, 1), "the storage's rows, got one whose groups are others"),
        ((1, 1, 2, 2, 2, 3, 3, 3), "the storage's rows, got one whose groups are others"),
        ((1, 1, 1, 1, 1, 1, 1, 1), "the storage's rows, got one whose groups are others"),
    ],
)
def test_the_state_of_other_rows_is_refused_at_the_next_batch_and_ever_after(tasks, message):
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


def test_rows_added_after_a_state_was_restored_are_grouped_again():
    sampler = make().sampler
    sampler.load_state_dict(sampler.state_dict())
    sampler.extend(torch.arange(2))
    rows = TensorDict({"task_id": torch.tensor([1, 1, 2, 2, 3, 3])}, [6])
    index, _ = sampler.sample(TensorStorage(rows), 3)
    assert sorted(rows["task_id"][index].tolist()) == [1, 2, 3]


@pytest.mark.parametrize("damage", ["missing", "empty", "short", "flipped", "other", "folder"])
def test_a_damaged_folder_is_refused_and_left_alone(tmp_path, damage):
    replay = make()
    replay.sampler.dumps(tmp_path)
    (file,) = tmp_path.iterdir()
    content = file.read_bytes()
    file.unlink()
    if damage == "folder":
        file.mkdir()
    elif damage != "missing":
        changed = {"empty": b"", "short": content[:-40], "other": b"cos\nsystem\n(S'false'\ntR."}
        file.write_bytes(changed.get(damage, content.replace(b"cursor", b"Cursor")))
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises((ValueError, FileNotFoundError), match=rf"path: '{tmp_path}' holds no sampler's state"):
        replay.sampler.loads(tmp_path)
    assert files == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    assert len(replay.sample()) == 4


@pytest.mark.parametrize("bad", [None, TARGET, 0.5, torch.tensor([0.5]), torch.tensor([1, 2, 3])])
@pytest.mark.parametrize("name", ["target", "target_fraction"])
def test_a_co_learning_state_of_something_else_is_refused(name, bad):
    replay = make((1, 1, 1, 1, *[task_id(TARGET)] * 4), CoLearningSampler(TARGET))
    with pytest.raises(ValueError, match=f"state_dict must be of the same {name}"):
        replay.sampler.load_state_dict(replay.sampler.state_dict() | {name: bad})
    assert len(replay.sample()) == 4


@pytest.mark.parametrize("content", [b"", b"[5]", b'{"length": true}', b'{"length": 1e999}', b'{"length": "1"}', b"{}"])
def test_a_joined_storages_file_that_is_none_is_refused(tmp_path, content):
    storage = JoinedStorage([TensorDict({"x": torch.arange(1)}, [1])])
    (tmp_path / "joined.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"path: .* holds no storage's state"):
        storage.loads(tmp_path)
