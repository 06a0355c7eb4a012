"""What a buffer saves and restores: its sampler and what came, no row of a dataset, and nothing that is unpickled."""

from __future__ import annotations

import os
import pickle
import shutil
from pathlib import Path

import pytest
import torch
from collecting import collect, tree
from tensordict import NonTensorData, TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import RandomSampler, ReplayBuffer, SamplerWithoutReplacement, SliceSampler

from lw_torchrl.data import CoLearningSampler, LanguageWorldExperienceReplay, TaskBalancedSampler

KINDS = {
    "plain": {},
    "cut": dict(after_success=3),
    "joined": dict(episodes=2),
    "n steps": dict(label="executed", n_steps=3, gamma=0.9),
    "growing": dict(label="executed", grow=20),
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
    given = dict(batch_size=8, sampler=sampler(), generator=generator)
    return LanguageWorldExperienceReplay(root, **{**given, **KINDS[kind], **options})


def drawn(replay, batches=4):
    return torch.cat([replay.sample() for _ in range(batches)])


class Evil:
    """Unpickled, it makes a folder."""

    def __init__(self, trace):
        self.trace = str(trace)

    def __reduce__(self):
        return (os.mkdir, (self.trace,))


def plant(folder, trace):
    """What TorchRL's loaders unpickle, wherever they look for it."""
    evil = Evil(trace)
    for name in ("", "storage", "sampler", "writer", "rng_state", "storage/nested"):
        rows = TensorDict({"x": torch.zeros(3)}, [3])
        rows["note"] = NonTensorData(evil, batch_size=[3])
        rows.memmap(folder / name)
    for name in (
        "prefetch.pkl",
        "other.pickle",
        "transform.t",
        "buffer.zip",
        "sampler.zip",
        "joined.json",
        "grown.zip",
    ):
        for place in (folder, folder / "storage", folder / "sampler", folder / "writer"):
            (place / name).write_bytes(pickle.dumps(evil))
    (folder / "buffer_metadata.json").write_text('{"batch_size": 8}')
    assert list((folder / "storage").rglob("note/other.pickle")), "the test wants a pickle"
    assert not trace.exists()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement, SliceSampler])
def test_a_hostile_folder_runs_no_code_and_is_named(made, tmp_path, kind, sampler):
    folder, trace = tmp_path / "saved", tmp_path / "executed"
    plant(folder, trace)
    options = dict(slice_len=4, traj_key=("collector", "traj_ids")) if sampler is SliceSampler else {}
    replay = open_replay(made, kind, lambda: sampler(**options))
    before = tree(made), replay[:]
    readers = [replay.loads, replay.load, replay.storage.loads, replay.storage.load]
    if sampler is TaskBalancedSampler:
        readers.append(replay.sampler.loads)
    for read in readers:
        for place in (folder, folder / "storage", folder / "sampler"):
            with pytest.raises((ValueError, FileNotFoundError), match=f"path: '{place}' holds no"):
                read(place)
            (place / "buffer.zip").unlink(missing_ok=True)  # the second time, there is nothing of ours
    replay.writer.loads(folder / "writer")
    assert not trace.exists()
    assert tree(made) == before[0]
    assert (replay[:] == before[1]).all()
    assert len(replay.sample()) == 8


def test_the_planted_files_run_code_where_they_are_read(tmp_path):
    """By TorchRL's own loader; else the test above would show nothing."""
    plant(tmp_path / "saved", tmp_path / "executed")
    with pytest.raises(NotImplementedError):  # it fails after the harm is done
        ReplayBuffer().loads(tmp_path / "saved")
    assert (tmp_path / "executed").exists()


def test_torchrls_checkpoint_of_a_buffer_unpickles_nothing(made, tmp_path):
    replay = open_replay(made)
    Checkpoint(replay=replay).save(tmp_path / "checkpoint")
    expected = drawn(replay)
    (place,) = (path.parent for path in (tmp_path / "checkpoint").rglob("buffer.zip"))
    other = open_replay(made, seed=7)
    Checkpoint(replay=other).load(tmp_path / "checkpoint")
    assert (drawn(other) == expected).all()
    assert not [path for path in (tmp_path / "checkpoint").rglob("*") if path.suffix in (".pkl", ".pickle", ".pt")]
    shutil.rmtree(place)
    plant(place, tmp_path / "executed")
    with pytest.raises(Exception, match="holds no buffer's state"):
        Checkpoint(replay=other).load(tmp_path / "checkpoint")
    assert not (tmp_path / "executed").exists()


