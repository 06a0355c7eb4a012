"""Whether the rows of a dataset are as they were written, by the checksums of its episodes."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from tensordict import TensorDictBase

from lw_torchrl._checks import counted
from lw_torchrl._progress import Progress
from lw_torchrl.data.dataset import DATA, METADATA, DamagedDatasetError, Demonstrations, EpisodeInfo
from lw_torchrl.data.rows import ROW_BYTES, column_files, describe_episode, map_rows, read_rows

READ_AT_ONCE = 2 * 2**30
"""Bytes of rows that are read through when a dataset is opened; of a larger one, so many, spread evenly."""

_SETTLED = 3 * 10**9  # ns; a file that was written less long ago may be written again under the same time


class _Read(NamedTuple):
    """What this process has read through of a dataset: while the files are the same, it is not read again."""

    files: tuple[tuple[int, ...], ...]
    episodes: set[EpisodeInfo]


_READ: dict[Path, _Read] = {}


def _as_written(demonstrations: Demonstrations, info: EpisodeInfo, rows: TensorDictBase) -> bool:
    return (
        describe_episode(info.task, info.episode, info.start, rows) == info
        and bool((rows.get("task_id") == demonstrations.task_ids[info.task]).all())
        and bool((rows.get("episode") == info.episode).all())
    )


def whole_episodes(demonstrations: Demonstrations, *, progress: bool) -> list[EpisodeInfo]:
    """The episodes whose rows are as they were written, by their checksums and what else the metadata say of them.

    Columns that are missing or too short do not matter for the episodes that are there.
    """
    whole = []
    with Progress("checking", len(demonstrations.episodes), "episode", show=progress) as bar:
        for info in demonstrations.episodes:
            rows = read_rows(demonstrations.root / DATA, info.start, info.length)
            bar.update()
            if rows is not None and _as_written(demonstrations, info, rows):
                whole.append(info)
    return whole


def _files(root: Path) -> tuple[tuple[int, ...], ...]:
    """What changes when a dataset's files do."""
    found = [path.stat() for path in (root / METADATA, *column_files(root / DATA))]
    return tuple((one.st_dev, one.st_ino, one.st_size, one.st_mtime_ns, one.st_ctime_ns) for one in found)


def verify(demonstrations: Demonstrations, episodes: Sequence[EpisodeInfo], *, every: bool = True) -> None:
    """Read episodes of a dataset through, unless this process has and the files are as they were.

    Args:
        demonstrations: the whole dataset's description.
        episodes: those of it that matter.
        every: read all of them, however many; otherwise of :data:`READ_AT_ONCE` bytes at most, spread evenly.

    Raises:
        DatasetError: (a ValueError) rows differ from their checksums, or cannot be read at all.
    """
    rows, root = map_rows(demonstrations), demonstrations.root.resolve()
    files = _files(root)
    known = found if (found := _READ.get(root)) is not None and found.files == files else _Read(files, set())
    size = sum(info.length for info in episodes) * ROW_BYTES
    asked = episodes if every else episodes[:: -(-size // READ_AT_ONCE)]
    broken = [
        info
        for info in asked
        if info not in known.episodes
        and not _as_written(demonstrations, info, rows[info.start : info.start + info.length])
    ]
    if broken:
        listed = ", ".join(f"{info.episode} of {info.task!r}" for info in broken[:5]) + ", ..." * (len(broken) > 5)
        raise DamagedDatasetError(
            f"root: the rows in {str(demonstrations.root)!r} are not as they were written: "
            f"{counted(len(broken), 'episode')} of {len(asked)} differ from their checksums, {listed}; the same "
            "collect_demonstrations keeps the others and runs these again"
        )
    if max(max(one[3:]) for one in files) < time.time_ns() - _SETTLED:
        _READ[root] = _Read(files, known.episodes | set(asked))
