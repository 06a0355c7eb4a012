"""LeRobot's dataset format, version 3: parquet files of steps, tables of episodes and tasks, videos.

meta/info.json                                    the columns, their types and shapes; the rate of steps
meta/stats.json                                   of each column min, max, mean, std and count
meta/tasks.parquet                                task_index, by the description of the task; its name and plan beside
meta/episodes/chunk-000/file-000.parquet          where each episode is, and its statistics
data/chunk-000/file-000.parquet                   the steps
videos/CAMERA/chunk-000/file-000.mp4              the pictures
meta/lw_torchrl.json                              the metadata of a dataset of ours, which LeRobot does not read
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._checks import shown
from lw_torchrl._files import read_json
from lw_torchrl._progress import Progress
from lw_torchrl.data.exchange import video
from lw_torchrl.data.exchange.parquet import as_arrow, files_of, read_numbers
from lw_torchrl.data.exchange.table import (
    ABOUT,
    NAMES,
    Array,
    ExchangeError,
    Table,
    check_rows,
    lengths_of,
    of_episodes,
    one_each,
)

INFO, ABOUT_FILE = "meta/info.json", f"meta/{ABOUT}.json"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_FILE_MB, _FILES = 100, 1000  # megabytes of a file of steps, and files in a folder
_NAMES = {name: others[0] for name, others in NAMES.items()} | {"observation": "observation.state"}


def _columns(table: Table) -> dict[str, Array]:
    """The columns of the steps' files, under LeRobot's names."""
    frame = np.concatenate([np.arange(length) for length in table.lengths])
    descriptions = [*table.words]
    found = {_NAMES.get(name, name): column for name, column in table.columns.items()}
    return found | {
        "timestamp": (frame / video.FPS).astype(np.float32),
        "frame_index": frame,
        "episode_index": table.of_rows(range(len(table.lengths))),
        "index": np.arange(table.rows),
        "task_index": table.of_rows([descriptions.index(task) for task in table.tasks]),
    }


def _statistics(column: Array, starts: Array, lengths: Array) -> dict[str, Array]:
    """Of each episode of a column: (E, n) each, count (E, 1)."""
    values = column.astype(np.float64).reshape(len(column), -1)
    mean = np.add.reduceat(values, starts) / lengths[:, None]
    square = np.add.reduceat((values - np.repeat(mean, lengths, 0)) ** 2, starts) / lengths[:, None]
    least, most = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    return {"min": least, "max": most, "mean": mean, "std": np.sqrt(square), "count": lengths[:, None]}


def _of_all(each: Mapping[str, Array]) -> dict[str, list[Any]]:
    """The statistics of all rows, of those of the episodes."""
    share = each["count"] / each["count"].sum()
    mean = (each["mean"] * share).sum(0)
    variance = ((each["std"] ** 2 + (each["mean"] - mean) ** 2) * share).sum(0)
    found = {"min": each["min"].min(0), "max": each["max"].max(0), "mean": mean, "std": np.sqrt(variance)}
    return {name: one.tolist() for name, one in (found | {"count": each["count"].sum(0)}).items()}


def _feature(column: Array) -> dict[str, Any]:
    width = column.shape[1] if column.ndim == 2 else 1
    names = [str(place) for place in range(width)] if column.ndim == 2 else None
    return {"dtype": str(column.dtype), "shape": [width], "names": names}


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table, and the pictures that were drawn of its dataset as videos, as a LeRobot dataset."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, lengths = _columns(table), np.asarray(table.lengths)
    starts = lengths.cumsum() - lengths
    of_files = _files_of_rows(columns, lengths)
    # A list of one number is a number in LeRobot's tables.
    arrow = pa.table(
        {name: as_arrow(one.reshape(-1) if one.size == len(one) else one) for name, one in columns.items()}
    )
    for number, (first, last) in enumerate(of_files):
        path = folder / _DATA.format(chunk_index=number // _FILES, file_index=number % _FILES)
        path.parent.mkdir(parents=True, exist_ok=True)
        begin, end = int(starts[first]), int(starts[last - 1] + lengths[last - 1])
        pq.write_table(arrow.slice(begin, end - begin), path, compression="zstd", use_dictionary=False)
        bar.update(end - begin)
    place = np.repeat(np.arange(len(of_files)), [last - first for first, last in of_files])
    episodes: dict[str, Any] = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[table.words[task]] for task in table.tasks],
        "length": lengths,
        "data/chunk_index": place // _FILES,
        "data/file_index": place % _FILES,
        "dataset_from_index": starts,
        "dataset_to_index": starts + lengths,
        "meta/episodes/chunk_index": 0 * lengths,
        "meta/episodes/file_index": 0 * lengths,
    }
    features, whole = {name: _feature(column) for name, column in columns.items()}, {}
    assert table.found is not None
    drawn = video.drawn_pictures(table.found)
    for key, pictures in drawn.items():
        places, each = video.write_videos(table.found, pictures, folder, key)
        features[key] = video.feature_of(pictures)
        episodes |= {f"videos/{key}/{name}": values for name, values in places.items()}
        shaped = {kind: [one.reshape(-1, 1, 1).tolist() for one in values] for kind, values in each.items()}
        shaped["count"] = each["count"].tolist()
        episodes |= {f"stats/{key}/{kind}": values for kind, values in shaped.items()}
        whole[key] = {kind: one if kind == "count" else [[[v]] for v in one] for kind, one in _of_all(each).items()}
    for name, column in columns.items():
        each = _statistics(column, starts, lengths)
        if np.isfinite(each["mean"]).all():  # JSON has no NaN
            whole[name] = _of_all(each)
        episodes |= {f"stats/{name}/{kind}": one.tolist() for kind, one in each.items()}
    (folder / _EPISODES).parent.mkdir(parents=True)
    pq.write_table(pa.table(episodes), folder / _EPISODES)
    pq.write_table(_tasks(table), folder / "meta" / "tasks.parquet")
    info = {
        "codebase_version": "v3.0",
        "robot_type": "sawyer" if "/" not in table.tasks[0] else table.tasks[0].partition("/")[0],
        "total_episodes": len(lengths),
        "total_frames": table.rows,
        "total_tasks": len(table.words),
        "chunks_size": _FILES,
        "data_files_size_in_mb": _FILE_MB,
        "video_files_size_in_mb": 200,
        "fps": video.FPS,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": _DATA,
        "video_path": video.PATH if drawn else None,
        "features": features,
    }
    for name, value in ((INFO, info), ("meta/stats.json", whole), (ABOUT_FILE, table.about)):
        (folder / name).write_text(json.dumps(value, indent=4), encoding="utf-8")


def _files_of_rows(columns: Mapping[str, Array], lengths: Array) -> list[tuple[int, int]]:
    """The first episode of each file, and the one behind its last: as many whole ones as fit into it."""
    width = sum(column.nbytes / len(column) for column in columns.values())
    most, found, first, rows = _FILE_MB * 10**6 / width, [], 0, 0
    for number, length in enumerate(lengths.tolist()):
        if rows and rows + length > most:
            found.append((first, number))
            first, rows = number, 0
        rows += length
    return [*found, (first, len(lengths))]


def _tasks(table: Table) -> Any:
    """The tasks, by their descriptions, which are the table's index for pandas."""
    import pyarrow as pa

    columns = {"task_index": [*range(len(table.words))], "name": [*table.words]}
    columns |= {"plan": [table.plans.get(task, "") for task in table.words], "task": [*table.words.values()]}
    told = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in zip(columns, [("int64", "int64"), *3 * [("unicode", "object")]], strict=True)
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": told, "pandas_version": "2.2.0"}
    return pa.table(columns).replace_schema_metadata({"pandas": json.dumps(pandas)})


