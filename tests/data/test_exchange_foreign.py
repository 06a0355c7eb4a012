"""What others hold becomes a dataset: columns by their names, tasks by theirs, and what lacks is named."""

from __future__ import annotations

import warnings

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import lw_torchrl as lw
from lw_torchrl.data import ExchangeError
from lw_torchrl.data.memory_map import map_rows

DRAWS = np.random.default_rng(0)
STATES = DRAWS.standard_normal((9, 39))
ACTIONS = DRAWS.uniform(-1, 1, (9, 4)).astype(np.float32)
LENGTHS = (4, 2, 3)
ODD = (float("nan"), 0.3, -1.0)  # which are no booleans
EPISODE = np.repeat(np.arange(3), LENGTHS)
TASKS = np.repeat(["push-v3", "reach-v2-goal-observable", lw.TASKS["push"].description], LENGTHS)


def theirs(path, **changed):
    """A file of three episodes: push, reach, push."""
    rows = {
        "observation.environment_state": list(STATES),
        "observation.state": list(STATES[:, :4]),
        "action": list(ACTIONS),
    }
    rows |= {"next.success": [False] * 8 + [True], "episode_index": EPISODE.tolist(), "task": TASKS.tolist(), **changed}
    pq.write_table(pa.table({name: value for name, value in rows.items() if value is not None}), path)
    return path


def taken(source, out, warned, **options):
    with pytest.warns(UserWarning, match=warned):
        return lw.import_dataset(source, out, **{"episodes_per_task": 1, **options})


def test_theirs_is_shown_by_a_buffer(tmp_path):
    made = taken(
        theirs(tmp_path / "a.parquet"), tmp_path / "out", r"lacks the observation after the last.*; a dense reward"
    )
    assert [(one.task, one.length, one.success) for one in made.episodes] == [("push", 4, False), ("reach", 2, False)]
    assert (made.config.behaviour, made.config.seed, made.config.max_steps) == ("imported", -1, 4)
    rows = map_rows(made)
    np.testing.assert_array_equal(rows["observation"], STATES[:6].astype(np.float32))
    np.testing.assert_array_equal(rows["next", "observation"][:3], STATES[1:4].astype(np.float32))
    np.testing.assert_array_equal(rows["next", "observation"][3], STATES[3].astype(np.float32))
    np.testing.assert_array_equal(rows["action"], ACTIONS[:6])
    assert rows["next", "reward_dense"].isnan().all()
    assert rows["next", "done"].flatten().tolist() == [False, False, False, True, False, True]
    assert (rows["next", "done"] == rows["next", "truncated"]).all()
    replay = lw.LanguageWorldExperienceReplay(made.root, label="executed", batch_size=3)
    assert replay.sample()["next", "reward"].shape == (3, 1)
    with pytest.raises(ValueError, match="imported acted here: take label='executed'"):
        lw.LanguageWorldExperienceReplay(made.root, batch_size=3)


def test_tasks_in_their_words_and_episodes_to_choose(tmp_path):
    file = theirs(tmp_path / "a.parquet", task=np.repeat(["shove", "reach", "shove"], LENGTHS).tolist())
    with pytest.raises(ValueError, match=r"task must be one of .*, got 'shove'.*task= may map it"):
        lw.import_dataset(file, tmp_path / "out")
    words = {"shove": "push"}
    with pytest.raises(ValueError, match=r"episodes_per_task must be given, 1 for example: .* 2 of push, 1 of reach"):
        lw.import_dataset(file, tmp_path / "out", task=words)
    with pytest.raises(ValueError, match="episodes_per_task must be at most 1, the episodes of 'reach', got 2"):
        lw.import_dataset(file, tmp_path / "out", task=words, episodes_per_task=2)
    made = taken(file, tmp_path / "out", "lacks", task="push", episodes_per_task=3, behaviour="friend")
    assert [one.length for one in made.episodes] == [*LENGTHS]
    assert (made.success_rate, made.config.behaviour) == ({"push": 1 / 3}, "friend")


