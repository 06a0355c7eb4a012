"""LeRobot's dataset format, written as version 3, read as version 2.0, 2.1 or 3.

meta/info.json                                    the columns, their types and shapes; the rate of steps
meta/stats.json                                   of each column min, max, mean, std and count
meta/tasks.parquet                                task_index, by the description of the task; its name and plan beside
meta/episodes/chunk-000/file-000.parquet          where each episode is, and its statistics
data/chunk-000/file-000.parquet                   the steps
videos/CAMERA/chunk-000/file-000.mp4              the pictures
meta/lw_torchrl.json                              the metadata of our dataset, which LeRobot does not read

Version 2 has a file of steps for each episode, and ``meta/tasks.jsonl``.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._util.checks import shown
from lw_torchrl._util.files import read_json
from lw_torchrl._util.progress import Progress
from lw_torchrl.data.exchange import video
from lw_torchrl.data.exchange.table import ABOUT, KNOWN, NAMES, Array, ExchangeError, Table

INFO, ABOUT_FILE = "meta/info.json", f"meta/{ABOUT}.json"
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_EPISODES = "meta/episodes/chunk-000/file-000.parquet"
_FILE_MB, _FILES = 100, 1000  # megabytes of a file of steps (about), and files in a folder
_NAMES = {name: others[0] for name, others in NAMES.items()}


def _columns(table: Table) -> dict[str, Array]:
    """The columns of the steps' files, under LeRobot's names."""
    frame = np.concatenate([np.arange(length) for length in table.lengths])
    descriptions = [*table.words]
    return {_NAMES.get(name, name): column for name, column in table.columns.items()} | {
        "timestamp": (frame / table.fps).astype(np.float32),
        "frame_index": frame,
        "episode_index": table.of_rows(range(len(table.lengths))),
        "index": np.arange(table.rows),
        "task_index": table.of_rows([descriptions.index(task) for task in table.tasks]),
    }


def _feature(column: Array) -> dict[str, Any]:
    width = column.size // len(column)
    names = [str(place) for place in range(width)] if column.ndim == 2 else None
    return {"dtype": str(column.dtype), "shape": [width], "names": names}


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table, and the pictures of its dataset as videos, as a LeRobot dataset."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    columns, lengths, spans = _columns(table), np.asarray(table.lengths), [*table.spans()]
    arrow = pa.table({name: _arrow_column(column) for name, column in columns.items()})
    rows_of_file = max(1, int(_FILE_MB * 1e6 / sum(column.nbytes / len(column) for column in columns.values())))
    place = np.array([start // rows_of_file for start, _ in spans])  # the file of each episode
    for number, file in enumerate(dict.fromkeys(place.tolist())):
        own = [span for span, one in zip(spans, place, strict=True) if one == file]
        path = folder / _DATA.format(chunk_index=number // _FILES, file_index=number % _FILES)
        path.parent.mkdir(parents=True, exist_ok=True)
        steps = arrow.slice(own[0][0], own[-1][1] - own[0][0])
        pq.write_table(steps, path, compression="zstd", use_dictionary=False)
        bar.update(len(steps))
    place = np.unique(place, return_inverse=True)[1]
    episodes: dict[str, Any] = {
        "episode_index": np.arange(len(lengths)),
        "tasks": [[table.words[task]] for task in table.tasks],
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
        each = [video.statistics(values[start:end]) for start, end in spans]
        episodes |= {f"stats/{name}/{kind}": [one[kind].tolist() for one in each] for kind in each[0]}
        if np.isfinite(values).all():  # JSON has no NaN
            statistics[name] = {kind: value.tolist() for kind, value in video.combined(each).items()}
    assert table.demonstrations is not None
    for key, pictures in video.existing_pictures(table.demonstrations).items():
        features[key] = video.feature_of(pictures, table.fps)
        places, each = video.write_videos(table.demonstrations, pictures, folder, key, table.fps)
        episodes |= {f"videos/{key}/{name}": column for name, column in places.items()}
        episodes |= {f"stats/{key}/{kind}": [one[kind].tolist() for one in each] for kind in each[0]}
        statistics[key] = {kind: value.tolist() for kind, value in video.combined(each).items()}
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
        "fps": table.fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": _DATA,
        "video_path": video.PATH if any(one["dtype"] == "video" for one in features.values()) else None,
        "features": features,
    }
    for name, value in ((INFO, info), ("meta/stats.json", statistics), (ABOUT_FILE, table.about)):
        (folder / name).write_text(json.dumps(value, indent=4), encoding="utf-8")


def _tasks(table: Table) -> Any:
    """The table of tasks, whose index for pandas is the description."""
    import pyarrow as pa

    columns = {"task_index": [*range(len(table.words))], "name": [*table.words]}
    columns |= {"plan": [table.plans.get(task, "") for task in table.words], "task": [*table.words.values()]}
    described = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, (kind, numpy) in zip(columns, [("int64", "int64"), *3 * [("unicode", "object")]], strict=True)
    ]
    pandas = {"index_columns": ["task"], "column_indexes": [], "columns": described, "pandas_version": "2.2.0"}
    return pa.table(columns).replace_schema_metadata({"pandas": json.dumps(pandas)})


def _arrow_column(column: Array) -> Any:
    """A column as an Arrow array; lists of one number are numbers in LeRobot's tables."""
    import pyarrow as pa

    flat, width = pa.array(np.ascontiguousarray(column).reshape(-1)), column.size // len(column)
    return flat if width == 1 else pa.FixedSizeListArray.from_arrays(flat, width)