@pytest.mark.parametrize("kind", ["plain", "cut", "joined", "n steps"])
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, RandomSampler, SamplerWithoutReplacement])
@pytest.mark.parametrize("prefetch", [None, 1])
def test_restored_it_gives_the_batches_that_would_have_come(made, tmp_path, kind, sampler, prefetch):
    replay = open_replay(made, kind, sampler, prefetch=prefetch)
    drawn(replay)
    replay.dumps(tmp_path / "saved")
    assert [path.name for path in (tmp_path / "saved").iterdir()] == ["buffer.zip"]
    expected = drawn(replay, 20)
    again = open_replay(made, kind, sampler, seed=9, prefetch=prefetch)
    drawn(again, 3)
    again.loads(tmp_path / "saved")
    found = drawn(again, 20)
    assert type(found) is TensorDict
    assert (found == expected).all()


@pytest.mark.parametrize("kind", KINDS)
def test_a_state_of_other_rows_is_refused_and_neither_dataset_changes(made, other, tmp_path, kind):
    replay = open_replay(other, kind)
    replay.dumps(tmp_path / "saved")
    before = tree(made), tree(other)
    mine = open_replay(made, kind)
    rows = mine[:]
    with pytest.raises(ValueError, match=f"path: '{tmp_path}/saved' .*of the rows that this buffer shows"):
        mine.loads(tmp_path / "saved")
    with pytest.raises(ValueError, match="state_dict must be of the rows that this buffer shows, got one of others"):
        mine.load_state_dict(replay.state_dict())
    assert (tree(made), tree(other)) == before
    assert (mine[:] == rows).all()
    assert (drawn(mine) == drawn(open_replay(made, kind))).all() if kind != "growing" else True


@pytest.mark.parametrize("kind", ["plain", "cut", "joined", "growing"])
def test_no_storage_takes_rows_from_a_state_of_any_kind(made, other, kind):
    """TorchRL's tensor storages copy a state's rows into their own: here, into the files."""
    storage, before = open_replay(made, kind).storage, tree(made)
    rows = storage[:]
    foreign = {"_storage": open_replay(other)[:].state_dict(), "initialized": True, "_len": len(storage)}
    for state in (foreign, foreign | {"length": len(storage) + 1}):
        with pytest.raises(ValueError, match="state_dict must be of"):
            storage.load_state_dict(state)
    assert tree(made) == before
    assert (storage[:] == rows).all()


@pytest.mark.parametrize(
    "change",
    [
        dict(_batch_size=0),
        dict(_batch_size="8"),
        dict(_batch_size=True),
        dict(_storage={"length": 3}),
        dict(_storage=None),
        dict(_sampler={"length": 3}),
        dict(_transforms={"more": torch.zeros(3)}),
        dict(_rng=(torch.zeros(3, dtype=torch.uint8), "cpu")),
        dict(_rng=(torch.zeros(3, dtype=torch.uint8), "nowhere")),
        dict(_rng=5),
        dict(_prefetch_state={"version": 1, "capacity": 10**9, "queue": []}),
        dict(_prefetch_state=7),
        dict(rows=None),
    ],
    ids=repr,
)
@pytest.mark.parametrize("sampler", [TaskBalancedSampler, SamplerWithoutReplacement])
def test_a_state_that_is_none_is_refused_and_sampling_goes_on(made, tmp_path, change, sampler):
    replay, undisturbed = open_replay(made, sampler=sampler), open_replay(made, sampler=sampler)
    drawn(replay), drawn(undisturbed)
    generator = replay._rng
    if sampler is SamplerWithoutReplacement and "_sampler" in change:
        change = dict(_sampler={})
    with pytest.raises(ValueError, match="state"):
        replay.load_state_dict(replay.state_dict() | change)
    assert replay._rng is generator
    assert (drawn(replay) == drawn(undisturbed)).all()
    assert replay.batch_size == 8


def test_a_state_that_lacks_a_part_is_refused(made):
    replay = open_replay(made)
    for name in replay.state_dict():
        state = replay.state_dict()
        del state[name]
        if name in ("_batch_size", "_consume_after_n_samples", "_rng", "_prefetch_state"):
            continue
        with pytest.raises(ValueError, match="state_dict"):
            replay.load_state_dict(state)


def test_one_that_grows_takes_its_rows_from_the_state_and_its_demonstrations_from_the_dataset(made, tmp_path):
    def grown():
        return open_replay(made, "growing", lambda: CoLearningSampler("grown"))

    replay = grown()
    rows = replay[:10].exclude("behaviour", "index")
    replay.extend(rows)
    replay.dumps(tmp_path)
    again = grown()
    again.loads(tmp_path)
    assert (again[:] == replay[:]).all()
    for name, bad in {"observation": torch.nan, "action": 1e30}.items():
        state = replay.state_dict()
        state["_storage"]["rows"][name][3] = bad
        with pytest.raises(ValueError, match=rf"state_dict: rows\['{name}'\] must be"):
            grown().load_state_dict(state)
    assert Path(tmp_path, "buffer.zip").stat().st_size < 30_000
