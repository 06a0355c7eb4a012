"""Read the columns of LeRobot, Minari, robomimic, LIBERO and ManiSkill files; run as a script in a child process.

pyarrow and HDF5 trust the sizes that a file declares: some files of a few kilobytes make them allocate gigabytes, or
never return. Therefore the parent process runs this file as a script, with a limit on memory and on time. The script
compares the declared sizes with the files' sizes, reads only the columns that a dataset requires, and writes

    out/table.json          the episodes' lengths and possible task names, and the names of the columns; or an error
    out/COLUMN.npy          a column (R, ...) of numbers

The script imports only NumPy, pyarrow and h5py, and no other module of the package, so that it starts quickly.

LeRobot      meta/info.json, meta/tasks.jsonl or .parquet, meta/episodes.jsonl or meta/episodes/*/*.parquet (all
             optional), and parquet files in data/ with episode_index, frame_index, task_index and the columns
HDF5         a group for each episode in "data" or at the root, with actions (T, n); other columns have T or T + 1 rows.
             Without such groups, the arrays at the root or in "data" hold all episodes one after another.
             The task is an attribute of the group, of "data" or of the file, or is in a JSON file with the same name
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray[Any, Any]
NAMES: Mapping[str, tuple[str, ...]] = {
    "action": ("action", "actions"),
    "observation": (
        "observation.state", "observation.environment_state", "observation", "observations",
        "observations.observation", "obs.state", "obs.flat", "obs", "states", "state",
    ),
    "expert_action": ("expert_action", "infos.expert_action"),
    "unclipped_action": ("unclipped_action", "infos.unclipped_action"),
    "next_observation": (
        "next.observation", "next_observation", "infos.next_observation", "next_obs.state", "next_obs.flat",
        "next_obs", "next_observations",
    ),
    "reward_sparse": ("next.reward_sparse", "reward_sparse", "infos.reward_sparse"),
    "reward_dense": ("next.reward", "next.reward_dense", "reward", "rewards", "reward_dense"),
    "success": ("next.success", "success", "successes", "is_success", "infos.success", "infos.is_success"),
    "done": ("next.done", "done", "dones"),
    "terminated": ("next.terminated", "terminated", "terminations", "terminals"),
    "truncated": ("next.truncated", "truncated", "truncations", "timeouts"),
}  # fmt: skip
"""The names that files use for each column, the most likely first; nested names are joined by dots."""
TASK_NAMES = (
    "task", "task_name", "language_instruction", "instruction", "task_description", "language", "lang", "env_name",
    "env_id", "task_id", "task_index",
)  # fmt: skip
"""The names under which files store an episode's task: HDF5 attributes, columns and JSON keys."""
_AFTER = ("reward_sparse", "reward_dense", "success", "done", "terminated", "truncated")  # results of the last step
HDF5, PARQUET = (".hdf5", ".h5", ".hdf"), (".parquet", ".pq")


class Refused(Exception):
    """An error for files that are not damaged but cannot be imported."""


def data_files(source: Path, endings: Sequence[str]) -> list[Path]:
    """Return the files below a path that have one of the endings, sorted by name, with numbers in order of value.

    Hidden files are left out, for example the companions ``._NAME`` that macOS writes to shared disks.
    """
    if source.is_file():
        return [source]
    paths = [path.relative_to(source) for path in source.rglob("*") if path.suffix.lower() in endings]
    hidden = re.compile(r"\.|~|__MACOSX$")
    visible = [path for path in paths if not any(map(hidden.match, path.parts)) and (source / path).is_file()]
    return [source / path for path in sorted(visible, key=lambda path: [*map(natural, path.parts)])]


def natural(name: str) -> str:
    """Return a key that sorts names with numbers by the values of the numbers."""
    return re.sub(r"\d+", lambda digits: digits[0].zfill(20), name)


def stored_bytes(paths: Iterable[Path]) -> int:
    """Return the number of bytes that files occupy on disk, without the holes of sparse files."""
    states = [path.stat() for path in paths]
    return sum(min(state.st_size, state.st_blocks * 512) for state in states)


