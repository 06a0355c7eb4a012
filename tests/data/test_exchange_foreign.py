"""Imports of datasets from elsewhere: columns by their usual names, and warnings for missing ones."""

import json
import warnings

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import lw_torchrl as lw
from lw_torchrl.data import ExchangeError
from lw_torchrl.data.dataset import load_rows

DRAWS = np.random.default_rng(0)
STATES = DRAWS.standard_normal((9, 39))
ACTIONS = DRAWS.uniform(-1, 1, (9, 4)).astype(np.float32)
LENGTHS = (4, 2, 3)
LIBERO = {"problem_info": '{"language_instruction": "push"}', "env_args": '{"env_name": "Libero"}'}
TASK_TEXTS = ("push-v3", "reach-v2-goal-observable", lw.TASKS["push"].description)


def lerobot(folder, tasks=TASK_TEXTS, version="v2.1", **changed):
    """A LeRobot dataset of three episodes: push, reach, push; version 2 has a file for each."""
    columns = {"observation.environment_state": list(STATES), "observation.state": list(STATES[:, :4])}
    columns |= {"action": list(ACTIONS), "next.success": [False] * 8 + [True]}
    columns |= {"episode_index": np.repeat(np.arange(3), LENGTHS).tolist(), "frame_index": [0, 1, 2, 3, 0, 1, 0, 1, 2]}
    columns |= {"task_index": np.repeat(np.arange(3), LENGTHS).tolist(), **changed}
    table = pa.table({name: column for name, column in columns.items() if column is not None})
    meta, data = folder / "meta", folder / "data" / "chunk-000"
    meta.mkdir(parents=True)
    data.mkdir(parents=True)
    (meta / "info.json").write_text(json.dumps({"codebase_version": version, "total_frames": 9, "features": {}}))
    tasks = [{"task_index": number, "task": text} for number, text in enumerate(tasks)]
    if version.startswith("v2"):
        (meta / "tasks.jsonl").write_text("\n".join(map(json.dumps, tasks)))
        for number, start in enumerate((0, 4, 6)):
            pq.write_table(table.slice(start, LENGTHS[number]), data / f"episode_{number:06d}.parquet")
    else:
        pq.write_table(pa.Table.from_pylist(tasks), meta / "tasks.parquet")
        pq.write_table(table, data / "file-000.parquet")
    return folder


def assert_equal(column, expected):
    np.testing.assert_array_equal(column, expected.astype(np.float32))


def imported(source, out, warned, **options):
    with pytest.warns(UserWarning, match=warned):
        return lw.import_dataset(source, out, **{"episodes_per_task": 1, **options})


@pytest.mark.parametrize("version", ["v2.0", "v2.1", "v3.0"])
def test_lerobot_datasets_are_imported(tmp_path, version):
    lacks = r"lacks the observation after the last.*; a dense reward"
    made = imported(lerobot(tmp_path / "theirs", version=version), tmp_path / "out", lacks)
    assert [(info.task, info.length, info.success) for info in made.episodes] == [("push", 4, 0), ("reach", 2, 0)]
    assert (made.config.behaviour, made.config.seed, made.config.max_steps) == ("imported", -1, 4)
    rows = load_rows(made)
    assert_equal(rows["observation"], STATES[:6])
    assert_equal(rows["next", "observation"], STATES[[1, 2, 3, 3, 5, 5]])
    assert_equal(rows["action"], ACTIONS[:6])
    assert rows["next", "reward_dense"].isnan().all()
    assert rows["next", "done"].flatten().tolist() == [False, False, False, True, False, True]
    assert (rows["next", "done"] == rows["next", "truncated"]).all()
    replay = lw.LanguageWorldExperienceReplay(made.root, label="executed", batch_size=3)
    assert replay.sample()["next", "reward"].shape == (3, 1)
    with pytest.raises(ValueError, match=r"'imported' collected the dataset; use label='executed'"):
        lw.LanguageWorldExperienceReplay(made.root, batch_size=3)
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "again")
    assert "NaN" not in (out / "meta" / "stats.json").read_text()


