"""Datasets in the formats of others: there and back bit for bit, read by others, and what is refused."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from collecting import tree
from exchanged import random_dataset
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.data import ExchangeError
from lw_torchrl.data.exchange import FORMATS
from lw_torchrl.data.memory_map import map_rows

NEEDED = {"hdf5": "h5py", "minari": "minari"}


def skip_without(format):
    if format in NEEDED:
        pytest.importorskip(NEEDED[format])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return random_dataset(tmp_path_factory.mktemp("made") / "demos", [[5, 3], [4, 9]])


@pytest.fixture(scope="module")
def exported(made, tmp_path_factory):
    folder, found = tmp_path_factory.mktemp("exported"), {}

    def export(format):
        skip_without(format)
        if format not in found:
            found[format] = lw.export_dataset(made.root, format, folder / format)
        return found[format]

    return export


@pytest.mark.parametrize("format", FORMATS)
def test_there_and_back_no_bit_changes(format):
    skip_without(format)
    lengths = st.integers(1, 3).flatmap(
        lambda each: st.lists(st.lists(st.integers(1, 12), min_size=each, max_size=each), min_size=1, max_size=3)
    )

    @settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(lengths=lengths, seed=st.integers(0, 99))
    def check(lengths, seed):
        with TemporaryDirectory() as folder:
            made = random_dataset(Path(folder, "demos"), lengths, seed)
            out = lw.export_dataset(made.root, format, Path(folder, "out"))
            back = lw.import_dataset(out, Path(folder, "back"))
            assert tree(back.root) == tree(made.root)
            assert back.config == made.config

    check()


def columns_of(made):
    rows = map_rows(made)
    qaf = lw.QAFTransform(lw.load_plans("MT50"))(rows.select("observation", "task_id").clone())["qaf"]
    return rows, qaf.numpy()


def test_parquet_as_arrow_reads_it(made, exported):
    rows, qaf = columns_of(made)
    found = pq.read_table(exported("parquet") / "data.parquet")
    assert found.num_rows == 21
    told = {"observation": "observation", "action": "action", "next.observation": ("next", "observation")}
    for name, key in told.items():
        values = np.array(found.column(name).to_pylist(), dtype=np.float32)
        assert values.tobytes() == np.asarray(rows[key]).tobytes()
    for name in ("reward_sparse", "success", "done", "terminated", "truncated"):
        assert found.column(f"next.{name}").to_pylist() == rows["next", name].flatten().tolist()
    assert found.column("next.reward").to_pylist() == rows["next", "reward_dense"].flatten().tolist()
    assert (
        np.array(found.column("plan_holds").to_pylist()) == qaf[:, : found.column("plan_holds").type.list_size]
    ).all()
    assert found.column("episode_index").to_pylist() == rows["collector", "traj_ids"].tolist()
    assert set(found.column("task").to_pylist()) == {"drawer-open", "push"}
    assert found.column("task_description")[0].as_py() == lw.TASKS["drawer-open"].description
    assert found.column("plan")[20].as_py() == str(lw.load_plans("MT50")["push"]).rstrip()


def test_plans_of_ones_own(made, tmp_path):
    plans = lw.Plans({"push": lw.load_plans("MT10")["push"]})
    out = lw.export_dataset(made.root, "parquet", tmp_path / "out", plans=plans)
    found = pq.read_table(out / "data.parquet")
    assert set(found.column("plan").to_pylist()) == {"", str(plans["push"]).rstrip()}
    assert not np.array(found.column("plan_holds").to_pylist())[:8].any()


def test_lerobots_tables(made, exported):
    out = exported("lerobot")
    info = json.loads((out / "meta" / "info.json").read_text())
    data = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert {*data.column_names} == {*info["features"]}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (4, 21, 2)
    stats = json.loads((out / "meta" / "stats.json").read_text())
    values = np.asarray(map_rows(made)["action"], dtype=np.float64)
    assert stats["action"]["mean"] == pytest.approx(values.mean(0).tolist())
    assert stats["action"]["std"] == pytest.approx(values.std(0).tolist())
    assert stats["action"]["min"] == values.min(0).tolist()
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [one["dataset_to_index"] for one in episodes] == [5, 8, 12, 21]
    assert episodes[3]["tasks"] == [lw.TASKS["push"].description]
    assert episodes[1]["stats/action/max"] == pytest.approx(values[5:8].max(0).tolist())


def test_large_datasets_of_lerobot_are_several_files(made, monkeypatch, tmp_path):
    import lw_torchrl.data.exchange.lerobot as lerobot

    monkeypatch.setattr(lerobot, "_FILE_MB", 0.004)
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet")
    assert episodes.column("data/file_index").to_pylist() == [0, 0, 1, 2]
    assert tree(lw.import_dataset(out, tmp_path / "back").root) == tree(made.root)


def test_minaris_own_loader(made, exported, monkeypatch):
    minari = pytest.importorskip("minari")
    out = exported("minari")
    rows = map_rows(made)
    found = minari.MinariDataset(out / "data")
    assert (found.id, found.total_steps, found.total_episodes) == ("minari-v0", 21, 4)
    for info, episode in zip(made.episodes, found.iterate_episodes(), strict=True):
        own = rows[info.start : info.start + info.length]
        assert episode.observations[:-1].tobytes() == np.asarray(own["observation"]).tobytes()
        assert episode.observations[1:].tobytes() == np.asarray(own["next", "observation"]).tobytes()
        assert episode.actions.tobytes() == np.asarray(own["action"]).tobytes()
        assert (episode.rewards == own["next", "reward_dense"].flatten().numpy()).all()
        assert episode.infos["success"][1:].tolist() == own["next", "success"].flatten().tolist()
        assert episode.truncations.tolist() == own["next", "truncated"].flatten().tolist()
    assert [one["task"] for one in found.storage.get_episode_metadata([0, 3])] == ["drawer-open", "push"]


def test_hdf5_is_as_robomimic_reads_it(made, exported):
    h5py = pytest.importorskip("h5py")
    rows = map_rows(made)
    with h5py.File(exported("hdf5") / "data.hdf5") as file:
        assert sorted(file["data"]) == ["demo_0", "demo_1", "demo_2", "demo_3"]
        assert file["data"].attrs["total"] == 21
        group = file["data/demo_3"]
        assert (group.attrs["num_samples"], group.attrs["task"]) == (9, "push")
        assert (group["obs/state"][()] == rows["observation"][12:].numpy()).all()
        assert (group["next_obs/state"][()] == rows["next", "observation"][12:].numpy()).all()
        assert (group["actions"][()] == rows["action"][12:].numpy()).all()
        assert group["dones"][()].tolist() == [0] * 8 + [1]


def imported(source, out):
    """What comes of a file: a dataset, or the error."""
    try:
        return lw.import_dataset(source, out)
    except ExchangeError as error:
        return error


@pytest.mark.parametrize("format", FORMATS)
def test_a_damaged_file_is_refused_by_name(made, exported, tmp_path, format):
    """A byte that is changed anywhere is missed by its rows' checksums, or was of no use."""
    source = shutil.copytree(exported(format), tmp_path / "copy")
    ending = {"parquet": ".parquet", "lerobot": ".parquet", "hdf5": ".hdf5", "minari": ".hdf5"}[format]
    path = sorted(source.rglob(f"*{ending}"))[0]
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    refused = [imported(source, tmp_path / "back")]
    for number, place in enumerate(np.random.default_rng(0).integers(0, len(whole), 15).tolist()):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x55]) + whole[place + 1 :])
        found = imported(source, tmp_path / f"back{number}")
        if isinstance(found, ExchangeError):
            refused.append(found)
            assert not (tmp_path / f"back{number}").exists()
        else:
            assert tree(found.root) == tree(made.root)
    assert all(str(source) in str(error) for error in refused)
    assert len(refused) > 1
    assert [one.name for one in tmp_path.iterdir() if one.name[0] == "."] == []


