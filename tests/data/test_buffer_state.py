"""The saved state of a buffer: sampler and generator, no rows of datasets, and no pickles."""

from __future__ import annotations

import os
import pickle

import pytest
import torch
from collecting import collect, tree
from tensordict import TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import RandomSampler, SamplerWithoutReplacement

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler

KINDS = {
    "plain": {},
    "cut": dict(after_success=3),
    "joined": dict(episodes=2),
    "n steps": dict(label="executed", n_steps=3, gamma=0.9),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos").root


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """As many rows, of another seed."""
    return collect(tmp_path_factory.mktemp("other") / "demos", seed=6).root


def open_replay(root, kind="plain", sampler=RandomSampler, seed=0, **options):
    generator = torch.Generator().manual_seed(seed)
    defaults = dict(batch_size=8, sampler=sampler(), generator=generator)
    return LanguageWorldExperienceReplay(root, **{**defaults, **KINDS[kind], **options})


def drawn(replay, batches=4):
    return torch.cat([replay.sample() for _ in range(batches)])


@pytest.mark.parametrize("kind", ["plain", "cut", "joined", "n steps"])
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement])
@pytest.mark.parametrize("prefetch", [None, 1])
def test_a_restored_buffer_gives_the_same_batches(made, tmp_path, kind, sampler, prefetch):
    replay = open_replay(made, kind, sampler, prefetch=prefetch)
    drawn(replay)
    replay.dumps(tmp_path / "saved")
    assert len(list((tmp_path / "saved").iterdir())) == 1
    expected = drawn(replay, 20)
    again = open_replay(made, kind, sampler, seed=9, prefetch=prefetch)
    drawn(again, 3)
    again.loads(tmp_path / "saved")
    batches = drawn(again, 20)
    assert type(batches) is TensorDict
    assert (batches == expected).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_of_other_rows_is_refused_and_neither_dataset_changes(made, other, tmp_path, kind):
    replay = open_replay(other, kind)
    replay.dumps(tmp_path / "saved")
    before = tree(made), tree(other)
    mine = open_replay(made, kind)
    with pytest.raises(ValueError, match="of the rows that this buffer shows"):
        mine.loads(tmp_path / "saved")
    with pytest.raises(ValueError, match="state_dict must be of the rows that this buffer shows, got one of other"):
        mine.load_state_dict(replay.state_dict())
    assert (tree(made), tree(other)) == before
    assert len(drawn(mine)) == 32


def test_torchrls_checkpoint_of_a_buffer_unpickles_nothing(made, tmp_path):
    replay = open_replay(made)
    Checkpoint(replay=replay).save(tmp_path / "checkpoint")
    expected = drawn(replay)
    again = open_replay(made, seed=7)
    Checkpoint(replay=again).load(tmp_path / "checkpoint")
    assert (drawn(again) == expected).all()
    assert not [path for path in (tmp_path / "checkpoint").rglob("*") if path.suffix in (".pkl", ".pickle", ".pt")]


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return (os.mkdir, (self.trace,))


def test_planted_pickles_are_never_executed(made, tmp_path):
    folder, trace = tmp_path / "saved", tmp_path / "executed"
    replay = open_replay(made)
    replay.dumps(folder)
    names = [path.name for path in folder.iterdir()] + ["prefetch.pkl", "other.pickle", "transform.t"]
    for name in names:
        (folder / name).write_bytes(pickle.dumps(Evil(trace)))
    with pytest.raises(ValueError, match=f"path: '{folder}' holds no"):
        replay.loads(folder)
    assert not trace.exists()