def test_episodes_by_their_ends_and_actions_beyond(tmp_path):
    done = np.zeros(9, dtype=np.int64)
    done[[3, 8]] = 1
    file = theirs(tmp_path / "a.parquet", episode_index=None, task=None, dones=done.tolist(), action=list(ACTIONS * 2))
    with pytest.raises(ExchangeError, match="lacks the task of its episodes; give task='reach'"):
        lw.import_dataset(file, tmp_path / "out")
    made = taken(file, tmp_path / "out", "those beyond are clipped", task="push", episodes_per_task=2)
    assert [one.length for one in made.episodes] == [4, 5]
    rows = map_rows(made)
    np.testing.assert_array_equal(rows["unclipped_action"], ACTIONS * 2)
    np.testing.assert_array_equal(rows["action"], (ACTIONS * 2).clip(-1, 1))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"action": None}, "lacks action, a column of 4 numbers as in 'metaworld': it has none of action, actions"),
        (
            {"observation.environment_state": None},
            "lacks observation, a column of 39 numbers as in 'metaworld': observation.state has 4",
        ),
        ({"episode_index": None}, "lacks episodes: it has none of the columns episode_index, "),
        ({"episode_index": [0, 1] * 4 + [2]}, "the rows of an episode must come one after another"),
        ({"action": [[0.0] * 4] * 8 + [[float("nan")] * 4]}, "action must hold finite numbers"),
        ({"action": [[0.0] * 4] * 8 + [None]}, "action must hold numbers, 1 of them are absent"),
        ({"action": [[0.0] * 4] * 8 + [[0.0] * 3]}, "action must hold as many numbers in each row"),
        *(({"next.success": [0.0] * 8 + [odd]}, f"next.success must hold .* 0 and 1, it holds {odd}") for odd in ODD),
        ({"next.done": [True] + [False] * 8}, "next.done must be true only where .* in row 0, episode_index 0 goes on"),
        ({"frame_index": [0, 1, 3, 2, *range(5)]}, "frame_index must count up by 1 .* row 2 has 3 after 1"),
        ({"task": ["reach"] * 3 + ["push"] * 6}, "task must be the same .* episode 0 has 'reach' and 'push'"),
        ({"task": ["reach"] * 5 + [None] * 4}, "task must be the same .* episode 1 has 'reach' and None"),
        ({"task": [["reach"]] * 9}, "task must hold texts, it holds list"),
        ({"episode_index": [[0, 0]] * 9}, "episode_index must hold one number in each row, it holds 2"),
    ],
)
def test_what_lacks_is_named(tmp_path, changed, told):
    file = theirs(tmp_path / "a.parquet", **changed)
    with pytest.raises(ExchangeError, match=f"a.parquet'.*{told}"):
        lw.import_dataset(file, tmp_path / "out", episodes_per_task=1)
    assert [one.name for one in tmp_path.iterdir()] == ["a.parquet"]


@pytest.mark.parametrize(
    ("frames", "told"), [(None, "a.parquet' must hold whole"), ([*range(9)], "row 9 has 0 after 8")]
)
def test_two_files_with_the_same_episode_are_not_one(tmp_path, frames, told):
    for name in "ab":
        theirs(tmp_path / f"{name}.parquet", episode_index=[0] * 9, task=None, frame_index=frames)
    with pytest.raises(ExchangeError, match=told):
        lw.import_dataset(tmp_path, tmp_path / "out", task="push")


@pytest.mark.parametrize("task", ["MT10", {"shove": "MT10"}])
def test_a_set_of_tasks_is_no_task(tmp_path, task):
    with pytest.raises(ValueError, match="task must be one task, 'MT10' is a set of 10"):
        lw.import_dataset(theirs(tmp_path / "a.parquet"), tmp_path / "out", task=task)


def test_places_that_are_none(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "empty")
    file = theirs(tmp_path / "a.parquet")
    for out, told in ((tmp_path / "link", "is a link"), (tmp_path / "no" / "..", "has no name of its own")):
        with pytest.raises(ValueError, match=f"out must be a new folder, or an empty one, .* {told}"):
            lw.import_dataset(file, out)
    with pytest.raises(ExchangeError, match="source must be a file or a folder, '/dev/null' is neither"):
        lw.import_dataset("/dev/null", tmp_path / "out")
    assert sorted(one.name for one in tmp_path.iterdir()) == ["a.parquet", "empty", "link"]


