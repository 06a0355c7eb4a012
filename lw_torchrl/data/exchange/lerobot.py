"""Write datasets in the LeRobot format, version 3.

meta/info.json                                    the columns with types and shapes; time steps per second
meta/stats.json                                   min, max, mean, std and count of each column
meta/tasks.parquet                                description, task_index, name and plan of each task
meta/episodes/chunk-000/file-000.parquet          location and statistics of each episode
data/chunk-000/file-000.parquet                   the time steps
videos/CAMERA/chunk-000/file-000.mp4              the pictures stored by ``add_pictures``
meta/lw_torchrl.json                              the metadata of the lw_torchrl dataset, which LeRobot ignores
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._util.progress import Progress
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.exchange.reader import NAMES
from lw_torchrl.data.exchange.table import ABOUT, Array, Table
from lw_torchrl.data.pictures import Pictures

INFO, ABOUT_FILE = "meta/info.json", f"meta/{ABOUT}.json"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_FILE_MB, _FILES = 100, 1000  # approximate megabytes per data file, and number of files per folder
_NAMES = {name: others[0] for name, others in NAMES.items()}
_VIDEO = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
_EPISODES_IN_VIDEO = 100
_PICTURES = re.compile(r"(.+)-(\d+)x(\d+)-every(\d+)")  # matches the name of a folder of pictures


def _columns(table: Table) -> dict[str, Array]:
    """Return the columns of the data files under LeRobot's names."""
    frame = np.concatenate([np.arange(length) for length in table.lengths])
    descriptions = [*table.descriptions]
    return {_NAMES.get(name, name): column for name, column in table.columns.items()} | {
        "timestamp": (frame / table.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": table.repeat(range(len(table.lengths))),
        "index": np.arange(table.rows),
        "task_index": table.repeat([descriptions.index(task) for task in table.tasks]),
    }


def _feature(column: Array) -> dict[str, Any]:
    width = column.size // len(column)
    names = [str(place) for place in range(width)] if column.ndim == 2 else None
    return {"dtype": str(column.dtype), "shape": [width], "names": names}


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table as a LeRobot dataset, with the pictures of the original dataset as videos."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, lengths, spans = _columns(table), np.asarray(table.lengths), [*table.spans()]
    arrow = pa.table({name: _arrow_column(column) for name, column in columns.items()})
    rows_of_file = max(1, int(_FILE_MB * 1e6 / sum(column.nbytes / len(column) for column in columns.values())))
    place = np.array([start // rows_of_file for start, _ in spans])  # the file number of each episode
    for number, file in enumerate(dict.fromkeys(place.tolist())):
        in_file = [span for span, each in zip(spans, place, strict=True) if each == file]
        path = folder / _DATA.format(chunk_index=number // _FILES, file_index=number % _FILES)
        path.parent.mkdir(parents=True, exist_ok=True)
        steps = arrow.slice(in_file[0][0], in_file[-1][1] - in_file[0][0])
        pq.write_table(steps, path, compression="zstd", use_dictionary=False)
        bar.update(len(steps))
    place = np.unique(place, return_inverse=True)[1]  # renumber, because long episodes may skip a file number
    episodes: dict[str, Any] = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[table.descriptions[task]] for task in table.tasks],
        "length": lengths,
        "data/chunk_index": place // _FILES,
        "data/file_index": place % _FILES,
        "dataset_from_index": [start for start, _ in spans],
        "dataset_to_index": [end for _, end in spans],
        "meta/episodes/chunk_index": 0 * lengths,
        "meta/episodes/file_index": 0 * lengths,
    }
    features, statistics = {name: _feature(column) for name, column in columns.items()}, {}
    for name, column in columns.items():
        values = column.astype(np.float64).reshape(len(column), -1)
        each = [_statistics(values[start:end]) for start, end in spans]
        episodes |= {f"stats/{name}/{kind}": [stats[kind].tolist() for stats in each] for kind in each[0]}
        if np.isfinite(values).all():  # JSON has no NaN
            statistics[name] = {kind: value.tolist() for kind, value in _combined(each).items()}
    for key, pictures in _existing_pictures(table.demonstrations).items():
        features[key] = _video_feature(pictures, table.fps)
        places, each = _write_videos(table.demonstrations, pictures, folder, key, table.fps)
        episodes |= {f"videos/{key}/{name}": column for name, column in places.items()}
        episodes |= {f"stats/{key}/{kind}": [stats[kind].tolist() for stats in each] for kind in each[0]}
        statistics[key] = {kind: value.tolist() for kind, value in _combined(each).items()}
    (folder / _EPISODES).parent.mkdir(parents=True)
    pq.write_table(pa.table(episodes), folder / _EPISODES)
    pq.write_table(_tasks(table), folder / "meta" / "tasks.parquet")
    info = {
        "codebase_version": "v3.0",
        "robot_type": "sawyer" if "/" not in table.tasks[0] else table.tasks[0].partition("/")[0],
        "total_episodes": len(lengths),
        "total_frames": table.rows,
        "total_tasks": len(table.descriptions),
        "chunks_size": _FILES,
        "data_files_size_in_mb": _FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": table.fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": _DATA,
        "video_path": _VIDEO if any(feature["dtype"] == "video" for feature in features.values()) else None,
        "features": features,
    }
    for name, value in ((INFO, info), ("meta/stats.json", statistics), (ABOUT_FILE, table.metadata)):
        (folder / name).write_text(json.dumps(value, indent=4), encoding="utf-8")


def _tasks(table: Table) -> Any:
    """Return the Arrow table of tasks, with the description as pandas index."""
    import pyarrow as pa

    columns = {
        "task_index": [*range(len(table.descriptions))],
        "name": [*table.descriptions],
        "plan": [table.plans.get(task, "") for task in table.descriptions],
        "task": [*table.descriptions.values()],
    }
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in zip(columns, [("int64", "int64"), *3 * [("unicode", "object")]], strict=True)
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.2.0"}
    return pa.table(columns).replace_schema_metadata({"pandas": json.dumps(pandas)})


def _arrow_column(column: Array) -> Any:
    """Convert a column to an Arrow array; as in LeRobot, a column of width 1 becomes plain numbers."""
    import pyarrow as pa

    flat, width = pa.array(np.ascontiguousarray(column).reshape(-1)), column.size // len(column)
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _existing_pictures(demonstrations: Demonstrations) -> dict[str, Pictures]:
    """Return the sets of pictures that exist for all episodes of a dataset, by LeRobot's column name."""
    pictures = {}
    for path in (demonstrations.root / "pictures").glob("*"):
        if (match := _PICTURES.fullmatch(path.name)) is None:
            continue
        cameras, *sizes = match.groups()
        rendered = Pictures(tuple(cameras.split("+")), *map(int, sizes))
        if all(rendered.file(demonstrations.root, episode).is_file() for episode in demonstrations.episodes):
            pictures[f"observation.images.{match[0]}"] = rendered
    return pictures


def _pixel_format(pictures: Pictures) -> str:
    return "yuv444p" if any(size % 2 for size in pictures.shape[:2]) else "yuv420p"


def _video_feature(pictures: Pictures, fps: int) -> dict[str, Any]:
    """Return the description of a video column for LeRobot's info.json."""
    height, width, _ = pictures.shape
    info: dict[str, Any] = {"video.height": height, "video.width": width, "video.channels": 3, "video.fps": fps}
    info |= {"video.codec": "h264", "video.pix_fmt": _pixel_format(pictures)}
    info |= {"video.is_depth_map": False, "has_audio": False}
    return {"dtype": "video", "shape": [height, width, 3], "names": ["height", "width", "channels"], "info": info}


def _statistics(values: Array) -> dict[str, Array]:
    """Return statistics of rows (R, n) under LeRobot's names."""
    statistics = {name: getattr(values, name)(0) for name in ("min", "max", "mean", "std")}
    return statistics | {"count": np.array([len(values)])}


def _combined(parts: list[dict[str, Array]]) -> dict[str, Array]:
    """Merge the statistics of the parts into statistics of all rows."""
    each = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    share = (each["count"] / each["count"].sum()).reshape(-1, *[1] * (each["mean"].ndim - 1))
    mean = (each["mean"] * share).sum(0)
    variance = ((each["std"] ** 2 + (each["mean"] - mean) ** 2) * share).sum(0)
    whole = {"min": each["min"].min(0), "max": each["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    return whole | {"count": each["count"].sum(0)}


def _write_videos(
    demonstrations: Demonstrations, pictures: Pictures, folder: Path, key: str, fps: int
) -> tuple[dict[str, list[Any]], list[dict[str, Array]]]:
    """Write videos with one frame per row; a row without a rendered picture repeats the previous picture.

    Return the location of each episode, and statistics (3, 1, 1) of each episode's pixel values in [0, 1].
    """
    import av

    names = ("chunk_index", "file_index", "from_timestamp", "to_timestamp")
    places: dict[str, list[Any]] = {name: [] for name in names}
    each = []
    with Progress("writing videos", demonstrations.num_steps, "picture") as bar:
        for number in range(0, len(demonstrations.episodes), _EPISODES_IN_VIDEO):
            chunk, file = divmod(number // _EPISODES_IN_VIDEO, 1000)
            path = folder / _VIDEO.format(video_key=key, chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            frame = 0
            with av.open(str(path), "w") as container:
                stream = container.add_stream("libx264", rate=fps, options={"crf": "18", "g": "2", "bf": "0"})
                stream.height, stream.width, stream.pix_fmt = *pictures.shape[:2], _pixel_format(pictures)
                for episode in demonstrations.episodes[number : number + _EPISODES_IN_VIDEO]:
                    images = pictures.read(demonstrations.root, episode).numpy()
                    for image in images[np.arange(episode.length) // pictures.every]:
                        container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
                    values = _statistics(images.reshape(-1, 3) / 255)
                    values |= {kind: values[kind].reshape(3, 1, 1) for kind in ("min", "max", "mean", "std")}
                    each.append(values)
                    times = frame / fps, (frame + episode.length) / fps
                    for name, value in zip(names, (chunk, file, *times), strict=True):
                        places[name].append(value)
                    frame += episode.length
                    bar.update(episode.length)
                container.mux(stream.encode())
    return places, each
