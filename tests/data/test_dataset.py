"""A dataset's folder: whatever is wrong with it is said, nothing on disk changes, no pickle is loaded."""

from __future__ import annotations

import json
import os
import shutil

import numpy as np
import pytest
import torch
from collecting import restate_checksums
from tensordict import NonTensorData, TensorDict

from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.data.dataset import FORMAT, FORMAT_VERSION, read_metadata
from lw_torchrl.data.memory_map import load_rows
from lw_torchrl.language.tasks import task_id


def tree(root):
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = tmp_path_factory.mktemp("made") / "demos"
    return collect_demonstrations("reach", episodes_per_task=2, root=root, max_steps=5, progress=False)


@pytest.fixture
def root(made, tmp_path):
    """A copy, to be damaged."""
    return shutil.copytree(made.root, tmp_path / "demos")


def refused(root, message):
    """The error with which a dataset is refused; nothing on disk may change."""
    before = tree(root)
    with pytest.raises(DatasetError, match=message) as caught:
        LanguageWorldExperienceReplay(root)
    assert tree(root) == before
    assert str(root) in str(caught.value)
    return caught.value


def edit(root, change):
    path = root / "metadata.json"
    found = json.loads(path.read_text())
    change(found)
    path.write_text(json.dumps(found))


def test_the_description_reads_back(made, root):
    found = read_metadata(root)
    assert found.config == made.config
    assert found.episodes == made.episodes
    assert found.attempts == {"reach": 2}
    assert load_rows(found).batch_size == (10,)


def test_a_dataset_error_is_a_value_error():
    assert issubclass(DatasetError, ValueError)


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"root: no dataset folder .*nowhere.*collect_demonstrations"):
        LanguageWorldExperienceReplay(tmp_path / "nowhere")
    assert not (tmp_path / "nowhere").exists()


def test_a_file_in_place_of_the_folder_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FileNotFoundError, match="root: no dataset folder"):
        LanguageWorldExperienceReplay(tmp_path / "file")


def test_a_half_written_dataset_says_how_to_finish_it(root):
    (root / "metadata.json").unlink()
    (root / ".partial").mkdir()
    refused(root, "half-written; run the same collect_demonstrations again")


def test_a_folder_of_something_else_is_no_dataset(root):
    (root / "metadata.json").unlink()
    refused(root, "holds no metadata.json")


@pytest.mark.parametrize(("format", "number"), [(FORMAT, FORMAT_VERSION + 1), (FORMAT, 0), ("minari", FORMAT_VERSION)])
def test_another_format_or_version_says_both(root, format, number):
    edit(root, lambda found: found.update(format=format, version=number))
    refused(root, f"format {format!r} version {number}.*reads {FORMAT!r} version {FORMAT_VERSION}")


def test_a_dataset_of_version_1_says_so_and_what_to_do(root):
    edit(root, lambda found: found.update(version=1))
    refused(root, "version 1; this package reads .* version 2. Collect it again with the same collect_demonstrations")


@pytest.mark.parametrize("stored", [7, 50, 2**62])
def test_tasks_are_numbered_as_today_whatever_their_numbers_were(root, made, stored):
    """A 51st task would number the 50 anew."""
    today, before = load_rows(made), tree(root)
    for name in ("task_id", "next/task_id"):
        np.full(10, stored).tofile(root / "data" / f"{name}.memmap")
    edit(root, lambda found: found.update(task_ids={"reach": stored}))
    restate_checksums(root)
    changed = tree(root)
    assert {name for name in before if before[name] != changed[name]} == {
        "metadata.json",
        "data/task_id.memmap",
        "data/next/task_id.memmap",
    }
    found = read_metadata(root)
    assert found.task_ids == {"reach": stored}
    assert (load_rows(found) == today).all()
    replay = LanguageWorldExperienceReplay(root, label="executed", batch_size=4, sampler=TaskBalancedSampler())
    assert replay.sample()["next", "task_id"].tolist() == [task_id("reach")] * 4
    assert tree(root) == changed


