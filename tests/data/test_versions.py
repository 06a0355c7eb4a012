"""Versions of the simulator and of packages: recorded from the start, and compared where a dataset is gone on with or
joined to others."""

from __future__ import annotations

import importlib.metadata
import json
import shutil
import warnings

import pytest
from collecting import collect, interrupt_after

import lw_torchrl as lw
from lw_torchrl._versions import SIMULATORS, package_versions, version_changes
from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay
from lw_torchrl.data.dataset import read_metadata


@pytest.fixture
def installed(monkeypatch):
    """A function that changes the versions that are installed."""

    def change(**versions):
        real = importlib.metadata.version
        monkeypatch.setattr("lw_torchrl._versions.version", lambda name: versions.get(name) or real(name))

    return change


@pytest.fixture
def half_made(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        interrupt_after(patch, 2)
        with pytest.raises(KeyboardInterrupt):
            collect(tmp_path / "demos", num_envs=2)
    return tmp_path / "demos"


def edit(file, **changed):
    found = json.loads(file.read_text())
    file.write_text(json.dumps({**found, **changed}))


def test_changes_are_told_of_what_is_recorded():
    now = package_versions()
    assert {*SIMULATORS, "torch", "numpy", "lw_torchrl"} <= now.keys()
    assert version_changes(now, now) == []
    assert version_changes({**now, "mujoco": "3.2.0"}, now) == [f"mujoco 3.2.0, now {now['mujoco']}"]
    for unknown in ({}, None, "3.2.0", {"mujoco": 3}, [["mujoco", "3.2.0"]]):
        assert version_changes(unknown, now) == []


def test_a_half_made_dataset_says_its_versions_from_the_start(half_made):
    assert json.loads((half_made / ".partial" / "versions.json").read_text()) == package_versions()


@pytest.mark.parametrize("name", SIMULATORS)
def test_episodes_of_two_simulators_are_not_mixed_in_a_dataset(half_made, installed, name):
    before = sorted((half_made / ".partial").iterdir())
    recorded = package_versions()
    installed(**{name: "9.9.9"})
    wanted = " ".join(f"{one}=={recorded[one]}" for one in SIMULATORS)
    with pytest.raises(DatasetError) as caught:
        collect(half_made)
    assert str(caught.value) == (
        f"root: {str(half_made)!r} holds episodes of another simulator ({name} {recorded[name]}, now 9.9.9), which are "
        f"not mixed with others: install {wanted} to go on, choose another folder, or delete it to start again"
    )
    assert sorted((half_made / ".partial").iterdir()) == before
    installed()
    assert collect(half_made).versions == recorded


@pytest.mark.parametrize("name", ["numpy", "torch"])
def test_another_library_is_a_warning_and_the_first_stays_on_record(half_made, installed, name):
    recorded = package_versions()
    installed(**{name: "9.9.9"})
    message = rf"begun under other versions \({name} {recorded[name].replace('+', '.')}, now 9.9.9\): it is continued"
    with pytest.warns(UserWarning, match=message):
        made = collect(half_made)
    assert made.versions == read_metadata(half_made).versions == recorded


def test_without_episodes_nothing_is_mixed(half_made, installed):
    for path in (half_made / ".partial").glob("*.npz"):
        path.unlink()
    installed(mujoco="9.9.9")
    assert collect(half_made).versions["mujoco"] == "9.9.9"


def test_half_made_datasets_without_the_record_are_gone_on_with(half_made, installed):
    (half_made / ".partial" / "versions.json").unlink()
    installed(mujoco="9.9.9")
    assert collect(half_made).versions["mujoco"] == "9.9.9"


@pytest.mark.parametrize("content", ["", "[]", '{"mujoco": 3}', "[" * 10**5])
def test_a_damaged_record_is_named(half_made, content):
    (half_made / ".partial" / "versions.json").write_text(content)
    with pytest.raises(DatasetError, match=r"versions.json' is damaged .*; delete '.*demos' to start again"):
        collect(half_made)


def test_a_damaged_dataset_is_mended_by_its_own_simulator_alone(tmp_path, installed):
    root = tmp_path / "demos"
    made = collect(root)
    column = root / "data" / "action.memmap"
    content = column.read_bytes()
    column.write_bytes(content[:-4] + b"\0\0\0\1")
    installed(mujoco="9.9.9")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(DatasetError, match="holds episodes of another simulator"):
            collect(root)
        assert read_metadata(root) == made, "what is whole is still there"
        installed()
        assert collect(root) == made
    assert column.read_bytes() == content


def test_a_damaged_dataset_keeps_the_versions_that_made_it(tmp_path, installed):
    root = tmp_path / "demos"
    recorded = collect(root).versions
    (root / "data" / "action.memmap").write_bytes((root / "data" / "action.memmap").read_bytes()[:-4] + b"\0\0\0\1")
    installed(torch="9.9.9")
    with (
        pytest.warns(UserWarning, match="is damaged; 5 of 6 episodes are kept"),
        pytest.warns(UserWarning, match=r"begun under other versions \(torch"),
    ):
        assert collect(root).versions == recorded


def test_datasets_of_different_simulators_are_joined_with_a_warning(tmp_path):
    ours = collect(tmp_path / "ours").versions["mujoco"]
    for name in ("same", "other", "older"):
        shutil.copytree(tmp_path / "ours", tmp_path / name)
    versions = package_versions()
    edit(tmp_path / "other" / "metadata.json", versions={**versions, "mujoco": "3.2.0"})
    edit(tmp_path / "older" / "metadata.json", versions={})
    load = LanguageWorldExperienceReplay
    load([tmp_path / "ours", tmp_path / "same", tmp_path / "older"])
    message = f"different simulators, mujoco {ours} for '{tmp_path / 'ours'}', 3.2.0 for '{tmp_path / 'other'}'"
    with pytest.warns(UserWarning, match=message) as told:
        joined = load([tmp_path / "older", tmp_path / "ours", tmp_path / "other"])
    assert len(told) == 1
    assert len(joined) == 3 * len(load(tmp_path / "ours"))
    growing = dict(label="executed", terminate_on_success=True, grow=10, sampler=lw.CoLearningSampler("grown"))
    load(tmp_path / "ours", **growing)
    with pytest.warns(UserWarning, match=f"mujoco 3.2.0 for .*other', {ours} for the rows to come"):
        load(tmp_path / "other", **growing)
