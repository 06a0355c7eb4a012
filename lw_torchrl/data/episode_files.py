"""The episodes of a dataset that is being collected: a file each, so that a kill costs those under way alone."""

from __future__ import annotations

import errno
import stat
import zipfile
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from lw_torchrl._files import replacing
from lw_torchrl.data.dataset import DatasetError
from lw_torchrl.data.rows import COLUMNS, ROW_BYTES

_STORED = [key for key in COLUMNS if key != ("collector", "traj_ids")]
_FAILED = b"FAILED"
_HEADERS = 2**16  # bytes of a file beside its rows, at the most
_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class EpisodeFiles:
    """The episodes so far, one file each; a file that says FAILED stands for one that was not kept.

    Args:
        folder: where they lie.
        tasks: the tasks' names.
        max_steps: the most steps that an episode has.
    """

    def __init__(self, folder: Path, tasks: Sequence[str], max_steps: int) -> None:
        self.folder, self.tasks, self.max_steps = folder, tasks, max_steps

    def _path(self, task: str, episode: int) -> Path:
        return self.folder / f"{task}.{episode}.npz"

    def put(self, task: str, episode: int, steps: TensorDictBase | None) -> None:
        """Write an episode's rows, or that it was not kept."""
        content = _FAILED
        if steps is not None:
            stream = BytesIO()
            np.savez(stream, **{"/".join(key): steps.get(key).numpy() for key in _STORED})
            content = stream.getvalue()
        try:
            with replacing(self._path(task, episode), sync=False) as path:  # a damaged one is run again
                path.write_bytes(content)
        except OSError as error:
            raise write_failed(self.folder, len(content), error) from error

    def has(self, task: str, episode: int) -> bool:
        """Whether the episode was run."""
        return self._path(task, episode).is_file()

    def kept(self, task: str, episode: int) -> bool:
        """Whether an episode that was run was kept."""
        return self._path(task, episode).stat().st_size != len(_FAILED)

    def get(self, task: str, episode: int) -> TensorDict:
        """An episode's rows.

        Raises:
            Exception: of many kinds, where the file is damaged.
        """
        content = self._content(self._path(task, episode))
        with zipfile.ZipFile(BytesIO(content)) as archive:
            if any(entry.compress_type != zipfile.ZIP_STORED for entry in archive.infolist()):
                raise ValueError("it is compressed")
        with np.load(BytesIO(content), allow_pickle=False) as found:
            columns = {key: torch.from_numpy(found["/".join(key)]) for key in _STORED}
        length = len(columns["episode",])
        for key, column in columns.items():
            tail, dtype = COLUMNS[key]
            if column.shape != (length, *tail) or column.dtype != dtype:
                raise ValueError(f"{'/'.join(key)} must be {dtype} of shape {(length, *tail)}")
        if not 0 < length <= self.max_steps or (columns["episode",] != episode).any():
            raise ValueError("it is another episode")
        steps = TensorDict({}, [length])
        for key, column in columns.items():
            steps.set(key, column)
        return steps

    def _content(self, path: Path) -> bytes:
        found = path.lstat()
        if not stat.S_ISREG(found.st_mode) or found.st_size > self.max_steps * ROW_BYTES + _HEADERS:
            raise ValueError("it is no file, or larger than an episode can be")
        return path.read_bytes()

    def drop_damaged(self) -> None:
        """Remove what cannot be read: those episodes are run again.

        Raises:
            DatasetError: (a ValueError) a folder has the name of an episode's file.
        """
        for path in self.folder.glob("*.npz"):
            task, _, number = path.stem.rpartition(".")
            if task not in self.tasks or not number.isdecimal():
                continue
            if path.is_dir() and not path.is_symlink():
                raise DatasetError(f"root: {str(path)!r} is a folder, and no episode's file; move it elsewhere")
            try:
                if self._content(path) != _FAILED:
                    self.get(task, int(number))
            except Exception:  # whatever is wrong with it, the episode can be run again
                path.unlink()


def write_failed(folder: Path, size: int, error: OSError) -> OSError:
    """The error for something that could not be written while collecting; the caller raises it."""
    until = "there is room" if error.errno in _NO_ROOM else "that is mended"
    return OSError(
        error.errno,
        f"root: writing {size} bytes to {str(folder)!r} failed: {error.strerror or error}. Nothing is lost: once "
        f"{until}, the same collect_demonstrations carries on",
    )