class Files:
    """The episodes that :func:`read_parquet` or :func:`read_hdf5` reads, and the columns to read."""

    def __init__(self, widths: Mapping[str, int], allowed: int) -> None:
        self.widths = widths  # the number of values per row of each column to read
        self.allowed = allowed  # the number of bytes that may still be read
        self.columns: dict[str, Array] = {}
        self.sources: dict[str, str] = {}  # for each column that was read, its name in the files
        self.unfit: dict[str, str] = {}  # for each column whose size does not fit, its name in the files
        self.lengths: list[int] = []
        self.tasks: list[list[str]] = []  # the possible task names of each episode
        self.ends_known = True  # whether the files state where episodes end
        self.notes: list[str] = []  # messages about data that the files lack

    def reserve(self, name: str, size: float) -> None:
        """Raise :class:`Refused` if a column of ``size`` bytes is too large for the files."""
        self.allowed -= int(size)
        if self.allowed < 0:
            raise Refused(f"{name} declares {size / 1e6:,.0f} MB or more, which is too much for files of this size")

    def choose(self, column: str, fits: Mapping[str, bool]) -> str | None:
        """Return the name of the file column that holds the dataset's ``column``: the first known name that
        ``fits``, or None."""
        present = [name for name in NAMES[column] if name in fits]
        if fitting := [name for name in present if fits[name]]:
            self.sources[column] = fitting[0]
        elif present:
            self.unfit[column] = present[0]
        return self.sources.get(column)

    def require(self, column: str, seen: Mapping[str, float]) -> None:
        """Raise :class:`Refused` unless a name was chosen for a column. ``seen`` maps each column in the files to its
        number of values per row."""
        if column not in self.sources:
            sizes = {name: f"{width:g}" if width % 1 == 0 else "different sizes" for name, width in seen.items()}
            listed = ", ".join(f"{name} ({size})" for name, size in [*sizes.items()][:20]) or "unknown"
            raise Refused(f"column {column!r} needs {self.widths[column]} numbers per row; the columns are {listed}")

    def save(self, out: Path) -> None:
        """Write the columns and the description."""
        for name, column in self.columns.items():
            with (out / f"{name}.npy").open("wb") as file:  # the errors of np.save do not state their cause
                column = np.ascontiguousarray(column)
                np.lib.format.write_array_header_2_0(file, np.lib.format.header_data_from_array_1_0(column))
                file.write(column.data)
        names = ("lengths", "tasks", "sources", "unfit", "ends_known", "notes")
        _report(out, columns=[*self.columns], **{name: getattr(self, name) for name in names})


# ---- parquet


