"""A dataset's folder: errors for unfinished and damaged ones, files that stay as they are, pickles that never run."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
from collecting import EPISODES, STEPS, TASKS, collect, tree
from tensordict import NonTensorData, TensorDict

from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay
from lw_torchrl.data.dataset import COLUMNS, FORMAT, FORMAT_VERSION, load_rows, read_metadata

ALL = [(task, episode) for task in TASKS for episode in range(EPISODES)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


@pytest.fixture
def root(made, tmp_path):
    """A copy to damage."""
    return shutil.copytree(made.root, tmp_path / "demos")


def refuse(root, message):
    """Expect an error that names the folder, and no change on disk."""
    before = tree(root)
    with pytest.raises(DatasetError, match=message) as caught:
        LanguageWorldExperienceReplay(root)
    assert tree(root) == before
    assert str(root) in str(caught.value)


def edit(root, change):
    path = root / "metadata.json"
    metadata = json.loads(path.read_text())
    change(metadata)
    path.write_text(json.dumps(metadata))


def test_the_description_reads_back(made):
    again = read_metadata(made.root)
    assert again == made
    assert again.attempts == dict.fromkeys(TASKS, EPISODES)
    assert load_rows(again).batch_size == (len(ALL) * STEPS,)


def test_tensordict_reads_the_rows_and_would_have_written_the_same(made, tmp_path):
    rows = TensorDict.load_memmap(made.root / "data")
    assert (rows == load_rows(made)).all()
    rows.clone().memmap(tmp_path / "again")
    assert tree(tmp_path / "again") == tree(made.root / "data")


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"root: no dataset folder .*nowhere.*collect_demonstrations"):
        LanguageWorldExperienceReplay(tmp_path / "nowhere")


def test_unfinished_and_other_folders(root):
    (root / "metadata.json").unlink()
    refuse(root, "is not a dataset: it has no metadata.json")
    (root / ".partial").mkdir()
    refuse(root, "unfinished; the same collect_demonstrations resumes it")


@pytest.mark.parametrize(("format", "number"), [(FORMAT, FORMAT_VERSION + 1), ("minari", FORMAT_VERSION)])
def test_another_format_or_version_is_named(root, format, number):
    edit(root, lambda metadata: metadata.update(format=format, version=number))
    refuse(root, f"format {format!r} version {number}.*reads {FORMAT!r} version {FORMAT_VERSION}")


@pytest.mark.parametrize(
    "change",
    [
        lambda metadata: metadata.pop("config"),
        lambda metadata: metadata["config"].update(colour="red"),
        lambda metadata: metadata["episodes"]["length"].pop(),
        lambda metadata: metadata["episodes"].update(start=[None] * 6),
        lambda metadata: metadata["episodes"]["length"].__setitem__(0, STEPS - 1),
    ],
)
def test_damaged_metadata_are_named(root, change):
    edit(root, change)
    refuse(root, "metadata.json' are damaged .*; delete the folder and collect the dataset again")


@pytest.mark.parametrize("damage", ["missing", "truncated", "longer", "empty"])
def test_a_column_of_another_size_is_named(root, damage):
    path = root / "data" / "next" / "observation.memmap"
    content = path.read_bytes()
    path.unlink()
    if damage != "missing":
        path.write_bytes({"truncated": content[:-8], "longer": content + bytes(8), "empty": b""}[damage])
    refuse(root, "the rows in .* are damaged")


@pytest.mark.parametrize("name", ["/".join(key) for key in COLUMNS])
def test_no_bit_of_a_column_changes_unnoticed(root, name):
    path, drawn = root / "data" / f"{name}.memmap", np.random.default_rng(sum(name.encode()))
    content = path.read_bytes()
    for at in {0, len(content) - 1, *drawn.integers(len(content), size=4).tolist()}:
        changed = bytearray(content)
        changed[at] ^= 1 << int(drawn.integers(8))
        path.write_bytes(changed)
        task, episode = ALL[at // (len(content) // len(ALL))]
        with pytest.raises(DatasetError, match=f"episode {episode} of {task!r} differs from its checksum; delete"):
            LanguageWorldExperienceReplay(root, label="executed", n_steps=2, gamma=0.9)
    with pytest.raises(DatasetError, match="differs from its checksum"):
        collect(root)
    assert len(LanguageWorldExperienceReplay(root, check=False)) == len(ALL) * STEPS
    path.write_bytes(content)
    LanguageWorldExperienceReplay(root).verify()


def test_only_the_shown_episodes_are_checked(root):
    path = root / "data" / "action.memmap"
    path.write_bytes(b"\1\2\3\4" + path.read_bytes()[4:])
    LanguageWorldExperienceReplay(root, episodes={"push": [1, 2], "reach": 1}).verify()
    with pytest.raises(DatasetError, match="0 of 'push'"):
        LanguageWorldExperienceReplay([root], episodes=[{"push": 1}])


def test_an_unchanged_dataset_is_read_once_in_a_process(root, monkeypatch):
    read, real = [], memory_map._is_whole
    monkeypatch.setattr(memory_map, "_is_whole", lambda info, rows: read.append(info.episode) or real(info, rows))
    for _ in range(3):
        LanguageWorldExperienceReplay(root, label="executed").verify()
    assert len(read) == len(ALL)
    os.utime(root / "data" / "action.memmap", ns=(0, 0))
    LanguageWorldExperienceReplay(root, episodes={"push": [1]})
    assert len(read) == len(ALL) + 1


def test_a_state_is_not_restored_over_damaged_rows(root, tmp_path):
    LanguageWorldExperienceReplay(root, batch_size=8).dumps(tmp_path / "saved")
    path = root / "data" / "action.memmap"
    path.write_bytes(b"\1\2\3\4" + path.read_bytes()[4:])
    with pytest.raises(DatasetError, match="differs from its checksum"):
        LanguageWorldExperienceReplay(root, check=False).load_state_dict({})


class Evil:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return (os.mkdir, (self.path,))


def test_a_pickle_among_the_rows_is_never_executed(root, tmp_path):
    marker = tmp_path / "executed"
    rows = TensorDict.load_memmap(root / "data").clone()
    rows["note"] = NonTensorData(Evil(str(marker)), batch_size=rows.batch_size)
    shutil.rmtree(root / "data")
    rows.memmap(root / "data")
    assert list((root / "data").rglob("*.pickle")), "the test needs a pickle"
    assert "note" not in LanguageWorldExperienceReplay(root)[:]
    assert not marker.exists()
    TensorDict.load_memmap(root / "data", allow_pickle=True)["note"]
    assert marker.exists(), "the pickle would have been executed"


def test_an_action_that_is_not_finite_is_refused(root):
    path = root / "data" / "expert_action.memmap"
    path.write_bytes(np.full(path.stat().st_size // 4, np.nan, dtype=np.float32).tobytes())
    with pytest.raises(DatasetError, match="holds an action that is NaN or infinite, for label='expert'"):
        LanguageWorldExperienceReplay(root, check=False)
