"""Samplers with a fixed share of rows per group: GroupSampler (base), TaskBalancedSampler and CoLearningSampler."""

from __future__ import annotations

import os
from abc import abstractmethod
from contextlib import suppress
from fractions import Fraction
from functools import reduce
from math import gcd, isclose
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import NestedKey
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._util.checks import Count, typed
from lw_torchrl._util.devices import CPU
from lw_torchrl._util.files import AnyPath, reading
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.dataset import DATASET
from lw_torchrl.language.tasks import MT50, Task, task_id

_FILE = "sampler.safetensors"
_STATE = ("order", "size", "cursor", "credit", "known", "written", "length", "ran_out")


def device_of_rows(storage: Storage) -> torch.device:
    """Return the device of a storage's rows, or the CPU if the storage has no explicit device."""
    device = getattr(storage, "device", None)
    return CPU if device in (None, "auto") else torch.device(device)


def to_device_of(storage: Storage, index: Tensor) -> Tensor:
    """Copy ``index`` from the CPU to the device of the rows, without blocking."""
    device = device_of_rows(storage)
    return index if device.type == "cpu" else index.to(device, non_blocking=True)


def column(storage: Storage, key: NestedKey, rows: Tensor | None = None) -> Tensor:
    """Return a column's values (R,) in all rows or the given rows, on the CPU; raise KeyError if it is missing.

    A row may store its value in any shape, for example (1,), or (T,) with equal entries if rows are trajectory slices.
    """
    data = storage.get(slice(0, len(storage)))
    values = torch.stack([row[key] for row in data]) if isinstance(data, list) else data[key]
    values = values.flatten(0, storage.ndim - 1)
    values = (values if rows is None else values[rows.to(values.device)]).cpu()
    if values.dim() == 1:
        return values
    if not ((values := values.flatten(1)) == values[:, :1]).all():
        raise ValueError(f"column {key!r} must have one value per row; split the rows that hold several values")
    return values[:, 0]