def _numbers(name: str, column: Any) -> Array:
    """An Arrow column as numbers, (R,) or (R, n)."""
    import pyarrow as pa

    column = column.combine_chunks()
    if not pa.types.is_nested(column.type):
        values = column
    elif column.null_count or len(column.value_lengths().unique()) > 1:
        raise ExchangeError(f"{name} must hold equally many numbers in each row")
    else:
        values = column.flatten()
    if values.null_count:
        raise ExchangeError(f"{name} must hold a number in each row, {values.null_count} are missing")
    return values.to_numpy(zero_copy_only=False).reshape((len(column), -1) if values is not column else -1)


def _steps(source: Path, frames: Any) -> dict[str, Array]:
    """The known columns of the files of steps, sorted by episode and frame."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    paths = sorted(path for path in (source / "data").rglob("*.parquet") if not path.name.startswith("."))
    rows = sum(pq.read_metadata(path).num_rows for path in paths)
    if not rows or rows != frames:  # before the rows take memory
        raise ExchangeError(f"its data must hold the {frames} steps that {INFO} states, found {rows}")
    known = KNOWN | {"episode_index", "frame_index", "task_index"}
    names = [name for name in pq.read_schema(paths[0]).names if name in known]
    table = pa.concat_tables(pq.read_table(path, columns=names, partitioning=None) for path in paths)
    columns = {name: _numbers(name, table.column(name)) for name in names}
    frame = columns.pop("frame_index", np.arange(rows))
    order = np.lexsort((frame, columns["episode_index"]))
    return {name: column[order] for name, column in columns.items()}


def _task_words(source: Path) -> dict[int, str]:
    """The words of each task_index: our name for it, or the description."""
    import pyarrow.parquet as pq

    lines = source / "meta" / "tasks.jsonl"
    if lines.is_file():  # versions 2.0 and 2.1
        tasks = [json.loads(line) for line in lines.read_text("utf-8").splitlines() if line.strip()]
    else:
        tasks = pq.read_table(source / "meta" / "tasks.parquet").to_pylist()
    names = [name for name in ("name", "task", "__index_level_0__") if name in tasks[0]]
    return {task["task_index"]: str(task[names[0]]) for task in tasks}


def read(source: Path) -> Table:
    """Read a LeRobot dataset of version 2.0, 2.1 or 3.0."""
    info = read_json(source / INFO, "the description")
    if not (version := str(info["codebase_version"])).startswith(("v2.", "v3.")):
        raise ExchangeError(f"it has LeRobot's version {shown(version)}, this package reads v2.0 to v3.0")
    columns = _steps(source, info["total_frames"])
    starts = np.flatnonzero(np.diff(columns["episode_index"], prepend=-1))
    lengths = np.diff(starts, append=len(columns["episode_index"]))
    words, number = _task_words(source), columns.pop("task_index")
    if (number != np.repeat(number[starts], lengths)).any():
        raise ExchangeError("task_index must be the same in all rows of an episode")
    tasks = tuple(words[task] for task in number[starts].tolist())
    about = read_json(source / ABOUT_FILE, "our metadata") if (source / ABOUT_FILE).is_file() else None
    return Table(columns, tuple(lengths.tolist()), tasks, about=about)