def read(source: Path) -> Table:
    """Read a LeRobot dataset of version 3; ExchangeError if it is damaged, or of another version."""
    where = f"source: {str(source)!r}"
    try:
        info = read_json(source / INFO, "source: the description")
        version, features = info["codebase_version"], info["features"]
        if not str(version).startswith("v3"):
            raise ExchangeError(f"{where} is of LeRobot's version {shown(version)}, this package reads v3.0")
        whole = {"features": features} | (features if isinstance(features, dict) else {})
        if odd := [name for name, one in whole.items() if not isinstance(one, dict)]:
            raise ExchangeError(f"{where}: {odd[0]} in {INFO} must be a table, it is {shown(whole[odd[0]])}")
        columns, _, _ = read_numbers(files_of(source / "data"))
        tasks, words, _ = read_numbers([source / "meta" / "tasks.parquet"])
        about = read_json(source / ABOUT_FILE, "source: our metadata") if (source / ABOUT_FILE).is_file() else None
        for name, feature in features.items():
            if feature["dtype"] not in ("video", "image", "string") and name not in columns:
                raise ExchangeError(f"{where} is damaged: it has no {name}, which its {INFO} tells of")
    except ExchangeError:
        raise
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StopIteration) as error:
        raise ExchangeError(f"{where} is no LeRobot dataset, or damaged ({type(error).__name__}: {error})") from error
    rows = info.get("total_frames")
    if type(rows) is not int:
        raise ExchangeError(f"{where}: total_frames in {INFO} must be a whole number, it is {shown(rows)}")
    check_rows(source, columns, rows)
    columns = {name: _shaped(where, name, one, features.get(name)) for name, one in columns.items()}
    if "index" in columns and not np.array_equal(columns["index"].reshape(-1), np.arange(rows)):
        raise ExchangeError(f"{where} is damaged: the index of its rows must go from 0 to {rows - 1}")
    lengths = lengths_of(source, columns)
    name = next((name for name in ("name", "task", "__index_level_0__") if name in words), None)
    if name is None or "task_index" not in columns or "task_index" not in tasks:
        raise ExchangeError(
            f"{where} lacks tasks: meta/tasks.parquet must say which task_index, a number, is which task"
        )
    number = one_each(source, "task_index in meta/tasks.parquet", tasks["task_index"])
    told = dict(zip(number.tolist(), words[name].to_pylist(), strict=True))
    named = of_episodes(source, "task_index", one_each(source, "task_index", columns["task_index"]), lengths, told)
    if None in named:
        raise ExchangeError(f"{where} is damaged: a task_index is not in meta/tasks.parquet")
    return Table(columns, lengths, tuple(map(str, named)), about=about)


def _shaped(where: str, name: str, column: Array, feature: Any) -> Array:
    """A column in the shape that the description gives it; ExchangeError where its rows have another size."""
    if feature is None:
        return column
    shape, size = feature.get("shape"), column[0].size
    if not isinstance(shape, list) or any(type(one) is not int for one in shape) or math.prod(shape) != size:
        told = f"it is {shown(shape)}" if "shape" in feature else "it is absent"
        raise ExchangeError(f"{where}: features.{name}.shape in {INFO} must be a row's, [{size}] for example, {told}")
    return column.reshape(len(column), *shape)