def test_tasks_are_mapped_and_episodes_counted(tmp_path):
    source = lerobot(tmp_path / "theirs", tasks=("shove", "reach", "shove"))
    with pytest.raises(ValueError, match=r"task .* 'shove'.*to map it"):
        lw.import_dataset(source, tmp_path / "out")
    mapping = {"shove": "push"}
    with pytest.raises(ValueError, match=r"episodes_per_task .* 2 of push, 1 of reach"):
        lw.import_dataset(source, tmp_path / "out", task=mapping)
    with pytest.raises(ValueError, match="episodes_per_task must be at most 1"):
        lw.import_dataset(source, tmp_path / "out", task=mapping, episodes_per_task=2)
    with pytest.raises(ValueError, match="task must be one task"):
        lw.import_dataset(source, tmp_path / "out", task="MT10")
    made = imported(source, tmp_path / "out", "lacks", task="push", episodes_per_task=3, behaviour="friend")
    assert [info.length for info in made.episodes] == [*LENGTHS]
    assert (made.success_rate, made.config.behaviour) == ({"push": 1 / 3}, "friend")


def test_actions_beyond_one_are_clipped(tmp_path):
    source = lerobot(tmp_path / "theirs", action=list(ACTIONS * 2))
    rows = load_rows(imported(source, tmp_path / "out", "larger actions are clipped", task="push", episodes_per_task=3))
    assert_equal(rows["unclipped_action"], ACTIONS * 2)
    assert_equal(rows["action"], (ACTIONS * 2).clip(-1, 1))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"action": None}, "column 'action' needs 4 numbers per row"),
        ({"observation.environment_state": None}, r"column 'observation' needs 39 .* observation.state \(4\)"),
        ({"action": [[0.0] * 4] * 8 + [[float("nan")] * 4]}, "action holds NaN"),
        ({"action": [[0.0] * 4] * 8 + [None]}, r"column 'action' needs .* action \(different sizes\)"),
        ({"action": [[0.0] * 4] * 8 + [[0.0] * 3]}, r"column 'action' needs .* action \(different sizes\)"),
        ({"action": [[0.0] * 4] * 7 + [[0.0] * 3, [0.0] * 5]}, "action must have the same number of values"),
        ({"next.success": [0.0] * 8 + [0.3]}, "next.success must hold booleans"),
        ({"episode_index": [0.0] * 8 + [float("nan")]}, "episode_index must hold whole numbers, but holds nan"),
        ({"frame_index": [0, 1, 2, 3, 0, 1, 0, 1, None]}, "frame_index must hold whole numbers, but holds nan"),
        ({"frame_index": [0, 1, 1, 3, 0, 1, 0, 1, 2]}, "frame_index must differ"),
    ],
)
def test_unsuitable_columns_are_errors(tmp_path, changed, message):
    source = lerobot(tmp_path / "theirs", version="v3.0", **changed)
    with pytest.raises(ExchangeError, match=f"theirs': .*{message}"):
        lw.import_dataset(source, tmp_path / "out", episodes_per_task=1)
    assert [path.name for path in tmp_path.iterdir()] == ["theirs"]


