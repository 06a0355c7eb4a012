"""Collecting into a folder that holds something: a dataset of the same or another configuration, or other things."""

from __future__ import annotations

import pytest
from collecting import collect, interrupt_after, tree

from lw_torchrl.data import DatasetError, collect


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos")


def test_a_finished_dataset_is_returned_at_once(made, monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("nothing is to be simulated")

    before = tree(made.root)
    monkeypatch.setattr(missing_episodes, "LanguageWorldEnv", refuse)
    assert collect(made.root) == made
    assert tree(made.root) == before


CHANGES = {
    "tasks": (dict(tasks="reach"), r"tasks \(\['push', 'reach'\], now \['reach'\]\)"),
    "episodes_per_task": (dict(episodes_per_task=4), r"episodes_per_task \(3, now 4\)"),
    "seed": (dict(seed=6), r"seed \(5, now 6\)"),
    "noise_scale": (dict(noise_scale=0.1), r"noise_scale \(\[0.0, 0.3\], now \[0.1\]\)"),
    "noise_hold": (dict(noise_hold=3), r"noise_hold \(1, now 3\)"),
    "gripper_noise_factor": (dict(gripper_noise_factor=1.0), r"gripper_noise_factor \(0.2, now 1.0\)"),
    "redraw_failures": (dict(redraw_failures=True), r"redraw_failures \(False, now True\)"),
    "max_steps": (dict(max_steps=15), r"max_steps \(14, now 15\)"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_another_configuration_is_refused_with_what_differs(made, name):
    changed, message = CHANGES[name]
    before = tree(made.root)
    with pytest.raises(DatasetError, match=message) as caught:
        collect(made.root, **changed)
    assert not any(f"{other} " in str(caught.value).split("configuration")[1] for other in CHANGES if other != name)
    assert tree(made.root) == before


def test_another_configuration_is_refused_of_an_unfinished_dataset_too(tmp_path, monkeypatch):
    root = tmp_path / "half"
    interrupt_after(monkeypatch, 0)
    with pytest.raises(KeyboardInterrupt):
        collect(root)
    before = tree(root)
    with pytest.raises(DatasetError, match=CHANGES["seed"][1]):
        collect(root, **CHANGES["seed"][0])
    assert tree(root) == before


def test_a_folder_with_other_things_is_refused_and_left_alone(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "precious.csv").write_text("1,2,3")
    before = tree(tmp_path)
    with pytest.raises(DatasetError, match="not empty"):
        collect(tmp_path)
    assert tree(tmp_path) == before


def test_a_file_in_place_of_the_folder_is_refused(tmp_path):
    path = tmp_path / "demos"
    path.write_text("a file")
    with pytest.raises(ValueError, match="root must be a folder"):
        collect(path)
    assert path.read_text() == "a file"