class GroupSampler(Sampler):
    """Base class for samplers that draw a fixed share of each batch from each group, without replacement in a group.

    A subclass defines the group of each row (:meth:`_label`) and the share of each group (:meth:`_weights`). A batch
    holds the groups one after another. If the batch size cannot be divided exactly, the shares are rounded. Later
    batches compensate, so that the totals stay within one row of the exact shares. With ``exact``, such a batch size is
    an error. A pass over a group may end within a batch; the next pass has a new order. For a storage with several
    dimensions (``ndim=2``), an index is a tuple of tensors.

    A newly written row takes a random position in the rest of its group's pass. All passes start over if a group
    appears or disappears, or if a subclass cannot determine the group of single rows (:meth:`_keys`).
    """

    ran_out = False  # whether the last batch ended an epoch, which is a pass over the group that takes the most batches

    @typed
    def __init__(self, exact: bool = False) -> None:
        self.exact = exact
        self._process = os.getpid()
        self._empty()

    def _empty(self) -> None:
        none = torch.empty(0, dtype=torch.int64)
        self._length = 0  # number of grouped rows; 0 to group all rows at the next sample
        # The rows of all groups in the order of their passes; the size of each group; the number of rows drawn so far.
        self._order, self._size, self._cursor = none, none, none
        # The integer weight of each group; the number of rows that each group lacks because earlier shares were
        # rounded, in units of 1 / (sum of weights).
        self._weight, self._credit = none, none
        self._known: Tensor | None = None  # the key shared by the rows of each group
        self._written: list[Tensor] = []  # indices of rows written since the last batch
        self.ran_out = False
        self._restored = False
        self._laid_out: tuple[int, Tensor, Tensor, Tensor] | None = None  # see _layout

    @abstractmethod
    def _label(self, storage: Storage) -> Tensor:
        """Return the group of each row (R,) int64: 0 to G - 1 without gaps, or -1 for a row that is never drawn."""

    @abstractmethod
    def _weights(self, groups: int) -> tuple[list[int], str]:
        """Return an integer weight (at least 1) for each of G groups, and an explanation for error messages."""

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor | None:
        """Return the group key of each given row, (n,) int64; None if grouping requires all rows."""
        return None

    def _covered(self, storage: Storage) -> int:
        """Return the number of rows to group, counted from the start of the storage."""
        return len(storage) if storage.ndim == 1 else storage.shape.numel()

    def _group(self, storage: Storage) -> None:
        label = self._label(storage).cpu()
        order = torch.argsort(label, stable=True)
        self._order, self._size = order[int((label < 0).sum()) :], label[label >= 0].bincount()
        self._cursor, self._credit = torch.zeros_like(self._size), torch.zeros_like(self._size)
        self._length, self._laid_out, self._restored = self._covered(storage), None, False
        keys = self._keys(storage, self._order[self._start()]) if storage.ndim == 1 else None
        self._written, self._known = [], None if keys is None else keys.reshape(-1).cpu()
        for rows in self._order.split(self._size.tolist()):
            self._shuffle(rows.numpy())

    def _move_written(self, storage: Storage) -> bool:
        """Move newly written rows to the passes of their groups; return False if all rows must be grouped again."""
        if self._known is None or not self._written:
            return False
        rows, length = torch.cat(self._written).unique(), self._covered(storage)
        # Group all rows again if the storage changed in rows that it did not report to the sampler.
        if rows[0] < 0 or rows[-1] >= length or int((rows >= self._length).sum()) != length - self._length:
            return False
        keys = self._keys(storage, rows)
        assert keys is not None
        same = keys.reshape(-1, 1).cpu() == self._known
        if not same.any(1).all():
            return False
        label, moved = same.int().argmax(1), torch.zeros(length, dtype=torch.bool)
        moved[rows] = True  # overwritten rows leave their previous pass
        passes, cursors = [], []
        orders = self._order.split(self._size.tolist())
        for group, (order, cursor) in enumerate(zip(orders, self._cursor.tolist(), strict=True)):
            stays = ~moved[order]
            drawn, left = order[:cursor][stays[:cursor]], order[cursor:][stays[cursor:]]
            left = torch.cat([left, rows[label == group]])
            if not len(left):  # the pass has ended
                drawn, left = left, drawn
            passes.append(torch.cat([drawn, left[torch.randperm(len(left), generator=self._rng)]]))
            cursors.append(len(drawn))
        size = torch.tensor([len(order) for order in passes])
        if not size.all():
            return False
        self._order, self._size, self._cursor = torch.cat(passes), size, torch.tensor(cursors)
        self._length, self._written = length, []
        return True

    def _start(self) -> Tensor:
        return self._size.cumsum(0) - self._size

    def _shuffle(self, order: np.ndarray) -> None:
        """Shuffle the rows of a group (n,) in place."""
        order[:] = order[torch.randperm(len(order), generator=self._rng).numpy()]

    def _take(self, order: np.ndarray, cursor: int, count: int) -> tuple[np.ndarray, int]:
        """Draw ``count`` rows of a group in the given ``order`` (n,) from ``cursor`` on; begin new passes as needed.
        Also return the new cursor, the number of rows drawn since the last pass ended.
        """
        parts = []
        while count:
            parts.append(order[cursor : cursor + count].copy())
            cursor, count = cursor + len(parts[-1]), count - len(parts[-1])
            if cursor == len(order):
                cursor = 0
                self._shuffle(order)
        return np.concatenate(parts), cursor

    def _layout(self, batch_size: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return the number of rows in each group (G,) and, for each batch row, its group (B,) and its index within
        that group (B,).
        """
        if self._laid_out is None or self._laid_out[0] != batch_size:
            weights, reason = self._weights(len(self._size))
            divisor = reduce(gcd, weights)
            self._weight = torch.tensor(weights) // divisor
            unit = sum(weights) // divisor
            multiple, rest = divmod(batch_size, unit)
            if rest and self.exact:
                near = " and ".join(str(size) for size in (multiple * unit, (multiple + 1) * unit) if size)
                raise ValueError(f"batch_size must be a multiple of {unit}, {reason}; nearest to {batch_size}: {near}")
            shares = self._rounded(batch_size, unit) if rest else self._weight * multiple
            group = torch.repeat_interleave(shares)
            place = torch.arange(len(group)) - (shares.cumsum(0) - shares)[group]
            self._laid_out = (0 if rest else batch_size, shares, group, place)  # rounded shares differ in each batch
        return self._laid_out[1:]

    def _rounded(self, batch_size: int, unit: int) -> Tensor:
        """Return the rounded number of rows of each group (G,), compensating for the rounding of earlier batches."""
        due = self._credit + self._weight * batch_size
        shares = due.div(unit, rounding_mode="floor").clamp(min=0)
        while rest := batch_size - int(shares.sum()):
            ahead = shares * unit - due
            if rest > 0:
                shares[ahead.argsort(stable=True)[:rest]] += 1
            else:
                able = (shares > 0).nonzero().flatten()
                shares[able[ahead[able].argsort(descending=True, stable=True)[:-rest]]] -= 1
        self._credit = due - shares * unit
        return shares

    @typed
    def sample(self, storage: Storage, batch_size: Count) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        index, info = self.draw(storage, batch_size)
        info = {name: to_device_of(storage, value) for name, value in info.items()}
        index = to_device_of(storage, index)
        return (index if storage.ndim == 1 else torch.unravel_index(index, storage.shape)), info

    def draw(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draw the indices (B,) int64 of a batch, counted along the flattened storage, on the CPU."""
        worker = get_worker_info()
        if worker is not None and worker.num_workers > 1 and self._process != os.getpid():
            problem = f"all {worker.num_workers} workers of the DataLoader would draw the same rows"
            raise RuntimeError(f"{problem}; in each worker, open the buffer again or set its sampler and generator")
        if not len(storage):
            raise ValueError("storage must hold at least one row, but it is empty")
        if self._restored and self._length:
            self._check_restored(storage)
        if (self._written or self._covered(storage) != self._length) and not self._move_written(storage):
            self._group(storage)
        # For so few numbers, NumPy takes a third of PyTorch's time.
        shares, group, place = (part.numpy() for part in self._layout(batch_size))
        order, size, cursor = self._order.numpy(), self._size.numpy(), self._cursor.numpy()
        starts = size.cumsum() - size
        index = order.take((starts + cursor)[group] + place, mode="clip")
        self.ran_out = False
        # Most batches end no pass, so one gather draws them. Rows of groups whose pass ends are replaced below.
        ending = cursor + shares >= size
        ended = ending.nonzero()[0].tolist()
        cursor += shares
        if ended:
            cursor[ended] -= shares[ended]
            batches = size / self._weight.numpy()
            longest, first = batches.max(), shares.cumsum() - shares
            for number in ended:
                own = order[starts[number] : starts[number] + size[number]]
                rows, cursor[number] = self._take(own, int(cursor[number]), int(shares[number]))
                index[first[number] : first[number] + len(rows)] = rows
                self.ran_out |= bool(batches[number] == longest)
        return torch.from_numpy(index), {}

    def add(self, index: Any, *, storage: Storage | None = None) -> None:
        """Register rows that were written, possibly through another buffer with the same storage."""
        self._written.append(torch.as_tensor(index, device="cpu").reshape(-1))

    extend = mark_update = add

    def state_dict(self) -> dict[str, Any]:
        """Return the order and position of each group's pass, and the rows written since the last batch."""
        none = torch.empty(0, dtype=torch.int64)
        known = none if self._known is None else self._known
        written = torch.cat(self._written) if self._written else none
        length = 0 if self._written and self._known is None else self._length  # 0: the next sample groups all rows
        values = self._order, self._size, self._cursor, self._credit, known, written, length, self.ran_out
        return {name: torch.as_tensor(value).clone() for name, value in zip(_STATE, values, strict=True)}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; the next sample raises ValueError if the state was saved for other rows."""
        order, size, cursor, credit, known, written, length, ran_out = (state_dict[n].cpu().clone() for n in _STATE)
        self._order, self._size, self._cursor, self._credit = order, size, cursor, credit
        self._known, self._written = known if len(known) else None, [written] if len(written) else []
        self._length, self.ran_out = int(length), bool(ran_out)
        self._laid_out, self._restored = None, True

    def _check_restored(self, storage: Storage) -> None:
        """Raise ValueError unless a restored state fits the storage's rows, except rows written after saving."""
        groups, length = torch.repeat_interleave(self._size), self._covered(storage)
        if self._written:
            old = ~torch.isin(self._order, torch.cat(self._written)) & (self._order < length)
            keys = None if self._known is None else self._keys(storage, self._order[old])
            if keys is None or self._known is None or not torch.equal(keys.reshape(-1).cpu(), self._known[groups[old]]):
                self._length, self._written = 0, []
        else:
            label = self._label(storage).cpu()
            same_rows = torch.equal(self._order.sort().values, (label >= 0).nonzero().flatten())
            if length != self._length or not same_rows or not torch.equal(label[self._order], groups):
                raise ValueError("state_dict must fit the storage's rows, got a state for other rows")
        self._restored = False

    def dumps(self, path: AnyPath) -> None:
        """Save the state atomically to one file in a folder."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: AnyPath) -> None:
        """Restore a state saved by :meth:`dumps`; raise ValueError if the file is corrupted or has no sampler state."""
        with reading(path, "sampler's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))


class TaskBalancedSampler(GroupSampler):
    """A sampler that draws equally many rows of every task; within a task, rows are drawn without replacement.

    The sampler works in any :class:`torchrl.data.ReplayBuffer`. The buffer may grow: a new row takes a random position
    in the rest of its task's pass, and an overwritten row leaves its pass. When a task appears or disappears, all
    passes start over. The sampler draws from the replay buffer's generator, so ``ReplayBuffer(..., generator=...)``
    determines the batches, and its state is saved with the buffer's state. An epoch is a pass over the largest task.
    TorchRL does not report ``replay[i] = rows`` to samplers, so use ``extend`` to add rows of other tasks.

    Args:
        task_key: the key of the task in the storage, one number per row, of any shape.
        exact: raise an error if the batch size is not a multiple of the number of tasks. If false, the tasks get the
            remaining rows in turn.

    Raises:
        ValueError: when sampling, if a row has several tasks, or with ``exact``, if the tasks do not divide the batch.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(10), sampler=TaskBalancedSampler(), batch_size=4)
        >>> _ = replay.extend(TensorDict({"task_id": torch.tensor([3] * 8 + [7] * 2)}, [10]))
        >>> replay.sample()["task_id"].bincount(minlength=8).tolist()
        [0, 0, 0, 2, 0, 0, 0, 2]

    Source: paper section 'Cross-Task Co-Learning via 1:1 Data Mixing' (minibatches with equally many rows per task).
    """

    @typed
    def __init__(self, task_key: NestedKey = "task_id", *, exact: bool = False) -> None:
        self.task_key = task_key
        super().__init__(exact)

    def _label(self, storage: Storage) -> Tensor:
        return torch.unique(column(storage, self.task_key), return_inverse=True)[1]

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor:
        return column(storage, self.task_key, rows)

    def _weights(self, groups: int) -> tuple[list[int], str]:
        return [1] * groups, "the number of tasks"


class CoLearningSampler(GroupSampler):
    """A sampler that draws part of every minibatch from a target task, and the rest in equal parts from the base tasks.

    The sampler works in any :class:`torchrl.data.ReplayBuffer`. Each task is drawn without replacement, in its own
    passes. ``ran_out`` is True at the end of an epoch, a pass over the task that takes the most batches. The sampler
    draws from the replay buffer's generator; a restored state continues with the same batches.

    If the rows have a column ``dataset``, which :func:`load_demonstrations` writes for several folders, target rows are
    drawn only from the last dataset that contains the target. A batch holds the target's rows, followed by the rows of
    the base tasks in the order of the task ids; the column ``is_target`` (B,) bool marks the target's rows.

    Args:
        target: the target task: a name, a :class:`Task` or a task id.
        target_fraction: the target's fraction of a minibatch, between 0 and 1, such as 0.5, 1/3 or Fraction(2, 7).
        task_key: the key of the task in the storage, one number per row, of any shape.
        exact: raise an error if the batch size cannot be split exactly. If false, the shares are rounded, and later
            batches compensate.

    Raises:
        ValueError: when sampling, if the target or the base tasks have no rows, or with ``exact``, if the batch size
            cannot be split exactly (the message gives the nearest valid batch sizes).

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

    @typed
    def __init__(
        self,
        target: str | int | Task,
        *,
        target_fraction: float | Fraction = 0.5,
        task_key: NestedKey = "task_id",
        exact: bool = False,
    ) -> None:
        # The float 1/3 is not exactly a third, so the shares are computed with the nearest simple fraction.
        self.target_fraction = Fraction(target_fraction).limit_denominator(10_000)
        if not 0 < target_fraction < 1 or not isclose(self.target_fraction, target_fraction, rel_tol=1e-9):
            ratio = "must be a ratio of integers up to 10000, above 0 and below 1"
            raise ValueError(f"target_fraction {ratio}, got {target_fraction} (about {self.target_fraction})")
        self.target, self.task_key = target, task_key
        name = target.name if isinstance(target, Task) else target
        self._target_id = task_id(name) if isinstance(name, str) else name
        super().__init__(exact)

    def _label(self, storage: Storage) -> Tensor:
        task = column(storage, self.task_key)
        is_target, is_base = task == self._target_id, task != self._target_id
        if not is_target.any() or not is_base.any():
            tasks = ", ".join(MT50[i] if 0 <= i < len(MT50) else str(i) for i in task.unique().tolist())
            raise ValueError(f"target: the storage must have rows of {self.target!r} and of other tasks, got {tasks}")
        with suppress(KeyError):  # rows of a single dataset lack this column
            dataset = column(storage, DATASET)
            is_target &= dataset == dataset[is_target].max()
        label = torch.where(is_target, 0, -1)
        label[is_base] = 1 + torch.unique(task[is_base], return_inverse=True)[1]
        return label

    def row_weights(self, storage: Storage) -> Tensor:
        """Return the expected fraction of a minibatch that each row takes, (R,) float32; 0 for rows never drawn."""
        label = self._label(storage)
        sizes = label[label >= 0].bincount()
        share = torch.tensor(self._weights(len(sizes))[0], dtype=torch.float32)
        return torch.where(label >= 0, (share / share.sum() / sizes)[label.clamp(min=0)], 0.0)

    def _weights(self, groups: int) -> tuple[list[int], str]:
        base, (part, whole) = groups - 1, self.target_fraction.as_integer_ratio()
        reason = f"so that {self.target_fraction} of it is from the target and {base} base tasks share the rest equally"
        return [part * base] + [whole - part] * base, reason

    def draw(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        index, info = super().draw(storage, batch_size)
        assert self._laid_out is not None
        return index, info | {"is_target": self._laid_out[2] == 0}

    def _identity(self) -> dict[str, Tensor]:
        fraction = torch.tensor([self.target_fraction.numerator, self.target_fraction.denominator])
        return {"target": torch.tensor(self._target_id), "target_fraction": fraction}

    def state_dict(self) -> dict[str, Any]:
        """Return the sampler's state, including the target and the target fraction."""
        return super().state_dict() | self._identity()

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; raise ValueError if it is invalid or has a different target or target fraction."""
        for name, own in self._identity().items():
            stored = state_dict.get(name)
            if not isinstance(stored, Tensor) or not torch.equal(stored.cpu(), own):
                raise ValueError(f"state_dict has a different {name} than this sampler: {getattr(self, name)!r}")
        super().load_state_dict(state_dict)
