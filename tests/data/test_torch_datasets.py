"""Rows and windows of a buffer through PyTorch's ``DataLoader``."""

from __future__ import annotations

import pytest
import torch
from exchanged import random_dataset
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

import lw_torchrl as lw
from lw_torchrl.data import RowDataset, WindowDataset

LENGTHS = ((5, 3), (4, 9))


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    made = random_dataset(tmp_path_factory.mktemp("rows") / "demos", LENGTHS)
    return lw.LanguageWorldExperienceReplay(
        made.root, label="executed", transform=lw.QAFTransform(lw.load_plans("MT10"))
    )


def test_rows_are_those_of_the_buffer(replay):
    keys = ["observation", "action", "qaf", "next.reward", "task"]
    batches = list(DataLoader(RowDataset(replay, keys=keys), batch_size=8))
    assert [len(batch["action"]) for batch in batches] == [8, 8, 5]
    assert [*batches[0]] == keys
    every = replay[:]
    for key, own in (("observation", "observation"), ("qaf", "qaf"), ("next.reward", ("next", "reward"))):
        assert torch.equal(torch.cat([batch[key] for batch in batches]), every[own])
    told = [text for batch in batches for text in batch["task"]]
    assert told == 8 * [lw.TASKS["drawer-open"].description] + 13 * [lw.TASKS["push"].description]


@pytest.mark.parametrize("workers", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_loader_shuffles_and_has_workers(replay, workers):
    how = {"shuffle": True, "num_workers": workers, "generator": torch.Generator()}
    loader = DataLoader(RowDataset(replay), batch_size=6, **how)
    found = torch.cat([batch["observation"] for batch in loader])
    assert sorted(found[:, 0].tolist()) == sorted(replay[:]["observation"][:, 0].tolist())


@pytest.mark.parametrize("size", [1, 7])
def test_a_buffer_itself_goes_into_a_loader(replay, size):
    """It ended in "generator raised StopIteration"."""
    batches = list(DataLoader(replay, batch_size=size))
    assert torch.equal(torch.cat([batch["action"] for batch in batches]), replay[:]["action"])
    assert torch.equal(torch.cat([batch["next.observation"] for batch in batches]), replay[:]["next", "observation"])


@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_windows_stay_in_their_episode(replay, data):
    length = data.draw(st.integers(1, 12))
    past, row = data.draw(st.integers(0, length - 1)), data.draw(st.integers(0, 20))
    found = WindowDataset(replay, length, past=past, keys=("observation", "action", "task"))[row]
    every, first, last = replay[:], 0, -1
    for steps in sum(LENGTHS, ()):
        first, last = last + 1, last + steps
        if first <= row <= last:
            break
    for place in range(length):
        asked = row + place - past
        own = min(max(asked, first), last)
        assert torch.equal(found["observation"][place], every["observation"][own])
        assert torch.equal(found["action"][place], every["action"][own])
        assert bool(found["is_pad"][place]) == (own != asked)
    assert found["task"] in (lw.TASKS["drawer-open"].description, lw.TASKS["push"].description)


def test_windows_in_batches(replay):
    batch = next(iter(DataLoader(WindowDataset(replay, 4, past=1), batch_size=21)))
    assert batch["observation"].shape == (21, 4, 39)
    assert batch["is_pad"].sum(1).tolist()[:5] == [1, 0, 0, 1, 2]
    assert torch.equal(batch["action"][:, 1], replay[:]["action"])


def test_what_is_refused(replay):
    with pytest.raises(ValueError, match=r"keys must be one of .*, got 'reward'; did you mean 'next.reward'"):
        RowDataset(replay, keys=["reward"])
    with pytest.raises(ValueError, match="past must be below length, 4, got 4"):
        WindowDataset(replay, 4, past=4)
    with pytest.raises(IndexError, match="rows are 0 to 20, got 21"):
        RowDataset(replay)[21]
    growing = lw.LanguageWorldExperienceReplay(replay.roots, label="executed", grow=4)
    with pytest.raises(ValueError, match="replay must not grow"):
        RowDataset(growing)
