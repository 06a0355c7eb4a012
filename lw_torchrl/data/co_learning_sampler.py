"""CoLearningSampler: a target task's rows and those of the base tasks in an exact ratio."""

from __future__ import annotations

from fractions import Fraction
from math import gcd, isclose
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._checks import check_choice
from lw_torchrl._keys import check_key
from lw_torchrl.data.growing import GrowingStorage
from lw_torchrl.data.samplers import GroupSampler, column, nearest_sizes
from lw_torchrl.data.storage import JoinedStorage, to_device_of
from lw_torchrl.language.tasks import MT50, TASKS, task_id

GROWN = "grown"  # the target that is what a buffer was extended with


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
    """Exactly half of every minibatch from the target's demonstrations, half in equal numbers from the base tasks.

    Target and base tasks are drawn without replacement, each in its own passes: every row of a group comes once before
    any comes again. An epoch, at whose end ``ran_out`` is true, is the pass that takes the most batches. The sampler
    draws from the replay buffer's generator; a restored state continues with the same batches.

    The target "grown" means the rows that the buffer was extended with, drawn uniformly with replacement. The
    demonstrations of all tasks are the base.

    If a target by name is itself a base task, its base demonstrations are left out. A batch holds the target's rows,
    then those of the base tasks in the order of their ids, and the column ``is_target`` (B,) bool.

    Args:
        target: "grown"; or a task's name, for all demonstrations of the task. If the storage joins datasets, these are
            the demonstrations in the last dataset that has any.
        target_fraction: the target's share of a minibatch, between 0 and 1, such as 0.5, 1/3 or Fraction(2, 7).
        task_key: the entry of the storage that holds the task.

    Raises:
        ValueError: at sampling, a batch size that cannot be split exactly (the message gives the nearest that can);
            no row of the target or of a base task; "grown" without a growing buffer, or another target with one.

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
        target: str,
        *,
        target_fraction: float | Fraction = 0.5,
        task_key: NestedKey = "task_id",
    ) -> None:
        if not (isinstance(target, str) and "/" in target):  # another suite's task otherwise
            check_choice("target", target, (GROWN, *TASKS))
        self.target, self.target_fraction = target, _check_fraction(target_fraction)
        check_key("task_key", task_key)
        self.task_key = task_key
        super().__init__()

    @property
    def _grown(self) -> bool:
        return self.target == GROWN

    def _covered(self, storage: Storage) -> int:
        return storage.num_joined if isinstance(storage, GrowingStorage) else len(storage)

    def _check_storage(self, storage: Storage) -> None:
        if isinstance(storage, GrowingStorage) != self._grown:
            if self._grown:
                raise ValueError("target 'grown' needs a growing buffer, LanguageWorldExperienceReplay(..., grow=)")
            raise ValueError(f"target must be 'grown', since the buffer grows, got {self.target!r}")

    def _targets(self, storage: Storage, task: Tensor) -> Tensor:
        """Whether each row is the target's: (R,) bool."""
        mine = task == task_id(self.target)
        if not mine.any():
            tasks = ", ".join(MT50[i] if 0 <= i < len(MT50) else str(i) for i in task.unique().tolist())
            raise ValueError(f"target: the storage has no row of {self.target!r}; its tasks are {tasks}")
        if isinstance(storage, JoinedStorage):
            part = storage.part()
            mine &= part == part[mine].max()
        return mine

    def _label(self, storage: Storage) -> Tensor:
        self._check_storage(storage)
        if isinstance(storage, GrowingStorage):
            task = storage.column(self.task_key, torch.arange(storage.num_joined)).reshape(-1)
            return torch.unique(task, return_inverse=True)[1]
        task = column(storage, self.task_key).reshape(-1)
        mine = self._targets(storage, task)
        base = ~torch.isin(task, task[mine].unique())
        if not base.any():
            raise ValueError("target: the storage has no row of any other task, so there are no base tasks")
        label = torch.where(mine, 0, -1)
        label[base] = 1 + torch.unique(task[base], return_inverse=True)[1]
        return label

    def row_weights(self, storage: Storage) -> Tensor:
        """Each row's mean share of a minibatch: (R,) float32, 0 for a row that is left out."""
        label = self._label(storage)
        mine = float(self.target_fraction)
        if isinstance(storage, GrowingStorage):
            label = torch.cat([label + 1, label.new_zeros(storage.num_grown)])
        sizes = label[label >= 0].bincount()
        share = torch.full((len(sizes),), (1 - mine) / (len(sizes) - 1))
        share[0] = mine
        if isinstance(storage, GrowingStorage) and not storage.num_grown:  # demonstrations are all there is
            share[1:] /= 1 - mine
        return torch.where(label >= 0, (share / sizes)[label.clamp(min=0)], 0.0)

    def _shares(self, batch_size: int) -> Tensor:
        base = len(self._size) - (not self._grown)
        part, whole = self.target_fraction.numerator, self.target_fraction.denominator
        unit = whole * base // gcd(base, whole - part)
        if batch_size % unit:
            share = f"so that {self.target_fraction} of it is the target's and {base} base tasks share the rest equally"
            near = nearest_sizes(batch_size, unit)
            wanted = f"a multiple of {unit}, {share}, got {batch_size}"
            raise ValueError(f"batch_size must be {wanted}; the nearest are {near}")
        mine = batch_size // whole * part
        return torch.tensor([mine] * (not self._grown) + [(batch_size - mine) // base] * base)

    def add(self, index: Any, *, storage: Storage | None = None) -> None:
        """Note that rows were written; the rows of a growing buffer's ring are in no group."""
        if not self._grown:
            super().add(index)

    extend = mark_update = add

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        self._check_storage(storage)
        if isinstance(storage, GrowingStorage) and not storage.num_grown:
            raise ValueError("target 'grown': extend the buffer before the first sample")
        index, info = super().sample(storage, batch_size)
        if not isinstance(storage, GrowingStorage):
            info["is_target"] = to_device_of(storage, self._layout(batch_size)[1] == 0)
            return index, info
        assert isinstance(index, Tensor)  # of one dimension
        mine = batch_size - len(index)
        grown = torch.randint(storage.num_grown, (mine,), generator=self._rng) + storage.num_joined
        info["is_target"] = torch.arange(batch_size) < mine
        return torch.cat([grown, index]), info

    def _identity(self) -> dict[str, Tensor]:
        fraction = torch.tensor([self.target_fraction.numerator, self.target_fraction.denominator])
        target = torch.tensor(-1 if self._grown else task_id(self.target))
        return {"target": target, "target_fraction": fraction}

    def state_dict(self) -> dict[str, Any]:
        """The shuffled order, how far each pass has come, the target and the ratio."""
        return super().state_dict() | self._identity()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; :class:`ValueError` if it is none, or of another target or ratio."""
        for name, ours in self._identity().items():
            given = state_dict.get(name)
            if not isinstance(given, Tensor) or given.dtype != ours.dtype or not torch.equal(given.cpu(), ours.cpu()):
                raise ValueError(f"state_dict must be of the same {name}, {getattr(self, name)}, got one of another")
        super().load_state_dict(state_dict)
