"""A dataset on disk: errors for unfinished and damaged ones, files that never change, pickles that never run."""

import copy
import json
import os
import pickle
import shutil
from functools import partial

import numpy as np
import pytest
import torch
import torch.multiprocessing as mp
from collecting import EPISODES, KINDS, STEPS, TASKS, Evil, collect, open_replay, tree
from tensordict import NonTensorData, TensorDict
from torchrl.data import SliceSampler

from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay, TaskBalancedSampler
from lw_torchrl.data import dataset as module
from lw_torchrl.data.dataset import COLUMNS, FORMAT, MappedColumn, load_rows

ALL = [(task, episode) for task in TASKS for episode in range(EPISODES)]
DAMAGED = "metadata.json' is corrupted .*; delete the folder"


@pytest.fixture
def root(dataset, tmp_path):
    """A copy of the dataset to damage."""
    return shutil.copytree(dataset.root, tmp_path / "demos")


def check_error(root, message):
    """Check that opening raises an error that names the folder, and that no file changes."""
    before = tree(root)
    with pytest.raises(DatasetError, match=message) as caught:
        LanguageWorldExperienceReplay(root)
    assert tree(root) == before
    assert str(root) in str(caught.value)


def test_tensordict_reads_the_rows_and_writes_the_same_files(dataset, tmp_path):
    rows = TensorDict.load_memmap(dataset.root / "data")
    assert (rows == load_rows(dataset)).all()
    rows.clone().memmap(tmp_path / "again")
    assert tree(tmp_path / "again") == tree(dataset.root / "data")


def test_unfinished_and_other_folders_are_errors(root):
    (root / "metadata.json").unlink()
    check_error(root, "is not a dataset")
    (root / ".partial").mkdir()
    check_error(root, "unfinished")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda metadata: metadata.update(version=9), f"{FORMAT!r} version 9.*reads {FORMAT!r} version"),
        (lambda metadata: metadata.update(format="minari"), f"format 'minari' version.*reads {FORMAT!r} version"),
        (lambda metadata: metadata.pop("config"), DAMAGED),
        (lambda metadata: metadata["config"].update(colour="red"), DAMAGED),
        (lambda metadata: metadata["episodes"]["length"].pop(), DAMAGED),
        (lambda metadata: metadata["episodes"].update(start=[None] * 6), DAMAGED),
        (lambda metadata: metadata["episodes"]["length"].__setitem__(0, STEPS - 1), DAMAGED),
    ],
)
def test_damaged_metadata_and_other_formats_are_errors(root, change, message):
    path = root / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))
    check_error(root, message)


def test_a_column_of_another_size_is_an_error(root):
    path = root / "data" / "next" / "observation.memmap"
    content = path.read_bytes()
    for damaged in (content[:-8], content + bytes(8), b""):
        path.write_bytes(damaged)
        check_error(root, "the rows in .* are corrupted")
    path.unlink()
    check_error(root, "the rows in .* are corrupted")


