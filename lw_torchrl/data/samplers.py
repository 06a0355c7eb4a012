"""Samplers whose counts are exact."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage


class TaskBalancedSampler(Sampler):
    """Equal numbers from every task, exactly; within a task every row once before any comes again.

    It draws from the replay buffer's generator, so ``ReplayBuffer(..., generator=...)`` fixes the batches. State is
    saved and restored with the buffer's.

    Args:
        task_key: the entry of the storage that tells the task.

    Raises:
        ValueError: at sampling, a batch size that the number of tasks does not divide (with the nearest that it
            does), or an empty storage.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=TaskBalancedSampler(), batch_size=4)
        >>> _ = replay.extend(TensorDict({"task_id": torch.tensor([3] * 8 + [7] * 2)}, [10]))
        >>> replay.sample()["task_id"].bincount(minlength=8).tolist()
        [0, 0, 0, 2, 0, 0, 0, 2]

    Source: paper section 'Cross-Task Co-Learning via 1:1 Data Mixing', its minibatches of equal numbers.
    """

    def __init__(self, task_key: str = "task_id") -> None:
        self.task_key = task_key
        self._empty()

    def _empty(self) -> None:
        self._length = 0
        self._order = torch.empty(0, dtype=torch.int64)  # rows grouped by task, each group shuffled
        self._start = torch.empty(0, dtype=torch.int64)  # of each group
        self._size = torch.empty(0, dtype=torch.int64)
        self._cursor = torch.empty(0, dtype=torch.int64)
        self._ran_out = False

    @property
    def ran_out(self) -> bool:
        """Whether the last batch ended a pass over the largest task."""
        return self._ran_out

    @ran_out.setter
    def ran_out(self, value: bool) -> None:
        self._ran_out = value

    def _group(self, storage: Storage) -> None:
        tasks = storage.get(slice(0, len(storage))).get(self.task_key).reshape(-1)
        self._order = torch.argsort(tasks, stable=True).cpu()
        self._size = torch.unique(tasks, return_counts=True)[1].cpu()
        self._start = self._size.cumsum(0) - self._size
        self._cursor = torch.zeros_like(self._size)
        self._length = len(storage)
        for group in range(len(self._size)):
            self._shuffle(group)

    def _shuffle(self, group: int) -> None:
        start, size = int(self._start[group]), int(self._size[group])
        rows = self._order[start : start + size]
        self._order[start : start + size] = rows[torch.randperm(size, generator=self._rng)]
        self._cursor[group] = 0

    def _take(self, group: int, count: int) -> Tensor:
        """``count`` rows of one task, over the end of its pass."""
        taken = []
        start, size = int(self._start[group]), int(self._size[group])
        while count:
            cursor = int(self._cursor[group])
            found = self._order[start + cursor : start + min(size, cursor + count)].clone()
            taken.append(found)
            self._cursor[group] += len(found)
            count -= len(found)
            if self._cursor[group] == size:
                self._ran_out |= size == int(self._size.max())
                self._shuffle(group)
        return torch.cat(taken)

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draw ``batch_size`` indices, task after task."""
        if not len(storage):
            raise ValueError("storage must hold at least one row, got an empty one")
        if len(storage) != self._length:
            self._group(storage)
        groups = len(self._size)
        count, rest = divmod(batch_size, groups)
        if rest or not count:
            near = [size for size in (count * groups, (count + 1) * groups) if size]
            raise ValueError(
                f"batch_size must be divisible by the number of tasks, {groups}, got {batch_size}; the nearest are "
                + " and ".join(map(str, near))
            )
        self._ran_out = False
        index = self._order[
            (self._start + torch.minimum(self._cursor, self._size - 1))[:, None]
            + torch.arange(count).minimum((self._size - 1 - self._cursor)[:, None])
        ]
        ending = self._cursor + count >= self._size
        if ending.any():
            for group in ending.nonzero().flatten().tolist():
                index[group] = self._take(group, count)
        self._cursor += torch.where(ending, 0, count)
        return index.flatten(), {}

    def add(self, index: Any) -> None:
        """Group the rows again at the next sample, since one was written, over an old one perhaps."""
        self._length = 0

    extend = add

    def state_dict(self) -> dict[str, Any]:
        """The shuffled order and how far each task's pass has come."""
        return {
            "length": torch.tensor(self._length),
            "order": self._order.clone(),
            "start": self._start.clone(),
            "size": self._size.clone(),
            "cursor": self._cursor.clone(),
            "ran_out": torch.tensor(self._ran_out),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave."""
        self._length = int(state_dict["length"])
        for name in ("order", "start", "size", "cursor"):
            setattr(self, f"_{name}", state_dict[name].clone())
        self._ran_out = bool(state_dict["ran_out"])

    def dumps(self, path: Any) -> None:
        """Write the state to a folder, memory-mapped."""
        TensorDict(self.state_dict()).memmap(path)

    def loads(self, path: Any) -> None:
        """Read the state that :meth:`dumps` wrote."""
        self.load_state_dict(TensorDict.load_memmap(path, allow_pickle=False).to_dict())