def robomimic(path, names, attributes=()):
    """Write a file in robomimic's layout: the same episode under each name, numbered by its reward."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        file.create_group("data").attrs.update(dict(attributes))
        for number, name in enumerate(names):
            group = file["data"].create_group(name)
            group["obs/state"], group["actions"], group["rewards"] = STATES, ACTIONS, np.full(9, 2.0 + number)
            group.create_dataset("obs/agentview_rgb", shape=(9, 10**9), dtype="f8", chunks=(1, 1000))
    return path


@pytest.mark.parametrize("attributes", [{"task": np.bytes_(b"push")}, {"env_args": '{"env_name": "push-v3"}'}, LIBERO])
def test_hdf5_of_robomimic_and_libero_is_imported(tmp_path, attributes):
    source = robomimic(tmp_path / "a.hdf5", ["demo_0"], attributes)
    made = imported(source, tmp_path / "out", "lacks the observation after the last .*; success")
    rows = load_rows(made)
    assert (made.num_steps, *made.config.tasks) == (9, "push")
    assert_equal(rows["observation"], STATES)
    assert_equal(rows["action"], ACTIONS)


def test_robomimic_episodes_are_sorted_by_number(tmp_path):
    for file, first in (("part-10.hdf5", 11), ("part-2.hdf5", 0)):
        robomimic(tmp_path / file, [f"demo_{number}" for number in range(first, first + 11)])
    made = imported(tmp_path, tmp_path / "out", "lacks", task="push", episodes_per_task=12)
    rewards = load_rows(made)["next", "reward_dense"].reshape(12, 9)[:, 0].tolist()
    assert rewards == [*range(2, 13), 2]


def test_minari_datasets_are_imported(tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    buffer = EpisodeBuffer(
        observations=STATES, actions=ACTIONS[:8], rewards=np.ones(8), terminations=[False] * 8,
        truncations=[False] * 7 + [True], infos={"success": np.array([0.0] * 8 + [1.0])},
    )  # fmt: skip
    spaces = {"observation_space": Box(-9, 9, (39,)), "action_space": Box(-1, 1, (4,))}
    metadata = {name: "us" for name in ("algorithm_name", "author", "author_email", "code_permalink", "description")}
    with warnings.catch_warnings(action="ignore"):  # Minari asks for more metadata
        minari.create_dataset_from_buffers("reach/theirs-v0", [buffer], **spaces, **metadata)
    made = lw.import_dataset(tmp_path / "minari" / "reach" / "theirs-v0", tmp_path / "out", task="reach")
    assert (made.num_steps, made.success_rate) == (8, {"reach": 1.0})
    assert_equal(load_rows(made)["next", "observation"], STATES[1:])


def flat(path, **changed):
    """Write parquet with LeRobot's columns and no metadata: 6 rows of push."""
    columns = {"observation": list(STATES[:6]), "action": list(ACTIONS[:6]), "episode_index": [0] * 3 + [1] * 3}
    columns |= {"task": ["push"] * 6, **changed}
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table({name: column for name, column in columns.items() if column is not None}), path)
    return path


def test_parquet_files_are_sorted_by_number_and_hidden_files_skipped(tmp_path):
    for number in (10, 9, 100):
        flat(tmp_path / "in" / f"part{number}.PQ", episode_index=None, task=None, reward=[float(number)] * 6)
    for name in ("._part9.PQ", "__MACOSX/part1.pq", ".ipynb_checkpoints/part2.pq"):
        (tmp_path / "in" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "in" / name).write_bytes(b"\0\5\x16\7")
    made = imported(tmp_path / "in", tmp_path / "out", "ends of episodes", task="push", episode_length=6)
    assert load_rows(made)["next", "reward_dense"].flatten().tolist() == [9.0] * 6
    every = imported(tmp_path / "in", tmp_path / "all", "ends", task="push", episode_length=6, episodes_per_task=3)
    assert load_rows(every)["next", "reward_dense"].flatten()[::6].tolist() == [9.0, 10.0, 100.0]


@pytest.mark.parametrize("values", [["x"] * 6, [None] * 6, [{"a": 1}] * 6, [[1], [], [1, 2]] * 2, [float("nan")] * 6])
def test_columns_that_are_not_needed_never_matter(tmp_path, values):
    columns = dict.fromkeys(["state", "done", "next.reward_sparse", "expert_action", "notes"], values)
    source = flat(tmp_path / "a.parquet", **columns, success=[False] * 6)
    assert imported(source, tmp_path / "out", "lacks", episodes_per_task=2).num_steps == 6