@pytest.mark.parametrize("name", ["/".join(key) for key in COLUMNS])
def test_every_changed_bit_of_a_column_is_found(root, name):
    path, draws = root / "data" / f"{name}.memmap", np.random.default_rng(sum(name.encode()))
    content = path.read_bytes()
    for at in {0, len(content) - 1, *draws.integers(len(content), size=4).tolist()}:
        changed = bytearray(content)
        changed[at] ^= 1 << int(draws.integers(8))
        path.write_bytes(changed)
        task, episode = ALL[at // (len(content) // len(ALL))]
        with pytest.raises(DatasetError, match=f"episode {episode} of {task!r} differs from its checksum"):
            LanguageWorldExperienceReplay(root, label="executed", n_steps=2, gamma=0.9)
    with pytest.raises(DatasetError, match="differs from its checksum"):
        collect(root)
    assert len(LanguageWorldExperienceReplay(root, check=False)) == len(ALL) * STEPS
    path.write_bytes(content)
    LanguageWorldExperienceReplay(root).verify()


def test_limits_of_the_system_are_not_called_damage(dataset, monkeypatch):
    def no_files(*_):
        raise OSError(24, "Too many open files")

    monkeypatch.setattr(module.np, "memmap", no_files)
    with pytest.raises(OSError, match="Too many open files"):
        load_rows(dataset)


def test_only_the_selected_episodes_are_checked(root):
    path = root / "data" / "action.memmap"
    path.write_bytes(b"\1\2\3\4" + path.read_bytes()[4:])
    LanguageWorldExperienceReplay(root, episodes={"push": [1, 2], "reach": 1}).verify()
    with pytest.raises(DatasetError, match="0 of 'push'"):
        LanguageWorldExperienceReplay([root], episodes=[{"push": 1}])
    with pytest.raises(DatasetError, match="differs from its checksum"):
        LanguageWorldExperienceReplay(root, check=False).load_state_dict({})


def test_checksums_are_compared_once_while_the_files_do_not_change(root, monkeypatch):
    checked, describe = [], module.describe_episode
    monkeypatch.setattr(module, "describe_episode", lambda *args: checked.append(args[1]) or describe(*args))
    for _ in range(3):
        LanguageWorldExperienceReplay(root, label="executed").verify()
    assert len(checked) == len(ALL)
    os.utime(root / "data" / "action.memmap", ns=(0, 0))
    LanguageWorldExperienceReplay(root, episodes={"push": [1]})
    assert len(checked) == len(ALL) + 1


def test_a_pickle_among_the_rows_is_never_executed(root, tmp_path):
    marker = tmp_path / "executed"
    rows = TensorDict.load_memmap(root / "data").clone()
    rows["note"] = NonTensorData(Evil(marker), batch_size=rows.batch_size)
    shutil.rmtree(root / "data")
    rows.memmap(root / "data")
    assert list((root / "data").rglob("*.pickle")), "the test needs a pickle"
    assert "note" not in LanguageWorldExperienceReplay(root)[:]
    assert not marker.exists()
    TensorDict.load_memmap(root / "data", allow_pickle=True)["note"]
    assert marker.exists(), "the pickle would have been executed"


def test_an_action_that_is_not_finite_is_an_error(root):
    path = root / "data" / "expert_action.memmap"
    path.write_bytes(np.full(path.stat().st_size // 4, np.nan, dtype=np.float32).tobytes())
    with pytest.raises(DatasetError, match="action that is NaN or infinite"):
        LanguageWorldExperienceReplay(root, check=False)


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
def test_writes_to_rows_stay_in_memory(dataset, kind, way):
    before = tree(dataset.root)
    rows = WAYS[way](open_replay(dataset.root, kind))
    for _, leaf in rows.items(True, True):
        leaf.fill_(1)
    rows.zero_()
    assert all((leaf == 0).all() for leaf in rows.values(True, True))
    assert tree(dataset.root) == before
    assert open_replay(dataset.root, kind)[:]["observation"].any(), "another buffer shows the files"


@pytest.mark.parametrize("kind", KINDS)
def test_assigning_rows_is_an_error(dataset, kind):
    replay, before = open_replay(dataset.root, kind), tree(dataset.root)
    rows, row = replay[:], replay[0]
    for index in (0, slice(None), "observation", [0, 1], torch.tensor([2]), (0,)):
        with pytest.raises(RuntimeError, match="read-only"):
            replay[index] = row
    storage, patch = replay.storage, {"observation": torch.zeros(1, 39)}
    writes = [(storage.set, 0, row), (storage.__setitem__, 0, row), (replay.extend, rows), (replay.add, row)]
    writes += [(partial(storage.set, set_cursor=False), slice(None), rows), (replay.empty,), (storage._empty,)]
    first = {"index": torch.tensor([0]), "generation": torch.tensor([0])}
    for write, *values in (*writes, (partial(replay.update_if_present, **first, patch=patch),)):
        with pytest.raises(RuntimeError, match=r"read-only|doesn't allow writing|generation"):
            write(*values)
    assert tree(dataset.root) == before
    assert (replay[:] == rows).all()


def _sum(replay, queue):
    """Read the buffer in another process, and write to the rows."""
    rows = replay[:]
    total, batch = rows["observation"].double().sum().item(), replay.sample()["action"].abs().sum().item()
    rows.zero_()
    queue.put((total, batch, type(replay.storage[:]["observation"]).__name__))


@pytest.mark.parametrize("kind", ["expert", "executed"])
@pytest.mark.parametrize("start", ["fork", pytest.param("spawn", marks=pytest.mark.slow)])
def test_other_processes_map_the_files_again(dataset, kind, start):
    before = tree(dataset.root)
    replay = open_replay(dataset.root, kind, generator=None)  # TorchRL 0.14.1 cannot spawn a buffer with a generator
    context = mp.get_context(start)
    queue = context.Queue()
    process = context.Process(target=_sum, args=(replay, queue))
    process.start()
    total, batch, kind = queue.get(timeout=60)
    process.join()
    assert process.exitcode == 0
    assert total == replay[:]["observation"].double().sum().item()
    assert batch > 0.0
    assert kind == "MappedColumn"
    assert tree(dataset.root) == before


@pytest.mark.parametrize("kind", ["expert", "executed"])
def test_a_copy_of_a_buffer_is_small_and_maps_the_same_files(dataset, kind, tmp_path, monkeypatch):
    replay = open_replay(dataset.root, kind, sampler=TaskBalancedSampler())
    packed = pickle.dumps(replay)
    assert len(packed) < 20_000
    monkeypatch.chdir(tmp_path)
    for again in (pickle.loads(packed), copy.deepcopy(replay)):
        assert (again[:] == replay[:]).all()
        before = tree(dataset.root)
        again[:].zero_()
        assert tree(dataset.root) == before


def test_operations_on_columns_give_plain_tensors(dataset):
    column = load_rows(dataset)["observation"]
    assert type(column) is MappedColumn
    for result in (column + 1, column[3], column[1:4], column.index_select(0, torch.tensor([1])), column.double()):
        assert type(result) is torch.Tensor
    assert column[2:4].data_ptr() == column.data_ptr() + 2 * 39 * 4


def test_slices_of_a_whole_dataset_are_not_copied(dataset):
    replay = open_replay(dataset.root, sampler=SliceSampler(slice_len=4, traj_key=("collector", "traj_ids")))
    assert replay[:]["observation"].data_ptr() == replay[0:1]["observation"].data_ptr()
    assert len(replay.sample()) == 8
