"""Datasets in LeRobot's and Minari's formats: restored bit for bit, and read by other libraries; pictures as videos."""

import errno
import hashlib
import json
import os
import shutil
import subprocess
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.parquet as pq
import pytest
from collecting import random_dataset, tree
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.data import ExchangeError
from lw_torchrl.data.dataset import load_rows
from lw_torchrl.data.exchange import FORMATS
from lw_torchrl.data.pictures import Pictures, _write


def skip_without(format):
    if format == "minari":
        pytest.importorskip("minari")


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return random_dataset(tmp_path_factory.mktemp("made") / "demos", [[5, 3], [4, 9]])


@pytest.fixture(scope="module")
def exported(made, tmp_path_factory):
    folder, paths = tmp_path_factory.mktemp("exported"), {}

    def export(format):
        skip_without(format)
        if format not in paths:
            paths[format] = lw.export_dataset(made.root, format, folder / format)
        return paths[format]

    return export


@pytest.mark.parametrize("format", FORMATS)
def test_export_and_import_change_no_bit(format):
    skip_without(format)
    of_task = lambda each: st.lists(st.integers(1, 12), min_size=each, max_size=each)  # noqa: E731
    lengths = st.integers(1, 3).flatmap(lambda each: st.lists(of_task(each), min_size=1, max_size=3))

    @settings(max_examples=4, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    @given(lengths=lengths, seed=st.integers(0, 99))
    def check(lengths, seed):
        with TemporaryDirectory() as folder:
            made = random_dataset(Path(folder, "demos"), lengths, seed)
            out = lw.export_dataset(made.root, format, Path(folder, "out"))
            again = lw.import_dataset(out, Path(folder, "again"))
            assert tree(again.root) == tree(made.root)
            assert again.config == made.config

    check()


def test_lerobot_tables_hold_rows_statistics_and_tasks(made, exported):
    out, rows = exported("lerobot"), load_rows(made)
    info = json.loads((out / "meta" / "info.json").read_text())
    data = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert {*data.column_names} == {*info["features"]}
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (4, 21, 2)
    keys = {"observation.state": "observation", "action": "action", "next.observation": ("next", "observation")}
    for name, key in keys.items():
        values = np.array(data.column(name).to_pylist(), dtype=np.float32)
        assert values.tobytes() == np.asarray(rows[key]).tobytes()
    assert data.column("next.reward").to_pylist() == rows["next", "reward_dense"].flatten().tolist()
    holds = np.array(data.column("plan_holds").to_pylist())
    expected = lw.QAFTransform(lw.load_plans("MT50"))(rows.select("observation", "task_id").clone())["qaf"].numpy()
    assert (holds == expected[:, : holds.shape[1]]).all()
    stats = json.loads((out / "meta" / "stats.json").read_text())
    values = np.asarray(rows["action"], dtype=np.float64)
    for kind in ("mean", "std", "min"):
        assert stats["action"][kind] == pytest.approx(getattr(values, kind)(0).tolist())
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [episode["dataset_to_index"] for episode in episodes] == [5, 8, 12, 21]
    assert episodes[3]["tasks"] == [lw.TASKS["push"].description]
    assert episodes[1]["stats/action/max"] == pytest.approx(values[5:8].max(0).tolist())
    task = pq.read_table(out / "meta/tasks.parquet").to_pylist()[1]
    assert (task["name"], task["plan"]) == ("push", str(lw.load_plans("MT50")["push"]).rstrip())


def test_an_export_with_other_plans_holds_their_text_and_truth(made, tmp_path):
    plans = lw.Plans({"push": lw.load_plans("MT10")["push"]})
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out", plans=plans)
    assert pq.read_table(out / "meta/tasks.parquet").column("plan").to_pylist() == ["", str(plans["push"]).rstrip()]
    data = pq.read_table(out / "data/chunk-000/file-000.parquet")
    assert not np.array(data.column("plan_holds").to_pylist())[:8].any()


def test_large_lerobot_datasets_have_several_files(made, monkeypatch, tmp_path):
    monkeypatch.setattr("lw_torchrl.data.exchange.lerobot._FILE_MB", 0.004)
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    files = [pq.read_table(path) for path in sorted((out / "data").rglob("*.parquet"))]
    assert len(files) > 1
    episodes = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").column("data/file_index").to_pylist()
    for number, file in enumerate(files):
        listed = [episode for episode, place in enumerate(episodes) if place == number]
        assert file.column("episode_index").unique().to_pylist() == listed
    assert tree(lw.import_dataset(out, tmp_path / "again").root) == tree(made.root)


def test_minari_loads_an_export(made, exported):
    minari = pytest.importorskip("minari")
    rows, dataset = load_rows(made), minari.MinariDataset(exported("minari") / "data")
    assert (dataset.id, dataset.total_steps, dataset.total_episodes) == ("minari-v0", 21, 4)
    for info, episode in zip(made.episodes, dataset.iterate_episodes(), strict=True):
        steps = rows[info.start : info.start + info.length]
        assert episode.observations[:-1].tobytes() == np.asarray(steps["observation"]).tobytes()
        assert episode.observations[1:].tobytes() == np.asarray(steps["next", "observation"]).tobytes()
        assert episode.actions.tobytes() == np.asarray(steps["action"]).tobytes()
        assert (episode.rewards == steps["next", "reward_dense"].flatten().numpy()).all()
        assert episode.infos["success"][1:].tolist() == steps["next", "success"].flatten().tolist()
        assert episode.truncations.tolist() == steps["next", "truncated"].flatten().tolist()
    assert [episode["task"] for episode in dataset.storage.get_episode_metadata([0, 3])] == ["drawer-open", "push"]


@pytest.mark.parametrize("format", FORMATS)
def test_damaged_files_are_errors_with_the_path(made, exported, tmp_path, format):
    """The checksums find a changed byte, or the byte is not used."""
    source = shutil.copytree(exported(format), tmp_path / "copy")
    (path, *_) = sorted(source.rglob("*.parquet" if format == "lerobot" else "*.hdf5"))
    content, errors = path.read_bytes(), []
    places = np.random.default_rng(0).integers(0, len(content), 10).tolist()
    changes = [content[:at] + bytes([content[at] ^ 0x55]) + content[at + 1 :] for at in places]
    for number, changed in enumerate([content[:-100], *changes]):
        path.write_bytes(changed)
        try:
            again = lw.import_dataset(source, tmp_path / f"again{number}")
        except ExchangeError as error:
            errors.append(str(error))
            assert not (tmp_path / f"again{number}").exists()
        else:
            assert tree(again.root) == tree(made.root)
    assert len(errors) > 1
    assert all(str(source) in error for error in errors)


def test_other_files_are_errors_with_the_path(made, tmp_path):
    (tmp_path / "notes").mkdir()
    with pytest.raises(ExchangeError, match="notes' is not a LeRobot"):
        lw.import_dataset(tmp_path / "notes", tmp_path / "out")
    (tmp_path / "old" / "meta").mkdir(parents=True)
    (tmp_path / "old" / "meta" / "info.json").write_text('{"codebase_version": "v1.6", "features": {}}')
    with pytest.raises(ExchangeError, match=r"'v1\.6'"):
        lw.import_dataset(tmp_path / "old", tmp_path / "out")
    with pytest.raises(FileNotFoundError, match="source"):
        lw.import_dataset(tmp_path / "nowhere", tmp_path / "out")
    with pytest.raises(ValueError, match="out must be a new folder"):
        lw.export_dataset(made.root, "lerobot", tmp_path)
    assert not (tmp_path / "out").exists()


def test_a_full_disk_is_an_error_before_minari_writes(made, monkeypatch, tmp_path):
    pytest.importorskip("minari")
    out = lw.export_dataset(made.root, "minari", tmp_path / "whole")
    reserved = []

    def posix_fallocate(handle, start, size):
        reserved.append(size)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", posix_fallocate)
    with pytest.raises(OSError, match="No space left"):
        lw.export_dataset(made.root, "minari", tmp_path / "out")
    assert [*tmp_path.iterdir()] == [out]
    written = (out / "data" / "main_data.hdf5").stat().st_size
    assert written < reserved[0]


# A Python with lerobot, which cannot be installed with our version of rerun.
LEROBOT = os.environ.get("LEROBOT_PYTHON", "")
READ_BY_LEROBOT = """
import hashlib, json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from torchrl.data.datasets import LeRobotExperienceReplay
import huggingface_hub
root, work = sys.argv[1:]
dataset = LeRobotDataset("mine/demos", root=root)
rows = [dataset[place] for place in range(len(dataset))]
names = ["observation.state", "next.observation", "action", "expert_action", "next.reward"]
read = {name: hashlib.sha256(b"".join(row[name].numpy().tobytes() for row in rows)).hexdigest() for name in names}
read["task"] = [row["task"] for row in rows]
read["success"] = [bool(row["next.success"]) for row in rows]
huggingface_hub.snapshot_download = lambda repo, **how: root  # a folder instead of the hub
every = LeRobotExperienceReplay("mine/demos", root=work, batch_size=4)[:]
read["torchrl"] = hashlib.sha256(every["observation", "state"].numpy().tobytes()).hexdigest()
read["torchrl_action"] = hashlib.sha256(every["action"].numpy().tobytes()).hexdigest()
print(json.dumps(read))
"""


@pytest.mark.slow
@pytest.mark.skipif(not LEROBOT, reason="LEROBOT_PYTHON does not name a Python with lerobot and torchrl")
def test_lerobot_and_torchrl_load_an_export(made, exported, tmp_path):
    command = [LEROBOT, "-c", READ_BY_LEROBOT, str(exported("lerobot")), str(tmp_path / "torchrl")]
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home")}
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    read, rows = json.loads(done.stdout.strip().splitlines()[-1]), load_rows(made)

    def digest(*key):
        return hashlib.sha256(np.asarray(rows[key]).tobytes()).hexdigest()

    assert read["observation.state"] == read["torchrl"] == digest("observation")
    assert read["action"] == read["torchrl_action"] == digest("action")
    assert read["expert_action"] == digest("expert_action")
    assert read["next.observation"] == digest("next", "observation")
    assert read["next.reward"] == digest("next", "reward_dense")
    assert read["task"] == [lw.TASKS[info.task].description for info in made.episodes for _ in range(info.length)]
    assert read["success"] == rows["next", "success"].flatten().tolist()


@pytest.mark.slow
@pytest.mark.parametrize("format", FORMATS)
def test_another_suites_dataset_is_restored_too(format, tmp_path):
    skip_without(format)
    pytest.importorskip("gymnasium_robotics")
    options = {"episodes_per_task": 2, "max_steps": 12, "progress": False}
    made = lw.collect_demonstrations(["fetch/push", "fetch/reach"], root=tmp_path / "demos", **options)
    out = lw.export_dataset(made.root, format, tmp_path / "out")
    assert tree(lw.import_dataset(out, tmp_path / "again").root) == tree(made.root)


KEY = "observation.images.corner-32x48-every2"


@pytest.fixture
def drawn(tmp_path):
    """A dataset with pictures of one colour each, which a codec does not change."""
    made = random_dataset(tmp_path / "demos", [[5, 3], [4, 9]])
    pictures, shades = Pictures(("corner",), 32, 48, 2), iter(range(10, 250, 12))
    for episode in made.episodes:
        images = [np.full(pictures.shape, next(shades), dtype=np.uint8) for _ in range(pictures.count(episode))]
        _write(pictures.file(made.root, episode), images)
    return made, pictures


def frames(path, start, length):
    """Return the brightness of ``length`` pictures from a time on."""
    import av

    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == 80
        shades = [(frame.time, frame.to_ndarray(format="rgb24").mean()) for frame in container.decode(video=0)]
    return [shade for time, shade in shades if start - 1e-4 <= time][:length]


@pytest.mark.parametrize("together", [100, 2])
def test_videos_have_a_picture_for_each_row(drawn, tmp_path, monkeypatch, together):
    pytest.importorskip("av")
    monkeypatch.setattr("lw_torchrl.data.exchange.lerobot._EPISODES_IN_VIDEO", together)
    made, pictures = drawn
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["features"][KEY]["shape"] == [32, 48, 3]
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row[f"videos/{KEY}/file_index"] for row in rows] == [number // together for number in range(4)]
    for episode, row in zip(made.episodes, rows, strict=True):
        place = {name: row[f"videos/{KEY}/{name}"] for name in ("chunk_index", "file_index")}
        path = out / info["video_path"].format(video_key=KEY, **place)
        brightness = frames(path, row[f"videos/{KEY}/from_timestamp"], episode.length)
        shades = pictures.read(made.root, episode).numpy().mean((1, 2, 3))
        assert brightness == pytest.approx(shades[np.arange(episode.length) // 2].tolist(), abs=3)
        assert row[f"stats/{KEY}/mean"] == [[[pytest.approx(shades.mean() / 255)]]] * 3
    statistics = json.loads((out / "meta" / "stats.json").read_text())[KEY]
    assert np.shape(statistics["mean"]) == (3, 1, 1)
    back = lw.import_dataset(out, tmp_path / "back")
    expected = {name: content for name, content in tree(made.root).items() if not name.startswith("pictures")}
    assert tree(back.root) == expected


def test_incomplete_pictures_are_left_out(drawn, tmp_path):
    made, pictures = drawn
    pictures.file(made.root, made.episodes[1]).unlink()
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    assert not (out / "videos").exists()