def read_parquet(source: Path, files: Files) -> None:
    """Read a LeRobot dataset, or parquet files with LeRobot's columns."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    meta = source / "meta"
    info = json.loads((meta / "info.json").read_text("utf-8-sig")) if (meta / "info.json").is_file() else {}
    version = str(info.get("codebase_version", "v3.0"))
    if not version.startswith(("v2.", "v3.")):
        raise Refused(f"LeRobot format version {version[:20]!r} is not supported; use v2.0 to v3.0")
    paths = data_files(source / "data" if (source / "data").is_dir() else source, PARQUET)
    paths = [path for path in paths if not path.is_relative_to(meta)]
    leaves = [_leaves(pq.read_metadata(path)) for path in paths]
    of_file = [rows for rows, _ in leaves]
    if not (rows := sum(of_file)):
        raise Refused("the data files hold no time steps")
    everywhere = set.intersection(*({*columns} for _, columns in leaves))
    values = {name: sum(columns[name][1] for _, columns in leaves) for name in sorted(everywhere)}
    chosen = {}
    for column, width in files.widths.items():
        fits = {name: all(columns[name][1:] == (of * width, True) for of, columns in leaves) for name in values}
        if name := files.choose(column, fits):
            chosen[name] = column
    seen = {name: values[name] / rows for name in values}
    files.require("action", seen)
    files.require("observation", seen)
    index = [name for name in ("episode_index", "frame_index", "task_index") if values.get(name) == rows]
    # The path of a column that is not a list equals its name.
    plain = [name for name in TASK_NAMES if all(columns.get(name, ("",))[0] == name for _, columns in leaves)]
    texts = [name for name in plain if values[name] == rows and name not in index]
    parts: dict[str, list[Array]] = {name: [] for name in (*chosen, *index, *texts)}
    for name in parts:
        files.reserve(name, 8 * values[name])
    for path, (_, columns) in zip(paths, leaves, strict=True):
        with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
            table = file.read(columns=[columns[name][0] for name in parts], use_threads=False)
        while any(str(field.type).startswith("struct") for field in table.schema):
            table = table.flatten()
        read = dict(zip(reversed(table.column_names), reversed(table.columns), strict=True))
        for name in [*parts]:
            column = read[name].combine_chunks()
            try:
                strings = np.array(column.cast(pa.string()).to_pylist(), dtype=object) if name in texts else None
                parts[name].append(_numbers(name, column) if strings is None else strings)
            except Refused:
                if chosen.get(name, "action") in ("action", "observation"):
                    raise
                files.unfit[chosen.pop(name)] = name  # an optional column
                del parts[name]
    read = {name: np.concatenate(arrays) for name, arrays in parts.items()}
    read |= {name: _whole(name, read[name]) for name in index}
    file_numbers = np.repeat(np.arange(len(of_file)), of_file)
    is_episode = all(re.match(r"episode\D*\d+$", path.stem, re.IGNORECASE) for path in paths)
    order = _find_episodes(meta, files, read, [name for name in texts if name in read], file_numbers, is_episode)
    files.columns = {column: read[name][order] for name, column in chosen.items()}
    if (frames := info.get("total_frames", rows)) != rows:
        files.notes.append(f"time steps: meta/info.json lists {frames}, but the data files hold {rows}")


def _leaves(metadata: Any) -> tuple[int, dict[str, tuple[str, int, bool]]]:
    """Return the number of rows of a parquet file, and a mapping from the name of each leaf column to its path, its
    number of values and whether these are numbers. Names omit the levels of lists: "action.list.element" becomes
    "action"."""
    leaves: dict[str, tuple[str, int, bool]] = {}
    for place in range(metadata.num_columns):
        number = sum(metadata.row_group(group).column(place).num_values for group in range(metadata.num_row_groups))
        column = metadata.schema.column(place)
        name = re.sub(r"(\.(list|bag|array|array_element|element|item))+$", "", column.path)
        kind = column.logical_type.type
        is_number = kind == "FLOAT16" or (kind in ("NONE", "INT") and "BYTE" not in column.physical_type)
        leaves.setdefault(name, (column.path, number, is_number))
    return metadata.num_rows, leaves


def _numbers(name: str, column: Any) -> Array:
    """Convert an Arrow column to numbers (R,) or (R, n); absent numbers become NaN."""
    import pyarrow as pa

    rows = len(column)
    while pa.types.is_nested(column.type):
        if column.null_count or len(column.value_lengths().unique()) > 1:
            raise Refused(f"{name} must have the same number of values in every row")
        column = column.flatten()
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if column.null_count and not pa.types.is_floating(column.type):
        column = column.cast(pa.float64())
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "biuf":
        raise Refused(f"{name} must hold numbers, but holds values of type {column.type}")
    return values if len(values) == rows else values.reshape(rows, -1)


def _whole(name: str, column: Array) -> Array:
    """Convert a column of indices to integers; raise :class:`Refused` if a number is not whole, such as 0.5 or NaN."""
    column = column.reshape(len(column))
    if column.dtype.kind == "f" and (odd := column[~(np.isfinite(column) & (column == np.round(column)))]).size:
        raise Refused(f"{name} must hold whole numbers, but holds {odd[0]}")
    return column.astype(np.int64)


def _find_episodes(
    meta: Path, files: Files, read: Mapping[str, Array], texts: Sequence[str], file: Array, is_episode: bool
) -> Array:
    """Find the length and the tasks of each episode, and return the order (R,) of the rows by episode and time.

    ``file`` (R,) is the number of each row's file, and ``is_episode`` is true for files that are named as episodes.
    """
    rows, listed, names = len(file), _listed(meta, "episodes"), _listed(meta, "tasks")
    frame = read.get("frame_index", np.zeros(rows, np.int64))
    if "episode_index" in read:
        episode = read["episode_index"]
    elif is_episode:
        episode = file
    elif sum(lengths := [each.get("length", 0) for _, each in sorted(listed.items())]) == rows:
        episode = np.repeat(sorted(listed), lengths)
    else:  # an episode must begin wherever the task changes or the frame numbers start again
        restarts = frame == frame.min()
        files.ends_known = "frame_index" in read and bool(restarts.sum() > 1)
        marks = [read["task_index"]] if "task_index" in read else [read[name] for name in texts]
        changes = [np.concatenate([[False], ~_same(mark)]) for mark in marks]
        changes += [restarts] * files.ends_known
        episode, frame = np.cumsum(np.any(changes or [np.zeros(rows, bool)], axis=0)), np.arange(rows)
    order = np.lexsort((frame, episode))
    same = _same(episode[order])
    if "frame_index" in read and (same & _same(frame[order])).any():
        order = np.lexsort((frame, episode, file))  # each file has its own numbering of episodes
        same = _same(episode[order]) & _same(file[order])
        if (same & _same(frame[order])).any():
            raise Refused("frame_index must differ between the rows of an episode")
    starts = np.flatnonzero(np.concatenate([[True], ~same]))
    files.lengths = np.diff(starts, append=rows).tolist()
    for start, length in zip(starts.tolist(), files.lengths, strict=True):
        of_episode = order[start : start + length]
        number = int(episode[of_episode[0]])
        about = listed.get(number, {}) if "episode_index" in read else {}
        if about.get("length", length) != length:
            raise Refused(f"episode {number} has {length} rows, but the metadata lists {about['length']}")
        tasks = [*(about.get("tasks") or ())]
        for name in texts:
            tasks += values if len(values := {*read[name][of_episode]}) == 1 else ()
        if "task_index" in read and len(values := {*read["task_index"][of_episode].tolist()}) == 1:
            about = names.get(next(iter(values)), {})
            tasks += [about.get(name) for name in ("name", "task", "__index_level_0__")] + [*values]
        files.tasks.append([*dict.fromkeys(str(task) for task in tasks if task is not None)])
    return order


def _same(column: Array) -> Array:
    """Return, for each row except the first, whether its value equals the value of the previous row."""
    return np.asarray(column[1:] == column[:-1])


def _listed(meta: Path, kind: str) -> dict[int, dict[str, Any]]:
    """Read LeRobot's list of "episodes" or "tasks" from JSON Lines or Parquet files, by index."""
    import pyarrow.parquet as pq

    names = ("episode_index", "length", "tasks", "task_index", "name", "task", "__index_level_0__")
    records: list[Any] = []
    if (lines := meta / f"{kind}.jsonl").is_file():
        records = [json.loads(line) for line in lines.read_text("utf-8-sig").splitlines() if line.strip()]
    elif meta.is_dir():
        single = meta / f"{kind}.parquet"
        for path in [single] if single.is_file() else data_files(meta / kind, PARQUET):
            with pq.ParquetFile(path, pre_buffer=False, page_checksum_verification=True) as file:
                leaves = [leaf for name, (leaf, _, _) in _leaves(file.metadata)[1].items() if name in names]
                records += file.read(columns=leaves).to_pylist()
    key = f"{kind[:-1]}_index"
    return {row[key]: row for row in records if isinstance(row, dict) and isinstance(row.get(key), int)}