def test_a_dataset_of_several_tasks_is_renumbered_row_by_row(tmp_path):
    root = tmp_path / "demos"
    tasks = ["drawer-open", "push", "reach"]
    collect_demonstrations(tasks, episodes_per_task=2, root=root, max_steps=3, progress=False)
    today = load_rows(read_metadata(root)).clone()
    stored = {"drawer-open": task_id("reach"), "push": task_id("drawer-open"), "reach": 50}
    for name in ("task_id", "next/task_id"):
        np.repeat(list(stored.values()), 6).tofile(root / "data" / f"{name}.memmap")
    edit(root, lambda found: found.update(task_ids=stored))
    assert (load_rows(read_metadata(root)) == today).all()


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 0.999])
def test_truncated_metadata_are_damaged(root, share):
    path = root / "metadata.json"
    content = path.read_bytes().rstrip()
    path.write_bytes(content[: int(share * len(content))])
    refused(root, "damaged")


@pytest.mark.parametrize("text", ["[]", "null", "7", '"words"', "{}", "\x00\xff"])
def test_metadata_of_another_kind_are_damaged(root, text):
    (root / "metadata.json").write_text(text, encoding="latin-1")
    refused(root, "damaged")


DAMAGE = {
    "no configuration": lambda found: found.pop("config"),
    "no episodes": lambda found: found.pop("episodes"),
    "no versions": lambda found: found.pop("versions"),
    "unknown option": lambda found: found["config"].update(colour="red"),
    "missing option": lambda found: found["config"].pop("seed"),
    "columns of other lengths": lambda found: found["episodes"]["length"].pop(),
    "missing column": lambda found: found["episodes"].pop("start"),
    "a word for a number": lambda found: found["episodes"].update(length=["five", "five"]),
    "nothing for a number": lambda found: found["episodes"].update(start=[None, 5]),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_metadata_with_parts_missing_or_wrong_are_damaged(root, name):
    edit(root, DAMAGE[name])
    refused(root, "damaged")


def test_rows_and_metadata_that_disagree_are_damaged(root):
    edit(root, lambda found: found["episodes"].update(length=[5, 4]))
    refused(root, r"of shape \[10\], the metadata say 9 rows")


@pytest.mark.parametrize("damage", ["no folder", "no meta", "meta half", "meta empty"])
def test_rows_without_their_description_are_refused(root, damage):
    meta = root / "data" / "meta.json"
    if damage == "no folder":
        shutil.rmtree(root / "data")
    elif damage == "no meta":
        meta.unlink()
    else:
        meta.write_bytes(meta.read_bytes()[: 40 if damage == "meta half" else 0])
    refused(root, "rows .*cannot be read")


@pytest.mark.parametrize("name", ["observation", "expert_action", "next/observation", "task_id"])
@pytest.mark.parametrize("damage", ["missing", "truncated", "empty"])
def test_a_damaged_column_is_refused(root, name, damage):
    path = root / "data" / f"{name}.memmap"
    if damage == "missing":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[:-8] if damage == "truncated" else b"")
    refused(root, "cannot be read")


@pytest.mark.parametrize("name", ["observation", "expert_action", "next"])
def test_a_dataset_that_lacks_a_column_is_refused(root, name):
    rows = TensorDict.load_memmap(root / "data").exclude(name).clone()
    shutil.rmtree(root / "data")
    rows.memmap(root / "data")
    refused(root, name)


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
    assert list((root / "data").rglob("*.pickle")), "the test wants a pickle"
    refused(root, "'note' in .* is no part of a dataset; move it elsewhere")
    assert not marker.exists()
    TensorDict.load_memmap(root / "data", allow_pickle=True)["note"]
    assert marker.exists(), "the pickle would have been executed"


def test_loading_and_sampling_leave_the_files_as_they_are(root):
    before = tree(root)
    replay = LanguageWorldExperienceReplay(root, batch_size=4)
    batch = replay.sample()
    batch["observation"].zero_()
    batch["action"].fill_(torch.nan)
    assert tree(root) == before
    assert np.isfinite(replay[:]["action"].numpy()).all()
