"""RowDataset and WindowDataset: the rows of a buffer for PyTorch's ``DataLoader``, in plain dictionaries."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from lw_torchrl._checks import Count, Natural, checked, unknown_name
from lw_torchrl.data.replay import LanguageWorldExperienceReplay
from lw_torchrl.data.storage import TRAJECTORY, flat_columns, row_dictionaries
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import find_suite

TASK, PAD = "task", "is_pad"


class RowDataset(Dataset[dict[str, Any]]):
    """A map-style dataset of a buffer's rows, with the buffer's transform, for PyTorch's ``DataLoader``.

    ``dataset[i]`` is a dictionary of row i, in the order of ``replay[:]``: observation (39,) float32, action (4,)
    float32, task_id () int64, or other ``keys``; "task" is the task's description, a string. The buffer decides which
    episodes, actions and rewards there are; its sampler is not used.

    Args:
        replay: a buffer without ``grow``. The loader's workers read its rows from the files, too.
        keys: columns, nested ones joined by dots: "next.reward"; also "task". None for all but "task".

    Raises:
        ValueError: a column that does not exist, or a growing buffer.

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
            raise ValueError("replay must not grow; sample it, or make one without grow=")
        self.replay, self.keys = replay, None if keys is None else tuple(keys)
        known = [*flat_columns(replay[torch.zeros(1, dtype=torch.int64)]), TASK]
        for key in self.keys or ():
            if key not in known:
                raise unknown_name("keys", key, known)
        self._texts: dict[int, str] = {}
        if TASK in (self.keys or ()):
            tasks = find_suite(replay.tasks).tasks
            self._texts = {task_id(name): tasks[name].description for name in replay.tasks}

    def __len__(self) -> int:
        return len(self.replay)

    def _columns(self, index: Tensor) -> dict[str, Any]:
        """The columns at an index, (n,) int64, each (n, ...); a list of texts for "task"."""
        rows = self.replay[index]
        columns = flat_columns(rows)
        if self.keys is None:
            return columns
        if self._texts:
            columns[TASK] = [self._texts[number] for number in rows.get("task_id").tolist()]
        return {key: columns[key] for key in self.keys}

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, Any]]:
        """The rows at ``indices``, read at once, as a list of dictionaries."""
        rows = torch.as_tensor(indices, dtype=torch.int64)
        if len(rows) and not -len(self) <= int(rows.min()) <= int(rows.max()) < len(self):
            raise IndexError(f"rows are 0 to {len(self) - 1}, got {int(rows.min())} to {int(rows.max())}")
        return row_dictionaries(self._columns(rows % max(1, len(self))))


class WindowDataset(RowDataset):
    """A map-style dataset of windows of consecutive rows of one episode, one for each row.

    ``dataset[i]`` holds (length, ...) of each column, with row i at index ``past``. Beyond the ends of the episode its
    first or last row is repeated, and "is_pad" (length,) bool is true. "task" is one string. Action chunks are windows
    with ``past=0``, histories of observations with ``past=length - 1``.

    Args:
        replay, keys: as for :class:`RowDataset`.
        length: number of rows of a window.
        past: number of rows before row i, below ``length``.

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
        unclamped = index[:, None] + self._offsets
        rows = unclamped.clamp(self._first[index, None], self._last[index, None])
        shaped = {
            key: column[:: len(self._offsets)] if isinstance(column, list) else column.unflatten(0, tuple(rows.shape))
            for key, column in super()._columns(rows.reshape(-1)).items()
        }
        return {**shaped, PAD: rows != unclamped}