def test_two_dimensional_columns_and_other_dtypes_are_read(tmp_path):
    grid = [row.reshape(3, 13).tolist() for row in STATES[:6]]
    index = pa.array([0] * 3 + [1] * 3, pa.uint8())
    made = imported(flat(tmp_path / "a.parquet", observation=grid, episode_index=index), tmp_path / "out", "lacks")
    assert_equal(load_rows(made)["observation"], STATES[:3])


def test_numbers_of_tasks_are_mapped(tmp_path):
    source = flat(tmp_path / "a.parquet", task=None, task_index=[4] * 6)
    with pytest.raises(ValueError, match=r"task must be one of .* got '4'.*map it"):
        lw.import_dataset(source, tmp_path / "out")
    for number, mapping in enumerate([{4: "push"}, {"4": "push-v3"}, {"push": 4}]):
        assert imported(source, tmp_path / str(number), "lacks", task=mapping).config.tasks == ("push",)


def test_subsets_of_episodes_are_imported_with_a_warning(tmp_path):
    source = lerobot(tmp_path / "theirs")
    (source / "data/chunk-000/episode_000001.parquet").unlink()
    made = imported(source, tmp_path / "out", "lists 9, but the data files hold 7", episodes_per_task=2)
    assert [info.length for info in made.episodes] == [4, 3]


@pytest.mark.parametrize(
    ("marks", "options", "lengths"),
    [
        ({"timeouts": [0, 0, 1, 0, 0, 0, 0, 0, 1]}, {}, [3, 6]),
        ({"terminals": [0] * 9}, {"episode_length": 3}, [3, 3, 3]),
        ({"dones": [0, 0, 0, 1, 1, 1, 1, 1, 1]}, {}, [9]),
    ],
)
def test_ends_of_episodes_are_derived_for_flat_hdf5(tmp_path, marks, options, lengths):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.H5", "w") as file:
        file["observations"], file["actions"] = STATES, ACTIONS
        for name, values in marks.items():
            file[name] = np.array(values, bool)
    each = {"episodes_per_task": len(lengths), **options}
    made = imported(tmp_path / "a.H5", tmp_path / "out", "lacks", task="push", **each)
    assert [info.length for info in made.episodes] == lengths
    if options:
        with pytest.raises(ValueError, match="episode_length must divide"):
            lw.import_dataset(tmp_path / "a.H5", tmp_path / "none", task="push", episode_length=4)


def test_frames_that_start_again_end_an_episode(tmp_path):
    frames = [3, 4, 5, 3, 4, 3, 4, 5, 6]
    rows = {"observation": STATES.tolist(), "action": ACTIONS.tolist(), "frame_index": frames, "task": ["push"] * 9}
    pq.write_table(pa.table(rows), tmp_path / "a.parquet")
    made = imported(tmp_path / "a.parquet", tmp_path / "out", "lacks", episodes_per_task=3)
    assert [info.length for info in made.episodes] == [3, 2, 4]


def test_maniskill_files_are_imported(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "trajectory.h5", "w") as file:
        for number in (0, 10, 2):
            file[f"traj_{number}/obs"] = np.resize(STATES, (10, 39))
            file[f"traj_{number}/actions"], file[f"traj_{number}/rewards"] = ACTIONS, np.full(9, float(number + 2))
    (tmp_path / "trajectory.json").write_text(json.dumps({"env_info": {"env_id": "push-v3"}, "episodes": []}))
    rows = load_rows(imported(tmp_path, tmp_path / "out", "lacks success", episodes_per_task=3))
    assert rows["next", "reward_dense"].flatten()[::9].tolist() == [2.0, 4.0, 12.0]
    assert_equal(rows["next", "observation"][:9], np.resize(STATES, (10, 39))[1:])