def test_foreign_files_are_refused_by_name(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "todo.txt").write_text("sleep")
    with pytest.raises(ExchangeError, match=r"notes' is of none of the formats parquet, lerobot"):
        lw.import_dataset(tmp_path / "notes", tmp_path / "out")
    for format, name in (("parquet", "a.parquet"), ("hdf5", "a.hdf5")):
        skip_without(format)
        (tmp_path / name).write_bytes(b"no rows at all")
        with pytest.raises(ExchangeError, match=name):
            lw.import_dataset(tmp_path / name, tmp_path / "out")
    (tmp_path / "old" / "meta").mkdir(parents=True)
    (tmp_path / "old" / "meta" / "info.json").write_text('{"codebase_version": "v2.1", "features": {}}')
    with pytest.raises(ExchangeError, match=r"LeRobot's version 'v2.1', this package reads v3.0"):
        lw.import_dataset(tmp_path / "old", tmp_path / "out")
    with pytest.raises(FileNotFoundError, match="source: there is no file"):
        lw.import_dataset(tmp_path / "nowhere", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_place_that_holds_something_is_left_alone(made, exported, tmp_path):
    (tmp_path / "file").write_text("mine")
    for out, told in ((tmp_path / "file", "is a file"), (tmp_path, "holds files")):
        with pytest.raises(ValueError, match=f"out must be .*{told}"):
            lw.export_dataset(made.root, "parquet", out)
        with pytest.raises(ValueError, match=f"out must be .*{told}"):
            lw.import_dataset(exported("parquet"), out)
    assert [one.name for one in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize(
    "given", [{"task": "hammer"}, {"episodes_per_task": 1}, {"suite": "fetch"}, {"behaviour": "mine"}]
)
def test_an_export_of_ours_comes_back_whole_or_not(exported, tmp_path, given):
    with pytest.raises(ValueError, match=f"{next(iter(given))} must not be given: .* an export of a dataset of ours"):
        lw.import_dataset(exported("parquet"), tmp_path / "out", **given)


def edited(source, out, **features):
    """A copy of a LeRobot dataset, with these words in its description."""
    info = shutil.copytree(source, out) / "meta" / "info.json"
    told = json.loads(info.read_text())
    told["features"]["action"] |= features.pop("action", {})
    info.write_text(json.dumps(told | features))
    return out


@pytest.mark.parametrize("shape", [None, 4, "abc", [7], [-1]])
def test_lerobots_description_is_checked(exported, tmp_path, shape):
    source = edited(exported("lerobot"), tmp_path / "in", action={"shape": shape})
    with pytest.raises(ExchangeError, match=r"features.action.shape in meta/info.json must be a row's, \[4\]"):
        lw.import_dataset(source, tmp_path / "out")
    source = edited(exported("lerobot"), tmp_path / "none", features={"action": None})
    with pytest.raises(ExchangeError, match=r"action in meta/info.json must be a table, it is None"):
        lw.import_dataset(source, tmp_path / "out")
    source = edited(exported("lerobot"), tmp_path / "float", total_frames=21.0)
    with pytest.raises(ExchangeError, match=r"total_frames in meta/info.json must be a whole number, it is 21.0"):
        lw.import_dataset(source, tmp_path / "out")


def test_lerobots_tasks_are_numbers(exported, tmp_path):
    path = shutil.copytree(exported("lerobot"), tmp_path / "in") / "meta" / "tasks.parquet"
    tasks = pq.read_table(path).to_pydict()
    pq.write_table(pa.table(tasks | {"task_index": [[one, one] for one in tasks["task_index"]]}), path)
    with pytest.raises(ExchangeError, match=r"task_index in meta/tasks.parquet must hold one number in each row"):
        lw.import_dataset(tmp_path / "in", tmp_path / "out")


def test_statistics_without_numbers_are_left_out(tmp_path):
    rows = {"obs": [[0.0] * 39] * 2, "action": [[0.0] * 4] * 2, "episode_index": [0, 0]}
    pq.write_table(pa.table(rows), tmp_path / "theirs.parquet")
    with pytest.warns(UserWarning, match="a dense reward: it is NaN"):
        lw.import_dataset(tmp_path / "theirs.parquet", tmp_path / "ours", task="reach")
    out = lw.export_dataset(tmp_path / "ours", "lerobot", tmp_path / "out")
    stats = (out / "meta" / "stats.json").read_text()
    assert "NaN" not in stats
    assert "next.reward" not in json.loads(stats)


def test_what_is_not_installed_is_named(made, monkeypatch, tmp_path):
    for format, package, extra in (("hdf5", "h5py", "exchange"), ("minari", "minari", "minari")):
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"lw_torchrl.data.exchange.{format}", raising=False)
        with pytest.raises(
            ImportError, match=rf"{package}, which is not installed: pip install 'lw_torchrl\[{extra}\]'"
        ):
            lw.export_dataset(made.root, format, tmp_path / "out")
    assert [*tmp_path.iterdir()] == []


LEROBOT = os.environ.get("LEROBOT_PYTHON", "")  # of an environment with lerobot, which is not beside ours: rerun
READ_BY_LEROBOT = """
import hashlib, json, sys
import numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torchrl.data.datasets import LeRobotExperienceReplay
from torchrl.data.datasets import lerobot as of_torchrl

root, work = sys.argv[1:]
found = LeRobotDataset("mine/demos", root=root)
rows = [found[place] for place in range(len(found))]
names = ["observation.state", "next.observation", "action", "expert_action", "next.reward", "next.reward_sparse"]
told = {name: hashlib.sha256(b"".join(row[name].numpy().tobytes() for row in rows)).hexdigest() for name in names}
told["task"] = [row["task"] for row in rows]
told["success"] = [bool(row["next.success"]) for row in rows]
told["holds"] = [row["plan_holds"].tolist() for row in rows]
import huggingface_hub
huggingface_hub.snapshot_download = lambda repo, **how: root  # a folder in the place of the hub
replay = LeRobotExperienceReplay("mine/demos", root=work, batch_size=4)
every = replay[:]
told["torchrl"] = hashlib.sha256(every["observation", "state"].numpy().tobytes()).hexdigest()
told["torchrl_action"] = hashlib.sha256(every["action"].numpy().tobytes()).hexdigest()
told["torchrl_task"] = list(every.get("language_instruction").tolist())
told["sample"] = list(replay.sample()["action"].shape)
print(json.dumps(told))
"""


@pytest.mark.slow
@pytest.mark.skipif(not LEROBOT, reason="LEROBOT_PYTHON names no python with lerobot and torchrl")
def test_lerobots_and_torchrls_own_loaders(made, exported, tmp_path):
    command = [LEROBOT, "-c", READ_BY_LEROBOT, str(exported("lerobot")), str(tmp_path / "torchrl")]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    found = json.loads(done.stdout.strip().splitlines()[-1])
    rows, qaf = columns_of(made)

    def digest(*key):
        return hashlib.sha256(np.asarray(rows[key]).tobytes()).hexdigest()

    assert found["observation.state"] == found["torchrl"] == digest("observation")
    assert found["action"] == found["torchrl_action"] == digest("action")
    assert found["expert_action"] == digest("expert_action")
    assert found["next.observation"] == digest("next", "observation")
    assert found["next.reward"] == digest("next", "reward_dense")
    assert found["next.reward_sparse"] == digest("next", "reward_sparse")
    descriptions = [lw.TASKS[info.task].description for info in made.episodes for _ in range(info.length)]
    assert found["task"] == found["torchrl_task"] == descriptions
    assert found["success"] == rows["next", "success"].flatten().tolist()
    assert (np.array(found["holds"]) == qaf[:, : len(found["holds"][0])]).all()
    assert found["sample"] == [4, 4]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_torchrl_shows_zeros_for_minari(made, monkeypatch, tmp_path):
    """TorchRL's fault, which docs/data.md reports; when this fails it is mended, and the page can say so."""
    pytest.importorskip("minari")
    from torchrl.data.datasets import MinariExperienceReplay

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    lw.export_dataset(made.root, "minari", tmp_path / "minari" / "demos-v0")
    how = {"root": str(tmp_path / "torchrl"), "load_from_local_minari": True, "download": False}
    replay = MinariExperienceReplay("demos-v0", batch_size=4, **how)
    assert replay[:]["observation"].shape == (21, 39)
    assert not replay[:]["observation"].any()


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS)
def test_another_suites_dataset_comes_back_too(format, tmp_path):
    skip_without(format)
    pytest.importorskip("gymnasium_robotics")
    how = {"episodes_per_task": 2, "max_steps": 12, "progress": False}
    made = lw.collect_demonstrations(["fetch/push", "fetch/reach"], root=tmp_path / "demos", **how)
    out = lw.export_dataset(made.root, format, tmp_path / "out")
    assert tree(lw.import_dataset(out, tmp_path / "back").root) == tree(made.root)