# ---- HDF5


def read_hdf5(source: Path, files: Files) -> None:
    """Read the HDF5 files at a path."""
    import h5py

    paths = data_files(source, HDF5)
    shapes: list[dict[str, tuple[int, ...]]] = []
    for path in paths:
        path.open("rb").close()  # HDF5's own errors do not distinguish limits of the system from damaged files
        with h5py.File(path, "r") as file:
            for group, known in _groups(file):
                files.ends_known &= known
                shapes.append({name: item.shape for name, item in _items(group)})
    if not shapes:
        raise Refused("the files hold no group with actions, such as data/demo_0, and no actions at the root")
    seen = {name: float(np.prod(shape[1:])) for name, shape in shapes[0].items()}
    everywhere = set.intersection(*({*shape} for shape in shapes))

    def fits(name: str, width: int, steps: Sequence[int] | None) -> bool:
        is_wide = all(np.prod(shape[name][1:], dtype=float) == width for shape in shapes)
        return is_wide and (steps is None or all(s[name][0] - n in (0, 1) for s, n in zip(shapes, steps, strict=True)))

    steps = None
    for column, width in files.widths.items():
        name = files.choose(column, {name: fits(name, width, steps) for name in everywhere})
        if column == "action":
            files.require("action", seen)
            steps = [shape[name][0] for shape in shapes if name]
    files.require("observation", seen)
    for name in files.sources.values():
        files.reserve(name, sum(8 * np.prod(shape[name], dtype=float) for shape in shapes))
    parts: list[dict[str, Array]] = []
    for path in paths:
        with h5py.File(path, "r") as file:
            about = [*_texts(_companion(path))]
            for group, known in _groups(file):
                items = dict(_items(group))
                parts.append(_steps({column: items[name][()] for column, name in files.sources.items()}))
                above = (group, group.parent, file) if known else (group, file)
                texts = [text for each in above for text in _texts({**each.attrs})]
                files.tasks.append(list(dict.fromkeys([*_texts_of_items(group), *texts, *about])))
    files.lengths = [len(part["action"]) for part in parts]
    columns = set.intersection(*({*part} for part in parts))
    files.columns = {name: np.concatenate([part[name] for part in parts]) for name in columns}


