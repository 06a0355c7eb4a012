"""Rows that are not as they were written: found when a dataset is opened, and before a training goes on."""

from __future__ import annotations

import os
import re
import shutil
from itertools import count

import numpy as np
import pytest
from collecting import EPISODES, STEPS, collect, tree

import lw_torchrl as lw
from lw_torchrl.data import DatasetError, LanguageWorldExperienceReplay, memory_map
from lw_torchrl.data.dataset import read_metadata
from lw_torchrl.data.memory_map import COLUMNS, load_rows, row_bytes
from lw_torchrl.data.missing_episodes import EpisodeFiles
from lw_torchrl.language.layout import METAWORLD
from lw_torchrl.training.behavioral_cloning import bc_loss

TASKS = ("push", "reach")
ALL = [(task, episode) for task in TASKS for episode in range(EPISODES)]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return collect(tmp_path_factory.mktemp("made") / "demos").root


@pytest.fixture
def root(made, tmp_path):
    """A copy, to be damaged."""
    return shutil.copytree(made, tmp_path / "demos")


@pytest.fixture
def settled(monkeypatch):
    """Files that were written just now count as written long ago."""
    monkeypatch.setattr(memory_map, "_SETTLED", 0)


@pytest.fixture
def read(monkeypatch):
    """The episodes that are read through."""
    found, real = [], memory_map._as_written

    def reading(demonstrations, info, rows):
        found.append((info.task, info.episode))
        return real(demonstrations, info, rows)

    monkeypatch.setattr(memory_map, "_as_written", reading)
    return found


def column(root, name):
    return root / "data" / f"{name}.memmap"


