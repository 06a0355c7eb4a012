"""Pictures of a dataset as the videos of a LeRobot dataset: a picture for each row, where the tables say."""

from __future__ import annotations

import json

import numpy as np
import pyarrow.parquet as pq
import pytest
from collecting import tree
from exchanged import random_dataset

import lw_torchrl as lw
from lw_torchrl.data.pictures import Pictures, _write

KEY = "observation.images.corner-32x48-every2"


@pytest.fixture
def drawn(tmp_path):
    """A dataset with pictures of one colour each, which a codec keeps."""
    made = random_dataset(tmp_path / "demos", [[5, 3], [4, 9]])
    pictures, shades = Pictures(("corner",), 32, 48, 2), iter(range(10, 250, 12))
    for episode in made.episodes:
        own = [np.full(pictures.shape, next(shades), dtype=np.uint8) for _ in range(pictures.count(episode))]
        _write(pictures.file(made.root, episode), own)
    return made, pictures


def frames(path, start, length):
    """The brightness of the pictures from a time on."""
    import av

    with av.open(str(path)) as container:
        assert container.streams.video[0].average_rate == 80
        every = [(frame.time, frame.to_ndarray(format="rgb24").mean()) for frame in container.decode(video=0)]
    return [shade for time, shade in every if start - 1e-4 <= time][:length]


@pytest.mark.parametrize("together", [100, 2])
def test_each_row_has_its_picture(drawn, tmp_path, monkeypatch, together):
    pytest.importorskip("av")
    monkeypatch.setattr(video, "_TOGETHER", together)
    made, pictures = drawn
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    info = json.loads((out / "meta" / "info.json").read_text())
    assert info["features"][KEY]["shape"] == [32, 48, 3]
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row[f"videos/{KEY}/file_index"] for row in rows] == [number // together for number in range(4)]
    for episode, row in zip(made.episodes, rows, strict=True):
        place = {"chunk_index": row[f"videos/{KEY}/chunk_index"], "file_index": row[f"videos/{KEY}/file_index"]}
        path = out / info["video_path"].format(video_key=KEY, **place)
        found = frames(path, row[f"videos/{KEY}/from_timestamp"], episode.length)
        shades = pictures.read(made.root, episode).numpy().mean((1, 2, 3))
        assert found == pytest.approx(shades[np.arange(episode.length) // 2].tolist(), abs=3)
        assert row[f"stats/{KEY}/mean"] == [[[pytest.approx(shades.mean() / 255)]]] * 3
    statistics = json.loads((out / "meta" / "stats.json").read_text())[KEY]
    assert np.shape(statistics["mean"]) == (3, 1, 1)
    back = lw.import_dataset(out, tmp_path / "back")
    own = {name: content for name, content in tree(made.root).items() if not name.startswith("pictures")}
    assert tree(back.root) == own


def test_pictures_of_some_episodes_are_left_out(drawn, tmp_path):
    made, pictures = drawn
    pictures.file(made.root, made.episodes[1]).unlink()
    out = lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    assert not (out / "videos").exists()


def test_damaged_pictures_are_named(drawn, tmp_path):
    pytest.importorskip("av")
    made, pictures = drawn
    pictures.file(made.root, made.episodes[1]).write_bytes(b"no pictures")
    with pytest.raises(lw.data.DatasetError, match=r"drawer-open.1.zip' is damaged"):
        lw.export_dataset(made.root, "lerobot", tmp_path / "out")
    assert not (tmp_path / "out").exists()