def _groups(file: Any) -> Iterator[tuple[Any, bool]]:
    """Yield (group, is_single) for each group of a file that holds episodes. ``is_single`` is False for a group that
    holds several episodes one after another."""
    import h5py

    for container in [file["data"], file] if isinstance(file.get("data"), h5py.Group) else [file]:
        links = ((name, container.get(name, getlink=True)) for name in sorted(container, key=natural))
        own = [name for name, link in links if re.search(r"\d$", name) and not isinstance(link, h5py.ExternalLink)]
        groups = [container[name] for name in own if container.get(name, getclass=True) is h5py.Group]
        if groups:
            if lacking := [group.name for group in groups if not _has_actions(group)]:
                if len(lacking) == len(groups):
                    continue
                raise Refused(f"{lacking[0]} has no actions")
            yield from ((group, True) for group in groups)
            return
        if _has_actions(container):
            yield container, False
            return


def _has_actions(group: Any) -> bool:
    return any(name in group for name in NAMES["action"])


def _items(group: Any) -> Iterator[tuple[str, Any]]:
    """Yield the arrays of numbers in a group that have a known name."""
    import h5py

    inside = {*group}
    for name in (name for names in NAMES.values() for name in names):
        for path in {name, name.replace(".", "/")}:
            if path.partition("/")[0] not in inside or path not in group:
                continue
            item = group[path]
            if isinstance(item, h5py.Dataset) and item.dtype.kind in "biuf" and item.ndim:
                yield name, item


def _steps(columns: Mapping[str, Array]) -> dict[str, Array]:
    """Return the columns with one row for each of T time steps. T + 1 rows of observations become the observations
    before and after each step."""
    steps = len(columns["action"])
    of_steps: dict[str, Array] = {}
    for name, column in columns.items():
        if len(column) == steps:
            of_steps[name] = column
        else:
            of_steps[name] = column[1:] if name in _AFTER else column[:-1]
            if name == "observation" and "next_observation" not in columns:
                of_steps["next_observation"] = column[1:]
    return of_steps


def _companion(path: Path) -> Any:
    """Read the JSON file that ManiSkill or Minari writes next to an HDF5 file, if there is one."""
    for beside in (path.with_suffix(".json"), path.with_name("metadata.json")):
        with suppress(ValueError, RecursionError):
            if beside.is_file():
                return json.loads(beside.read_text("utf-8-sig"))
    return None


def _texts(value: Any) -> Iterator[str]:
    """Yield the values of the keys in TASK_NAMES in a mapping, in nested mappings, and in texts that contain JSON."""
    if isinstance(value, Mapping):
        for name in TASK_NAMES:
            yield from _plain_texts(value.get(name))
        for inner in value.values():
            yield from _texts(inner)
        return
    for text in _plain_texts(value):
        if text.startswith("{"):
            with suppress(ValueError, RecursionError):
                yield from _texts(json.loads(text))


def _texts_of_items(group: Any) -> Iterator[str]:
    """Yield the first values of a group's arrays that state the task."""
    import h5py

    for name in TASK_NAMES:
        if name in group and isinstance(item := group[name], h5py.Dataset) and item.size:
            yield from _plain_texts(item[(0,) * item.ndim])


def _plain_texts(value: Any) -> Iterator[str]:
    """Yield a text or whole number as an unquoted string; for an array, yield only its first element."""
    if isinstance(value, (list, np.ndarray)):
        value = np.asarray(value, dtype=object).flatten()[0] if np.size(value) else None
    if isinstance(value, bytes):
        value = value.decode("utf-8", "replace")
    if isinstance(value, (str, int, np.integer)):
        yield str(value).strip().strip("\"'")


# ---- the child process


def _report(out: Path, **values: Any) -> None:
    (out / "table.json").write_text(json.dumps(values), encoding="utf-8")


def main(source: Path, out: Path, is_hdf5: bool, allowed: int, widths: Mapping[str, int]) -> None:
    """Read files, and write the columns or the error to the folder ``out``."""
    try:
        files = Files(widths, allowed)
        (read_hdf5 if is_hdf5 else read_parquet)(source, files)
        files.save(out)
    except Refused as error:
        _report(out, refused=str(error))
    except ImportError as error:
        _report(out, missing=error.name)
    except MemoryError:
        _report(out, refused="the files declare more numbers than files of this size may hold")
    except OSError as error:
        if error.errno is None:
            _report(out, refused=f"the files are corrupted ({error!r})")
        else:
            _report(out, system=[error.errno, error.strerror, str(error.filename or source)])
    except Exception as error:  # pyarrow and h5py raise many kinds of errors for corrupted files
        _report(out, refused=f"the files are corrupted ({error!r})")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *json.loads(sys.argv[3]))
