"""The rows of a dataset: a file for each column, memory-mapped, and the checksums of its episodes.

The files are those of ``TensorDict.memmap``, so ``TensorDict.load_memmap`` reads them too. Here they are mapped as
:func:`columns_of` says, so that nothing in the folder can ask for another shape, class or pickle. The map is
copy-on-write: what is written to a column changes it for this process, never the file. The files themselves are not
written through a map, since a full disk under one ends the process silently.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl._checks import counted
from lw_torchrl._files import flush, read_json
from lw_torchrl._progress import Progress
from lw_torchrl.data.dataset import DATA, METADATA, DamagedDatasetError, DatasetError, Demonstrations, EpisodeInfo
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.tasks import task_id

Column = tuple[str, ...]
Columns = Mapping[Column, tuple[tuple[int, ...], torch.dtype]]


@cache
def columns_of(layout: Layout) -> Columns:
    """The columns of a dataset, and what each row of one is: its shape and dtype."""
    observation, action = ((layout.size,), torch.float32), ((layout.action_size,), torch.float32)
    return MappingProxyType(
        {
            ("observation",): observation,
            ("task_id",): ((), torch.int64),
            ("episode",): ((), torch.int64),
            ("action",): action,
            ("expert_action",): action,
            ("unclipped_action",): action,
            ("collector", "traj_ids"): ((), torch.int64),
            ("next", "observation"): observation,
            ("next", "task_id"): ((), torch.int64),
            ("next", "reward_sparse"): ((1,), torch.float32),
            ("next", "reward_dense"): ((1,), torch.float32),
            **{("next", flag): ((1,), torch.bool) for flag in ("success", "done", "terminated", "truncated")},
        }
    )


COLUMNS = columns_of(METAWORLD)
"""Those of Meta-World; other suites' differ in the sizes alone."""
_META = "meta.json"


@cache
def _widths(layout: Layout) -> Mapping[Column, int]:
    return MappingProxyType({key: prod(tail) * dtype.itemsize for key, (tail, dtype) in columns_of(layout).items()})


def row_bytes(layout: Layout) -> int:
    """The bytes of a row in all columns."""
    return sum(_widths(layout).values())


def _path(folder: Path, key: Column) -> Path:
    return folder.joinpath(*key[:-1], f"{key[-1]}.memmap")


