"""Whatever is done to rows that a buffer gave, the dataset on disk stays; other processes read the same files."""

from __future__ import annotations

import copy
import pickle

import pytest
import torch
import torch.multiprocessing as mp
from collecting import collect, tree
from torchrl.data import SliceSampler

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.data.dataset import MappedColumn, load_rows, read_metadata

KINDS = {
    "expert": {},
    "unclipped": dict(label="unclipped"),
    "executed": dict(label="executed", reward="dense"),
    "cut": dict(label="executed", after_success=3),
    "chosen": dict(episodes=2),
    "n steps": dict(label="executed", n_steps=3, gamma=0.9),
}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos").root


def open_replay(root, kind="expert", **options):
    given = dict(batch_size=8, generator=torch.Generator().manual_seed(0))
    return LanguageWorldExperienceReplay(root, **{**given, **KINDS[kind], **options})


WAYS = {
    "all": lambda replay: replay[:],
    "a row": lambda replay: replay[3],
    "rows": lambda replay: replay[torch.tensor([1, 5])],
    "a batch": lambda replay: replay.sample(),
    "iteration": lambda replay: next(iter(replay)),
    "the storage, all": lambda replay: replay.storage[:],
    "a column": lambda replay: replay.storage[:].select("observation"),
}


@pytest.mark.filterwarnings("ignore:Got conflicting batch_sizes")
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("way", WAYS)
def test_what_is_written_to_rows_stays_in_memory(root, kind, way):
    before = tree(root)
    rows = WAYS[way](open_replay(root, kind))
    for _, leaf in rows.items(True, True):
        leaf.fill_(1)
    rows.zero_()
    assert all((leaf == 0).all() for leaf in rows.values(True, True))
    assert tree(root) == before
    assert open_replay(root, kind)[:]["observation"].any(), "another buffer shows the files"


@pytest.mark.parametrize("kind", KINDS)
def test_rows_are_not_assigned_to(root, kind):
    replay, before = open_replay(root, kind), tree(root)
    rows, row = replay[:], replay[0]
    for index in (0, slice(None), "observation", [0, 1], torch.tensor([2]), (0,)):
        with pytest.raises(RuntimeError, match=r"a dataset's rows are read-only; .* add_column"):
            replay[index] = row
    storage = replay.storage
    for write in (
        lambda: storage.set(0, row),
        lambda: storage.set(slice(None), rows, set_cursor=False),
        lambda: storage.__setitem__(0, row),
    ):
        with pytest.raises(RuntimeError, match="read-only"):
            write()
    for write in (lambda: replay.extend(rows), lambda: replay.add(row), replay.empty, storage._empty):
        with pytest.raises(RuntimeError, match=r"read-only|doesn't allow writing"):
            write()
    patch = dict(index=torch.tensor([0]), generation=torch.tensor([0]), patch={"observation": torch.zeros(1, 39)})
    with pytest.raises(RuntimeError):
        replay.update_if_present(**patch)
    assert tree(root) == before
    assert (replay[:] == rows).all()


def _sum(replay, queue):
    """In another process: what it reads of the buffer, and a write to what it was given."""
    rows = replay[:]
    total = float(rows["observation"].double().sum()), float(replay.sample()["action"].double().sum())
    rows.zero_()
    queue.put((*total, [type(leaf).__name__ for leaf in replay.storage[:].values(True, True)]))


@pytest.mark.parametrize("kind", ["expert", "executed"])
@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_other_processes_read_the_files_themselves(root, kind, start):
    before, replay = tree(root), open_replay(root, kind, generator=None)  # TorchRL 0.14.1 spawns none with a generator
    context = mp.get_context(start)
    queue = context.Queue()
    process = context.Process(target=_sum, args=(replay, queue))
    process.start()
    total, batch, kinds = queue.get(timeout=60)
    process.join()
    assert process.exitcode == 0
    assert total == float(replay[:]["observation"].double().sum())
    assert batch != 0.0
    assert "MappedColumn" in kinds
    assert tree(root) == before


@pytest.mark.parametrize("kind", ["expert", "executed"])
def test_a_copy_of_a_buffer_is_small_and_maps_the_same_files(root, kind, tmp_path, monkeypatch):
    replay = open_replay(root, kind, sampler=TaskBalancedSampler())
    packed = pickle.dumps(replay)
    assert len(packed) < 20_000
    monkeypatch.chdir(tmp_path)
    for again in (pickle.loads(packed), copy.deepcopy(replay)):
        assert (again[:] == replay[:]).all()
        before = tree(root)
        again[:].zero_()
        assert tree(root) == before


def test_columns_compute_plain_tensors(root):
    column = load_rows(read_metadata(root))["observation"]
    assert type(column) is MappedColumn
    for made in (column + 1, column[3], column[1:4], column.index_select(0, torch.tensor([1])), column.double()):
        assert type(made) is torch.Tensor
    assert column[2:4].data_ptr() == column.data_ptr() + 2 * 39 * 4


def test_slices_of_a_whole_dataset_are_not_copied(root):
    replay = open_replay(root, sampler=SliceSampler(slice_len=4, traj_key=("collector", "traj_ids")))
    assert replay[:]["observation"].data_ptr() == replay[0:1]["observation"].data_ptr()
    assert len(replay.sample()) == 8
