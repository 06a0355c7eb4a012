"""RowDataset and WindowDataset: the rows of a buffer for PyTorch's ``DataLoader``, in plain dictionaries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.utils.data import Dataset

from lw_torchrl._checks import Count, Natural, checked, unknown_name
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.storage import TRAJECTORY
from lw_torchrl.suites.suite import find_suite

TASK, PAD = "task", "is_pad"
Row = dict[str, Any]


def _flat(rows: TensorDictBase) -> dict[str, Tensor]:
    """The columns by their names joined by dots."""
    keys = rows.keys(True, True)
    return {key if isinstance(key, str) else ".".join(key): rows.get(key) for key in keys}


class RowDataset(Dataset[Row]):
    """A map-style dataset of a buffer's rows: what the buffer shows, with its transform, for ``DataLoader``.

    ``dataset[i]`` is a dictionary of row i, in the order of ``replay[:]``: observation (39,) float32, action (4,)
    float32, task_id () int64, or whatever ``keys`` name; "task" is the task's description, a string. Which episodes
    are shown, which actions and rewards, the buffer says; its sampler is not asked.

    Args:
        replay: a buffer that does not grow. The loader's workers read its rows from the files, too.
        keys: columns, nested ones joined by dots: "next.reward"; "task" beside them. None for all but "task".

    Raises:
        ValueError: a column that there is not, or a buffer that grows.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> from torch.utils.data import DataLoader
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=20)
        ...     rows = lw.data.RowDataset(lw.LanguageWorldExperienceReplay(root + "/demos"))
        ...     batch = next(iter(DataLoader(rows, batch_size=8, shuffle=True)))
        >>> len(rows), batch["observation"].shape, batch["action"].shape
        (20, torch.Size([8, 39]), torch.Size([8, 4]))

    Source: ``torch.utils.data``, map-style datasets with ``__getitems__``.
    """

    @checked
    def __init__(
        self,
        replay: LanguageWorldExperienceReplay,
        *,
        keys: Sequence[str] | None = ("observation", "action", "task_id"),
    ) -> None:
        if replay.grows:
            raise ValueError("replay: rows come and go in a buffer that grows; sample it, or make one without grow=")
        self.replay, self.keys = replay, None if keys is None else tuple(keys)
        known = [*_flat(replay[torch.zeros(1, dtype=torch.int64)]), TASK]
        for key in self.keys or ():
            if key not in known:
                raise unknown_name("keys", key, known)
        self._texts: dict[int, str] = {}
        if TASK in (self.keys or ()):
            from lw_torchrl.language.tasks import task_id

            tasks = find_suite(replay.tasks).tasks
            self._texts = {task_id(name): tasks[name].description for name in replay.tasks}

    def __len__(self) -> int:
        return len(self.replay)

    def _columns(self, index: Tensor) -> dict[str, Any]:
        """The columns at an index, (n,) int64, each (n, ...); a list of texts for "task"."""
        rows = self.replay[index]
        found: dict[str, Any] = _flat(rows)
        if self.keys is None:
            return found
        if self._texts:
            found[TASK] = [self._texts[number] for number in rows.get("task_id").tolist()]
        return {key: found[key] for key in self.keys}

    def __getitem__(self, index: int) -> Row:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Row]:
        """The rows at ``indices``, read at once, as a list of dictionaries."""
        rows = torch.as_tensor(indices, dtype=torch.int64)
        if len(rows) and not -len(self) <= int(rows.min()) <= int(rows.max()) < len(self):
            raise IndexError(f"rows are 0 to {len(self) - 1}, got {int(rows.min())} to {int(rows.max())}")
        found = self._columns(rows % max(1, len(self)))
        parts = [column if isinstance(column, list) else column.unbind(0) for column in found.values()]
        return [dict(zip(found, row, strict=True)) for row in zip(*parts, strict=True)]


class WindowDataset(RowDataset):
    """A map-style dataset of windows of consecutive rows of one episode, one for each row.

    ``dataset[i]`` has of each column (length, ...): row i is at ``past``, and before and behind it are the rows that
    the episode has there. Where it has none, its first or last row stands, and "is_pad" (length,) bool is true. "task"
    is one string. Action chunks are windows of ``past=0``; histories of observations have ``past=length - 1``.

    Args:
        replay, keys: as for :class:`RowDataset`.
        length: rows of a window.
        past: how many of them come before row i.

    Raises:
        ValueError: as for :class:`RowDataset`, and a ``past`` that is not below ``length``.

    Example:
        >>> import tempfile, lw_torchrl as lw
        >>> with tempfile.TemporaryDirectory() as root:
        ...     _ = lw.collect_demonstrations("reach", episodes_per_task=1, root=root + "/demos", max_steps=20)
        ...     chunks = lw.data.WindowDataset(lw.LanguageWorldExperienceReplay(root + "/demos"), length=16)
        >>> chunks[10]["action"].shape, chunks[10]["is_pad"].sum()
        (torch.Size([16, 4]), tensor(6))

    Source: LeRobot's ``delta_timestamps`` and "action_is_pad".
    """

    @checked
    def __init__(
        self,
        replay: LanguageWorldExperienceReplay,
        length: Count,
        *,
        past: Natural = 0,
        keys: Sequence[str] | None = ("observation", "action", "task_id"),
    ) -> None:
        super().__init__(replay, keys=keys)
        if past >= length:
            raise ValueError(f"past must be below length, {length}, got {past}")
        _, lengths = torch.unique_consecutive(replay.storage.column(TRAJECTORY).cpu(), return_counts=True)
        self._last = (lengths.cumsum(0) - 1).repeat_interleave(lengths)
        self._first = (lengths.cumsum(0) - lengths).repeat_interleave(lengths)
        self._offsets = torch.arange(length) - past

    def _columns(self, index: Tensor) -> dict[str, Any]:
        asked = index[:, None] + self._offsets
        rows = asked.clamp(self._first[index, None], self._last[index, None])
        found = super()._columns(rows.reshape(-1))
        shaped = {
            key: column[:: len(self._offsets)] if isinstance(column, list) else column.unflatten(0, tuple(rows.shape))
            for key, column in found.items()
        }
        return {**shaped, PAD: rows != asked}