def _meta(rows: int, layout: Layout = METAWORLD) -> dict[str, dict[str, Any]]:
    """The description in each folder, as TensorDict writes it; "" is the folder of the rows."""
    found: dict[str, dict[str, Any]] = {"": {}}
    for (*parents, name), (tail, dtype) in columns_of(layout).items():
        for parent in parents:
            found[""][parent] = {"type": "TensorDict"}
        leaf = {"device": "cpu", "shape": [rows, *tail], "dtype": str(dtype), "is_nested": False}
        found.setdefault("/".join(parents), {})[name] = leaf
    about = {"shape": [rows], "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
    return {folder: entries | about for folder, entries in found.items()}


def write_rows(folder: Path, episodes: Iterable[TensorDictBase], layout: Layout) -> None:
    """Write episodes one after another, and flush them to the disk; an :class:`OSError` leaves a part of them."""
    rows = 0
    for name in _meta(0):
        (folder / name).mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        files = {key: stack.enter_context(_path(folder, key).open("wb")) for key in COLUMNS}
        for steps in episodes:
            rows += len(steps)
            for key, file in files.items():
                file.write(steps.get(key).contiguous().numpy().data)
    for name, entries in _meta(rows, layout).items():
        (folder / name / _META).write_text(json.dumps(entries, separators=(",", ":")), encoding="utf-8")
    for path in sorted(folder.rglob("*"), reverse=True):
        flush(path)
    flush(folder)


def read_rows(folder: Path, start: int, length: int, layout: Layout) -> TensorDict | None:
    """Some rows of the files, in memory; None where a column is missing or too short."""
    found = TensorDict({}, [length])
    for key, (tail, dtype) in columns_of(layout).items():
        path, width = _path(folder, key), _widths(layout)[key]
        if not path.is_file() or path.stat().st_size < (start + length) * width:
            return None
        with path.open("rb") as file:
            file.seek(start * width)
            content = bytearray(file.read(length * width))
        found.set(key, torch.frombuffer(content, dtype=dtype).reshape(length, *tail))
    return found


def describe_episode(task: str, episode: int, start: int, rows: TensorDictBase) -> EpisodeInfo:
    checksum = 0
    for key in COLUMNS:
        checksum = crc32(rows.get(key).contiguous().numpy().data, checksum)
    hits = rows.get(("next", "success")).flatten().nonzero().flatten()
    first = int(hits[0]) + 1 if len(hits) else None
    return EpisodeInfo(task, episode, start, len(rows), first is not None, first, checksum)


def _surplus(folder: Path) -> list[str]:
    """Files among the rows that are no part of them; hidden files do not count."""
    ours = {_path(folder, key) for key in COLUMNS} | {folder / name / _META for name in _meta(0)}
    folders = {folder / name for name in _meta(0)}
    there = [path for one in folders if one.is_dir() for path in one.iterdir() if not path.name.startswith(".")]
    return sorted(str(path.relative_to(folder)) for path in there if path not in ours | folders)


def holds_columns(folder: Path) -> bool:
    return any(_path(folder, key).is_file() for key in COLUMNS) and not _surplus(folder)


def _check_files(folder: Path, rows: int, layout: Layout) -> None:
    """Raise unless the files are as they were written; mapping one that is too short would lengthen it."""
    for name, expected in _meta(rows, layout).items():
        found = read_json(folder / name / _META, "the description", limit=2**20)
        if not name and found.get("shape") != [rows]:
            raise ValueError(f"they are of shape {found.get('shape')}, the metadata say {rows} rows")
        if odd := [key for key in {**expected, **found} if expected.get(key) != found.get(key)]:
            raise ValueError(f"{name}/{_META} differs from what was written, in {', '.join(map(repr, odd[:5]))}")
    for key, width in _widths(layout).items():
        if (size := _path(folder, key).stat().st_size) != rows * width:
            raise ValueError(f"{'/'.join(key)}.memmap has {size} bytes, not {rows * width}")


class MappedColumn(Tensor):
    """A column in its file. A spawned process maps the file again; what is computed from it is a plain tensor."""

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]
    _source: tuple[Path, tuple[int, ...], torch.dtype]

    @staticmethod
    def of(path: Path, shape: tuple[int, ...], dtype: torch.dtype) -> MappedColumn:
        """Map a file that holds exactly such a column; OSError, ValueError or RuntimeError for another."""
        content = torch.from_numpy(np.memmap(path, np.uint8, "c"))
        column = content.view(dtype).view(shape).as_subclass(MappedColumn)
        column._source = (path.absolute(), shape, dtype)
        return column

    def __reduce_ex__(self, protocol: Any) -> Any:
        return MappedColumn.of, self._source

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        return self.clone()


def damaged(what: str) -> DamagedDatasetError:
    """The error for a dataset's rows that are not as they were written; the caller raises it."""
    again = "the same collect_demonstrations keeps the episodes that are whole and collects the others again"
    return DamagedDatasetError(f"root: {what}; {again}")


def map_rows(demonstrations: Demonstrations) -> TensorDict:
    """The rows of a dataset as in the files, memory-mapped; DatasetError if these are not as the metadata say."""
    folder, number = demonstrations.root / DATA, demonstrations.num_steps
    if odd := _surplus(folder):
        listed = ", ".join(map(repr, odd[:5]))
        raise DatasetError(f"root: {listed} in {str(folder)!r} is no part of a dataset; move it elsewhere")
    try:
        _check_files(folder, number, demonstrations.config.layout)
        columns = columns_of(demonstrations.config.layout).items()
        found = {key: MappedColumn.of(_path(folder, key), (number, *like[0]), like[1]) for key, like in columns}
    except (OSError, ValueError, RuntimeError) as error:
        raise damaged(f"the rows in {str(folder)!r} cannot be read ({error})") from error
    return TensorDict(found, [number], device="cpu")