def robomimics(path, change=None):
    """A file of one episode of reach; ``change`` is given its group."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        group = file.create_group("data/demo_0")
        group.attrs["task"] = np.bytes_(b"reach")
        group["obs/state"], group["actions"] = STATES, ACTIONS
        if change:
            change(h5py, group)
    return path


def test_hdf5_reads_what_it_needs(tmp_path):
    def huge(h5py, group):
        group.create_dataset("pictures", shape=(9, 10**12), dtype="f8", chunks=(1, 1000))

    made = taken(robomimics(tmp_path / "a.hdf5", huge), tmp_path / "out", "lacks success|lacks the observation")
    assert (made.num_steps, *made.config.tasks) == (9, "reach")


def test_groups_end_where_they_end(tmp_path):
    def early(h5py, group):
        group["dones"] = group["timeouts"] = [0, 1, 0, 0, 0, 0, 0, 0, 1]

    with pytest.raises(ExchangeError, match="truncated must be true only where an episode ends, it is true in row 1"):
        lw.import_dataset(robomimics(tmp_path / "a.hdf5", early), tmp_path / "out")


def linked(h5py, group):
    group["rewards"] = h5py.ExternalLink("other.hdf5", "/data/demo_0/actions")


def virtual(h5py, group):
    layout = h5py.VirtualLayout((9,), "f4")
    layout[:] = h5py.VirtualSource("other.hdf5", "rewards", shape=(9,))
    group.create_virtual_dataset("rewards", layout)


def outside(h5py, group):
    group.create_dataset("rewards", shape=(9,), dtype="u1", external=[("/etc/hostname", 0, 9)])


@pytest.mark.parametrize("change", [linked, virtual, outside])
def test_hdf5_reads_no_other_file(tmp_path, change):
    with pytest.raises(ExchangeError, match=r"must hold all of its rows itself, data/demo_0/rewards .* another file"):
        lw.import_dataset(robomimics(tmp_path / "a.hdf5", change), tmp_path / "out")


def test_d4rls_flat_arrays(tmp_path):
    h5py = pytest.importorskip("h5py")
    ends = np.zeros(9, dtype=bool)
    ends[[3, 5, 8]] = True
    with h5py.File(tmp_path / "flat.hdf5", "w") as file:
        told = {"observations": STATES, "actions": ACTIONS, "rewards": np.arange(9.0), "terminals": ends & False}
        for name, values in {**told, "timeouts": ends, "infos/success": ends}.items():
            file[name] = values
    made = taken(tmp_path / "flat.hdf5", tmp_path / "out", "lacks the observation", task="reach", episodes_per_task=3)
    rows = map_rows(made)
    assert [one.length for one in made.episodes] == [*LENGTHS]
    assert rows["next", "reward_dense"].flatten().tolist() == [*range(9)]
    assert (rows["next", "success"].flatten().numpy() == ends).all()


def test_minaris_datasets_of_others(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    buffer = EpisodeBuffer(
        observations=STATES, actions=ACTIONS[:8], rewards=np.ones(8), terminations=[False] * 8,
        truncations=[False] * 7 + [True], infos={"success": np.array([0.0] * 8 + [1.0])},
    )  # fmt: skip
    spaces = {"observation_space": Box(-9, 9, (39,)), "action_space": Box(-1, 1, (4,))}
    told = {name: "us" for name in ("algorithm_name", "author", "author_email", "code_permalink", "description")}
    with warnings.catch_warnings(action="ignore"):  # of what else Minari would like to be told
        minari.create_dataset_from_buffers("reach/theirs-v0", [buffer], **spaces, **told)
    made = lw.import_dataset(tmp_path / "minari" / "reach" / "theirs-v0", tmp_path / "out", task="reach")
    rows = map_rows(made)
    assert (made.num_steps, made.success_rate) == (8, {"reach": 1.0})
    np.testing.assert_array_equal(rows["next", "observation"], STATES[1:].astype(np.float32))