@pytest.mark.parametrize("name", ["/".join(key) for key in COLUMNS])
def test_no_bit_of_a_column_changes_unnoticed(root, name):
    """Any bit of any byte, and the episode that it belongs to is named, whatever is shown."""
    path, drawn = column(root, name), np.random.default_rng(sum(name.encode()))
    content = path.read_bytes()
    size = len(content) // len(ALL)
    places = {0, size - 1, size, len(content) - 1, *drawn.integers(len(content), size=12).tolist()}
    for at in sorted(places):
        changed = bytearray(content)
        changed[at] ^= 1 << int(drawn.integers(8))
        path.write_bytes(changed)
        task, episode = ALL[at // size]
        for options in ({}, dict(label="executed", n_steps=2, gamma=0.9), dict(episodes=EPISODES)):
            with pytest.raises(DatasetError, match=r"1 episode of 6 differ .* same collect_demonstrations") as caught:
                LanguageWorldExperienceReplay(root, **options)
            assert f"{episode} of {task!r}" in str(caught.value)
            assert str(root) in str(caught.value)
        assert path.read_bytes() == bytes(changed)
    path.write_bytes(content)
    LanguageWorldExperienceReplay(root)


def rewrite(root, name, change, dtype):
    values = np.fromfile(column(root, name), dtype)
    change(values)
    values.tofile(column(root, name))


DAMAGE = {
    "swapped tasks": lambda root: rewrite(root, "task_id", lambda v: v.__setitem__(slice(None), v[::-1].copy()), "i8"),
    "actions of 1e30": lambda root: rewrite(root, "action", lambda v: v.__setitem__(slice(9, 12), 1e30), "f4"),
    "labels of 1e30": lambda root: rewrite(root, "expert_action", lambda v: v.__setitem__(slice(9, 12), 1e30), "f4"),
    "NaN": lambda root: rewrite(root, "observation", lambda v: v.__setitem__(3, np.nan), "f4"),
    "episodes exchanged": lambda root: rewrite(
        root, "observation", lambda v: v.__setitem__(slice(None), np.roll(v, STEPS * 39)), "f4"
    ),
    "a column of zeros": lambda root: rewrite(root, "next/reward_dense", lambda v: v.fill(0), "f4"),
    "a flag": lambda root: rewrite(root, "next/done", lambda v: v.__setitem__(STEPS - 1, 0), "u1"),
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damage_is_told_when_a_dataset_is_opened_and_may_be_looked_at(root, name):
    DAMAGE[name](root)
    before = tree(root)
    with pytest.raises(DatasetError, match=rf"root: the rows in '{root}' are not as they were written"):
        LanguageWorldExperienceReplay(root, label="executed")
    replay = LanguageWorldExperienceReplay(root, label="executed", check=False)
    assert len(replay) == len(ALL) * STEPS
    with pytest.raises(DatasetError, match="not as they were written"):
        replay.verify()
    assert tree(root) == before
    with pytest.warns(UserWarning, match="is damaged"):
        collect(root)
    LanguageWorldExperienceReplay(root).verify()


def test_only_what_is_shown_matters(root):
    rewrite(root, "action", lambda v: v.__setitem__(0, 0.5), "f4")
    LanguageWorldExperienceReplay(root, episodes={"push": [1, 2], "reach": 1}).verify()
    with pytest.raises(DatasetError, match="1 episode of 1 differ from their checksums, 0 of 'push'"):
        LanguageWorldExperienceReplay([root], episodes=[{"push": 1}])


def test_an_unchanged_dataset_is_read_once_in_a_process(root, read, settled):
    for _ in range(3):
        LanguageWorldExperienceReplay(root, label="executed").verify()
    LanguageWorldExperienceReplay([root, root], episodes=[1, {"push": [2]}])
    assert read == ALL
    os.utime(column(root, "action"), ns=(0, 0))
    LanguageWorldExperienceReplay(root, episodes={"push": [1]})
    LanguageWorldExperienceReplay(root)
    assert read == [*ALL, ("push", 1), *(one for one in ALL if one != ("push", 1))]


@pytest.mark.parametrize("name", ["action", "next/done"])
def test_a_change_that_keeps_size_and_time_is_noticed(root, settled, name):
    LanguageWorldExperienceReplay(root)
    path = column(root, name)
    times = path.stat()
    rewrite(root, name, lambda v: v.__setitem__(0, 1), "u1")
    os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
    with pytest.raises(DatasetError, match="0 of 'push'"):
        LanguageWorldExperienceReplay(root)


def test_what_was_written_a_moment_ago_is_not_remembered(root, read, monkeypatch):
    """It may be written again, under the same time."""
    monkeypatch.setattr(memory_map, "_SETTLED", 10**12)
    for _ in range(2):
        LanguageWorldExperienceReplay(root)
    assert read == [*ALL, *ALL]


def test_a_large_dataset_is_read_in_part_and_wholly_when_asked(root, read, settled, monkeypatch):
    monkeypatch.setattr(memory_map, "READ_AT_ONCE", 2 * STEPS * row_bytes(METAWORLD))
    replay = LanguageWorldExperienceReplay(root)
    assert read == [ALL[0], ALL[3]]
    replay.verify()
    assert sorted(read) == ALL


def test_off_means_not_read(root, read):
    LanguageWorldExperienceReplay(root, check=False)
    assert not read


def test_metadata_and_rows_of_two_datasets_are_told_apart(made, root, tmp_path):
    other = collect(tmp_path / "other", seed=6).root
    shutil.copy(other / "metadata.json", root / "metadata.json")
    with pytest.raises(DatasetError, match="6 episodes of 6 differ"):
        LanguageWorldExperienceReplay(root)


def make_actor():
    return lw.PlanConditionedActor(lw.load_plans("MT10"), latent_size=4, width=16, depth=1, encoder_width=8)


def damaged_replay(root, **options):
    rewrite(root, "observation", lambda v: v.__setitem__(40, 7.0), "f4")
    return LanguageWorldExperienceReplay(root, check=False, **options)


def cloning(replay, checkpoint):
    config = lw.BehavioralCloningConfig(steps=4, batch_size=8)
    return lw.BehavioralCloningTrainer(make_actor(), replay, config, checkpoint=checkpoint, progress=False)


def offline(replay, checkpoint):
    config = lw.OfflineConfig(steps=4, batch_size=8)
    return lw.OfflineTrainer(bc_loss(make_actor(), "l2"), replay, config, checkpoint=checkpoint, progress=False)


@pytest.mark.parametrize("trainer", [cloning, offline])
def test_a_training_goes_on_with_verified_rows_alone(root, tmp_path, trainer):
    checkpoint = tmp_path / "checkpoint.zip"
    trainer(LanguageWorldExperienceReplay(root, transform=make_actor().transform()), checkpoint).train()
    before = checkpoint.read_bytes()
    replay = damaged_replay(root, transform=make_actor().transform())
    with pytest.raises(DatasetError, match=rf"^root: the rows in '{root}' are not as they were written"):
        trainer(replay, checkpoint)
    assert checkpoint.read_bytes() == before


def test_neither_is_a_buffers_state_restored_beside_others(root, tmp_path):
    whole = LanguageWorldExperienceReplay(root, batch_size=8)
    whole.dumps(tmp_path / "saved")
    replay = damaged_replay(root)
    for restore in (lambda: replay.loads(tmp_path / "saved"), lambda: replay.load_state_dict(whole.state_dict())):
        with pytest.raises(DatasetError, match=rf"^root: the rows in '{root}' are not as they were written"):
            restore()


def test_an_episode_of_a_half_made_dataset_is_run_again_whatever_bit_changed(made, tmp_path):
    """What collecting goes on from: the files of episodes, each with the sums that a zip archive has."""
    rows = load_rows(read_metadata(made))[:STEPS]
    files = EpisodeFiles(tmp_path, TASKS, STEPS)
    files.put("push", 0, rows)
    (path,) = tmp_path.iterdir()
    content, drawn = path.read_bytes(), np.random.default_rng(0)
    kept = count()
    for at in drawn.integers(len(content), size=300).tolist():
        changed = bytearray(content)
        changed[at] ^= 1 << int(drawn.integers(8))
        path.write_bytes(changed)
        files.drop_damaged()
        if path.exists():
            assert (
                files.get("push", 0) == rows.exclude("collector")
            ).all()  # what the archive says of dates and rights
            next(kept)
    assert next(kept) < 100
    assert re.fullmatch(r"push\.0\.npz", path.name)
