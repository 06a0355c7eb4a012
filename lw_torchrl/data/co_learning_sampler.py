"""CoLearningSampler: a target task's rows and those of the base tasks in an exact ratio."""

from __future__ import annotations

from fractions import Fraction
from math import isclose
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._util.keys import check_key
from lw_torchrl.data.samplers import GroupSampler, column
from lw_torchrl.data.storage import DATASET, to_device_of
from lw_torchrl.language.tasks import MT50, Task, task_id


def _check_fraction(fraction: Any) -> Fraction:
    if isinstance(fraction, bool) or not isinstance(fraction, (float, Fraction)):
        raise TypeError(f"target_fraction must be a float or a Fraction, got {fraction!r} ({type(fraction).__name__})")
    if not 0 < fraction < 1:
        raise ValueError(f"target_fraction must lie between 0 and 1, both excluded, got {fraction}")
    exact = Fraction(fraction).limit_denominator(10_000)
    if not isclose(exact, fraction, rel_tol=1e-9):
        wanted = f"a ratio of whole numbers up to 10000, got {fraction}"
        raise ValueError(f"target_fraction must be {wanted}; the nearest is {exact}")
    return exact


class CoLearningSampler(GroupSampler):
    """Draw half of every minibatch from a target task's demonstrations, half in equal numbers from the base tasks.

    It works in any :class:`torchrl.data.ReplayBuffer`. Target and base tasks are drawn without replacement, each in its
    own passes: every row of a group comes once before any comes again. An epoch, at whose end ``ran_out`` is true, is
    the pass that takes the most batches. The sampler draws from the replay buffer's generator; a restored state
    continues with the same batches.

    If the rows have a column ``dataset``, as :func:`load_demonstrations` gives those of several folders, the target's
    rows are those in the last dataset that has any. If the target is also a base task, its other rows are left out. A
    batch holds the target's rows, then those of the base tasks in the order of their ids, and the column ``is_target``
    (B,) bool.

    Args:
        target: a task's name, a :class:`Task`, or a task's id.
        target_fraction: the target's share of a minibatch, between 0 and 1, such as 0.5, 1/3 or Fraction(2, 7).
        task_key: the entry of the storage that holds the task: one number a row, of any shape.
        exact: refuse a batch size that cannot be split exactly. Otherwise the shares are rounded, and later batches
            make up for it.

    Raises:
        ValueError: at sampling, no row of the target or of a base task; with ``exact``, a batch size that cannot be
            split exactly (the message gives the nearest that can).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> sampler = CoLearningSampler("coffee-push")
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(12), sampler=sampler, batch_size=8)
        >>> task = torch.tensor([3] * 5 + [7] * 5 + [task_id("coffee-push")] * 2)
        >>> _ = replay.extend(TensorDict({"task_id": task}, [12]))
        >>> batch = replay.sample()
        >>> batch["is_target"].sum().item(), batch["task_id"].unique(return_counts=True)[1].tolist()
        (4, [2, 2, 4])

    Source: paper section 'Cross-Task Co-Learning via 1:1 Data Mixing'.
    """

    def __init__(
        self,
        target: str | int | Task,
        *,
        target_fraction: float | Fraction = 0.5,
        task_key: NestedKey = "task_id",
        exact: bool = False,
    ) -> None:
        if isinstance(target, bool) or not isinstance(target, (str, int, Task)):
            raise TypeError(f"target must be a task's name, a Task or a task's id, got {target!r}")
        self.target, self.target_fraction = target, _check_fraction(target_fraction)
        self._target_id = (
            target if isinstance(target, int) else task_id(target.name if isinstance(target, Task) else target)
        )
        check_key("task_key", task_key)
        self.task_key = task_key
        super().__init__(exact)

    def _targets(self, storage: Storage, task: Tensor) -> Tensor:
        """Whether each row is the target's: (R,) bool."""
        mine = task == self._target_id
        if not mine.any():
            tasks = ", ".join(MT50[i] if 0 <= i < len(MT50) else str(i) for i in task.unique().tolist())
            raise ValueError(f"target: the storage has no row of {self.target!r}; its tasks are {tasks}")
        try:
            dataset = column(storage, DATASET)
        except KeyError:  # rows of one dataset
            return mine
        return mine & (dataset == dataset[mine].max())

    def _label(self, storage: Storage) -> Tensor:
        task = column(storage, self.task_key)
        mine = self._targets(storage, task)
        base = task != self._target_id
        if not base.any():
            raise ValueError("target: the storage has no row of any other task, so there are no base tasks")
        label = torch.where(mine, 0, -1)
        label[base] = 1 + torch.unique(task[base], return_inverse=True)[1]
        return label

    def row_weights(self, storage: Storage) -> Tensor:
        """Return each row's mean share of a minibatch: (R,) float32, 0 for a row that is left out."""
        label = self._label(storage)
        sizes = label[label >= 0].bincount()
        share = torch.tensor(self._weights(len(sizes))[0], dtype=torch.float32)
        return torch.where(label >= 0, (share / share.sum() / sizes)[label.clamp(min=0)], 0.0)

    def _weights(self, groups: int) -> tuple[list[int], str]:
        base, (part, whole) = groups - 1, self.target_fraction.as_integer_ratio()
        reason = f"so that {self.target_fraction} of it is the target's and {base} base tasks share the rest equally"
        return [part * base] + [whole - part] * base, reason

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        index, info = super().sample(storage, batch_size)
        assert self._laid_out is not None
        info["is_target"] = to_device_of(storage, self._laid_out[2] == 0)
        return index, info

    def _identity(self) -> dict[str, Tensor]:
        fraction = torch.tensor([self.target_fraction.numerator, self.target_fraction.denominator])
        return {"target": torch.tensor(self._target_id), "target_fraction": fraction}

    def state_dict(self) -> dict[str, Any]:
        """Return the shuffled order, how far each pass has come, the target and the ratio."""
        return super().state_dict() | self._identity()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; :class:`ValueError` if it is none, or of another target or ratio."""
        for name, ours in self._identity().items():
            given = state_dict.get(name)
            if not isinstance(given, Tensor) or given.dtype != ours.dtype or not torch.equal(given.cpu(), ours.cpu()):
                raise ValueError(f"state_dict must be of the same {name}, {getattr(self, name)}, got one of another")
        super().load_state_dict(state_dict)
