"""TaskBalancedSampler: every task the same number of rows in a minibatch."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._keys import check_key
from lw_torchrl.data.group_sampler import GroupSampler, column, nearest_sizes


class TaskBalancedSampler(GroupSampler):
    """Equal numbers from every task, exactly; within a task every row once before any comes again.

    The buffer may grow: rows that come take random places in the passes under way, and what is overwritten leaves them;
    a task that comes or goes begins all passes anew. No batch looks at more than the rows that came.

    It draws from the replay buffer's generator, so ``ReplayBuffer(..., generator=...)`` fixes the batches. State is
    saved and restored with the buffer's. An epoch is a pass over the largest task; each task has passes of its own.

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

    def __init__(self, task_key: NestedKey = "task_id") -> None:
        check_key("task_key", task_key)
        self.task_key = task_key
        super().__init__()

    def _label(self, storage: Storage) -> Tensor:
        return torch.unique(column(storage, self.task_key).reshape(-1), return_inverse=True)[1]

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor:
        return column(storage, self.task_key, rows)

    def _shares(self, batch_size: int) -> Tensor:
        groups = len(self._passes.size)
        count, rest = divmod(batch_size, groups)
        if rest or not count:
            raise ValueError(
                f"batch_size must be divisible by the number of tasks, {groups}, got {batch_size}; the nearest are "
                + nearest_sizes(batch_size, groups)
            )
        return torch.full((groups,), count)
