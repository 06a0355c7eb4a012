"""The rows of a dataset: a file for each column, memory-mapped, and the checksums of its episodes.

The files are those of ``TensorDict.memmap``, so ``TensorDict.load_memmap`` reads them too. Here their shapes come from
:func:`columns_of`, and nothing is unpickled. The map is copy-on-write: a write to a column changes it for this process,
never the file. The files are not written through a map, since a full disk under a map ends the process silently.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import ExitStack
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any
from zlib import crc32

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from lw_torchrl._util.files import flush
from lw_torchrl._util.progress import Progress
from lw_torchrl.data.dataset import DATA, METADATA, Demonstrations, EpisodeInfo, damaged
from lw_torchrl.language.layout import METAWORLD, Layout

Column = tuple[str, ...]
Columns = Mapping[Column, tuple[tuple[int, ...], torch.dtype]]


@cache
def columns_of(layout: Layout) -> Columns:
    """The columns of a dataset with the shape and dtype of a row."""
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
"""Meta-World's columns; those of other suites have other sizes."""
_META = "meta.json"


def _path(folder: Path, key: Column) -> Path:
    return folder.joinpath(*key[:-1], f"{key[-1]}.memmap")


def _meta(rows: int, layout: Layout = METAWORLD) -> dict[str, dict[str, Any]]:
    """The description in each folder, as TensorDict writes it; "" is the folder of the rows."""
    folders: dict[str, dict[str, Any]] = {"": {}}
    for (*parents, name), (tail, dtype) in columns_of(layout).items():
        for parent in parents:
            folders[""][parent] = {"type": "TensorDict"}
        leaf = {"device": "cpu", "shape": [rows, *tail], "dtype": str(dtype), "is_nested": False}
        folders.setdefault("/".join(parents), {})[name] = leaf
    about = {"shape": [rows], "device": "cpu", "_type": "<class 'tensordict._td.TensorDict'>"}
    return {folder: entries | about for folder, entries in folders.items()}


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


def describe_episode(task: str, episode: int, start: int, rows: TensorDictBase) -> EpisodeInfo:
    checksum = 0
    for key in COLUMNS:
        checksum = crc32(rows.get(key).contiguous().numpy().data, checksum)
    hits = rows.get(("next", "success")).flatten().nonzero().flatten()
    first = int(hits[0]) + 1 if len(hits) else None
    return EpisodeInfo(task, episode, start, len(rows), first is not None, first, checksum)


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


def load_rows(demonstrations: Demonstrations) -> TensorDict:
    """The rows of a dataset as in the files, memory-mapped; DatasetError if a file is missing or has another size."""
    folder, number = demonstrations.root / DATA, demonstrations.num_steps
    columns = {}
    try:
        for key, (tail, dtype) in columns_of(demonstrations.config.layout).items():
            columns[key] = MappedColumn.of(_path(folder, key), (number, *tail), dtype)
    except (OSError, ValueError, RuntimeError) as error:
        raise damaged(f"the rows in {str(folder)!r} are damaged ({error})") from error
    return TensorDict(columns, [number], device="cpu")


# For each folder, the state of its files when this process verified episodes of it, and which.
_VERIFIED: dict[Path, tuple[list[Any], set[EpisodeInfo]]] = {}


def whole_episodes(demonstrations: Demonstrations, *, progress: bool) -> list[EpisodeInfo]:
    """The episodes whose rows match their checksums."""
    rows, whole = load_rows(demonstrations), []
    with Progress("checking", len(demonstrations.episodes), "episode", show=progress) as bar:
        for info in demonstrations.episodes:
            if _is_whole(info, rows):
                whole.append(info)
            bar.update()
    return whole


def _is_whole(info: EpisodeInfo, rows: TensorDictBase) -> bool:
    return describe_episode(info.task, info.episode, info.start, rows[info.start : info.start + info.length]) == info


def verify(demonstrations: Demonstrations, episodes: Sequence[EpisodeInfo]) -> None:
    """Compare episodes with their checksums, once in a process while the files stay the same; DatasetError if they
    differ."""
    rows, root = load_rows(demonstrations), demonstrations.root.resolve()
    states = [path.stat() for path in (root / METADATA, *(_path(root / DATA, key) for key in COLUMNS))]
    files = [(state.st_ino, state.st_size, state.st_mtime_ns, state.st_ctime_ns) for state in states]
    before, known = _VERIFIED.get(root, (files, set()))
    known = known if before == files else set()
    for info in episodes:
        if info not in known and not _is_whole(info, rows):
            episode = f"episode {info.episode} of {info.task!r}"
            raise damaged(f"the rows in {str(root)!r} are damaged: {episode} differs from its checksum")
    _VERIFIED[root] = (files, known | set(episodes))