def load_rows(demonstrations: Demonstrations) -> TensorDict:
    """:func:`map_rows`; if tasks had other numbers once, both ``task_id`` are the present ones, in memory."""
    rows = map_rows(demonstrations)
    if any(task_id(task) != stored for task, stored in demonstrations.task_ids.items()):
        episodes = demonstrations.episodes
        lengths = torch.tensor([episode.length for episode in episodes])
        now = torch.tensor([task_id(episode.task) for episode in episodes]).repeat_interleave(lengths)
        rows.set("task_id", now)
        rows.set(("next", "task_id"), now.clone())
    return rows


READ_AT_ONCE = 2 * 2**30  # bytes of rows that are verified when a dataset is opened
_SETTLED = 3 * 10**9  # ns; a younger file may be written again with the same time
# For each folder, what :func:`_files` gave when this process verified episodes of it, and which.
_VERIFIED: dict[Path, tuple[tuple[tuple[int, ...], ...], set[EpisodeInfo]]] = {}


def _as_written(demonstrations: Demonstrations, info: EpisodeInfo, rows: TensorDictBase) -> bool:
    stated = {"task_id": demonstrations.task_ids[info.task], "episode": info.episode}
    same = all(bool((rows.get(key) == value).all()) for key, value in stated.items())
    return same and describe_episode(info.task, info.episode, info.start, rows) == info


def whole_episodes(demonstrations: Demonstrations, *, progress: bool) -> list[EpisodeInfo]:
    """The episodes whose rows are as they were written; a column may be too short for other episodes."""
    whole = []
    with Progress("checking", len(demonstrations.episodes), "episode", show=progress) as bar:
        for info in demonstrations.episodes:
            rows = read_rows(demonstrations.root / DATA, info.start, info.length, demonstrations.config.layout)
            bar.update()
            if rows is not None and _as_written(demonstrations, info, rows):
                whole.append(info)
    return whole


def _files(root: Path) -> tuple[tuple[int, ...], ...]:
    found = [path.stat() for path in (root / METADATA, *(_path(root / DATA, key) for key in COLUMNS))]
    return tuple((one.st_dev, one.st_ino, one.st_size, one.st_mtime_ns, one.st_ctime_ns) for one in found)


def verify(demonstrations: Demonstrations, episodes: Sequence[EpisodeInfo], *, every: bool = True) -> None:
    """Check episodes of a dataset against their checksums, unless this process has and the files are as they were then;
    DatasetError if they differ. Without ``every``, at most :data:`READ_AT_ONCE` bytes are read, spread evenly."""
    rows, root = map_rows(demonstrations), demonstrations.root.resolve()
    files = _files(root)
    before, known = _VERIFIED.get(root, (files, set()))
    known = known if before == files else set()
    size = sum(info.length for info in episodes) * row_bytes(demonstrations.config.layout)
    asked = episodes if every else episodes[:: -(-size // READ_AT_ONCE)]
    unknown = ((info, rows[info.start : info.start + info.length]) for info in asked if info not in known)
    if broken := [info for info, own in unknown if not _as_written(demonstrations, info, own)]:
        listed = ", ".join(f"{info.episode} of {info.task!r}" for info in broken[:5]) + ", ..." * (len(broken) > 5)
        differ = f"{counted(len(broken), 'episode')} of {len(asked)} differ from their checksums, {listed}"
        raise damaged(f"the rows in {str(demonstrations.root)!r} are not as they were written: {differ}")
    if max(max(one[3:]) for one in files) < time.time_ns() - _SETTLED:
        _VERIFIED[root] = (files, known | set(asked))
