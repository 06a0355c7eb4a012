"""GroupSampler and TaskBalancedSampler: fixed shares of rows from each group, each group in passes of its own."""

from __future__ import annotations

import os
from abc import abstractmethod
from functools import reduce
from math import gcd
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._util.checks import Count, check_value
from lw_torchrl._util.files import reading
from lw_torchrl._util.keys import check_key
from lw_torchrl._util.tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data.storage import to_device_of

_FILE = "sampler.safetensors"


def column(storage: Storage, key: NestedKey, rows: Tensor | None = None) -> Tensor:
    """Return the one value of a column in each row, (R,), or in some rows, on the CPU.

    A row may hold the value in any shape, for example (1,), or (T,) if rows are pieces of trajectories.
    """
    data = storage.get(slice(0, len(storage)))
    leaves = [row.get(key, None) for row in data] if isinstance(data, list) else [data.get(key, None)]
    if any(leaf is None for leaf in leaves):
        raise KeyError(f"the storage has no column {key!r}, by which rows are to be grouped")
    whole = (torch.stack(leaves) if isinstance(data, list) else leaves[0]).flatten(0, storage.ndim - 1)
    values = (whole if rows is None else whole[rows.to(whole.device)]).cpu()
    if values.dim() == 1:
        return values
    values = values.flatten(1)
    if not (values == values[:, :1]).all():
        raise ValueError(f"column {key!r} must have one value a row, got rows with several; split them by {key!r}")
    return values[:, 0]


class GroupSampler(Sampler):
    """Fixed shares of rows from each group; within a group every row comes once before any comes again.

    A subclass gives the group of each row (:meth:`_label`) and the share of each group (:meth:`_weights`). A batch
    holds the groups one after another. If a batch size cannot be divided exactly, the shares are rounded, and later
    batches make up for it, so that the totals stay within one row of the shares; with ``exact`` such a size is refused.
    If a group's pass ends within a batch, the rest comes from the next pass, in a new order. For a storage of several
    dimensions (``ndim=2``) an index is a tuple of tensors. A row that is written takes a random place in the rest of
    its group's pass. All rows are grouped again, and all passes begin again, if a group comes or goes, or if a subclass
    cannot tell the group of single rows (:meth:`_keys`).
    """

    ran_out = False  # whether the last batch ended an epoch: a pass over the group that takes the most batches

    def __init__(self, exact: bool = False) -> None:
        if not isinstance(exact, bool):
            raise TypeError(f"exact must be True or False, got {exact!r}")
        self.exact = exact
        self._process = os.getpid()
        self._empty()

    def _empty(self) -> None:
        none = torch.empty(0, dtype=torch.int64)
        self._length = 0  # rows that are grouped; 0 to group again
        # The rows, group after group, each in the order of its pass; the size of each group, and its rows drawn so far.
        self._order, self._size, self._cursor = none, none, none
        # The share of each group as whole numbers, and the rows that each is owed by rounding, times their sum.
        self._weight, self._credit = none, none
        self._known: Tensor | None = None  # the key of each group's rows
        self._written: list[Tensor] = []  # rows written since the last batch
        self.ran_out = False
        self._restored = False
        self._laid_out: tuple[int, Tensor, Tensor, Tensor] | None = None  # see _layout

    @abstractmethod
    def _label(self, storage: Storage) -> Tensor:
        """The group of each row: (R,) int64, 0 to G-1 without a gap, or -1 for a row that is left out."""

    @abstractmethod
    def _weights(self, groups: int) -> tuple[list[int], str]:
        """The share of each of G groups as whole numbers of at least 1, and the reason for them, in words."""

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor | None:
        """The key of each row's group, (n,) int64; None if that takes a look at all rows."""
        return None

    def _covered(self, storage: Storage) -> int:
        """The number of first rows that are grouped."""
        return len(storage) if storage.ndim == 1 else storage.shape.numel()

    def _group(self, storage: Storage) -> None:
        label = self._label(storage).cpu()
        order = torch.argsort(label, stable=True)
        self._order, self._size = order[int((label < 0).sum()) :], label[label >= 0].bincount()
        self._cursor, self._credit = torch.zeros_like(self._size), torch.zeros_like(self._size)
        self._length, self._laid_out, self._restored = self._covered(storage), None, False
        self._written, self._known = [], self._keys_of_groups(storage)
        for group in range(len(self._size)):
            self._shuffle(group)

    def _keys_of_groups(self, storage: Storage) -> Tensor | None:
        keys = self._keys(storage, self._order[self._start()]) if storage.ndim == 1 else None
        return None if keys is None else keys.reshape(-1).cpu()

    def _move_written(self, storage: Storage) -> bool:
        """Move the rows that were written to the passes of their groups; False if all rows must be grouped again."""
        if self._known is None or not self._written:
            return False
        rows, length = torch.cat(self._written).unique(), self._covered(storage)
        if rows[0] < 0 or rows[-1] >= length or int((rows >= self._length).sum()) != length - self._length:
            return False
        keys = self._keys(storage, rows)
        assert keys is not None
        same = keys.reshape(-1, 1).cpu() == self._known
        if not same.any(1).all():
            return False
        label, moved = same.int().argmax(1), torch.zeros(length, dtype=torch.bool)
        moved[rows] = True
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

    def _shuffle(self, group: int) -> None:
        start, size = int(self._start()[group]), int(self._size[group])
        rows = self._order[start : start + size]
        self._order[start : start + size] = rows[torch.randperm(size, generator=self._rng)]
        self._cursor[group] = 0

    def _take(self, group: int, count: int) -> tuple[Tensor, bool]:
        """``count`` rows of a group, across the end of its pass, and whether a pass ended."""
        parts, ended = [], False
        start, size = int(self._start()[group]), int(self._size[group])
        while count:
            cursor = int(self._cursor[group])
            rows = self._order[start + cursor : start + min(size, cursor + count)].clone()
            parts.append(rows)
            self._cursor[group] += len(rows)
            count -= len(rows)
            if self._cursor[group] == size:
                ended = True
                self._shuffle(group)
        return torch.cat(parts), ended

    def _layout(self, batch_size: int) -> tuple[Tensor, Tensor, Tensor]:
        """The share of each group (G,), the group of each row of a batch (B,), its place within the group's (B,)."""
        if self._laid_out is None or self._laid_out[0] != batch_size:
            weights, reason = self._weights(len(self._size))
            divisor = reduce(gcd, weights)
            self._weight = torch.tensor(weights) // divisor
            unit = sum(weights) // divisor
            if not batch_size % unit:
                shares = self._weight * (batch_size // unit)
            elif self.exact:
                near = " and ".join(
                    str(size) for size in (batch_size // unit * unit, (batch_size // unit + 1) * unit) if size
                )
                raise ValueError(
                    f"batch_size must be a multiple of {unit}, {reason}, got {batch_size}; the nearest are {near}"
                )
            else:
                shares = self._rounded(batch_size, unit)
            group = torch.repeat_interleave(shares)
            place = torch.arange(len(group)) - (shares.cumsum(0) - shares)[group]
            self._laid_out = (0 if batch_size % unit else batch_size, shares, group, place)  # rounded ones differ
        return self._laid_out[1:]

    def _rounded(self, batch_size: int, unit: int) -> Tensor:
        """The share of each group in a batch that cannot be exact, with what earlier batches owe."""
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

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        batch_size = check_value("batch_size", batch_size, Count)
        worker = get_worker_info()
        if worker is not None and worker.num_workers > 1 and self._process != os.getpid():
            raise RuntimeError(
                f"each of the DataLoader's {worker.num_workers} workers would draw the same rows: in each, open the "
                "buffer anew, or replay.set_sampler(...) and replay.set_rng(...); see docs/sampling.md"
            )
        if not len(storage):
            raise ValueError("storage must hold at least one row, got an empty one")
        if self._restored and self._length:
            self._check_restored(storage)
        if (self._written or self._covered(storage) != self._length) and not self._move_written(storage):
            self._group(storage)
        shares, group, place = self._layout(batch_size)
        at = (self._start() + self._cursor)[group].add_(place).clamp_(max=len(self._order) - 1)
        index = self._order[at]
        self.ran_out = False
        ending = self._cursor + shares >= self._size
        self._cursor += torch.where(ending, 0, shares)
        if ending.any():
            batches = self._size / self._weight
            longest = batches == batches.max()
            first = shares.cumsum(0) - shares
            for number in ending.nonzero().flatten().tolist():
                rows, ended = self._take(number, int(shares[number]))
                index[first[number] : first[number] + len(rows)] = rows
                self.ran_out |= ended and bool(longest[number])
        index = to_device_of(storage, index)
        return (index if storage.ndim == 1 else torch.unravel_index(index, storage.shape)), {}

    def add(self, index: Any, *, storage: Storage | None = None) -> None:
        """Note that rows were written, perhaps by another buffer of the same storage."""
        self._written.append(torch.as_tensor(index, device="cpu").reshape(-1))

    extend = mark_update = add

    def state_dict(self) -> dict[str, Any]:
        """The rows in the order of their passes, how far each pass has come, and rows written since the last batch."""
        none = torch.empty(0, dtype=torch.int64)
        begun = self._length > 0 and not (self._written and self._known is None)  # otherwise all are grouped again
        order, size, cursor = (self._order, self._size, self._cursor) if begun else (none, none, none)
        return {
            "order": order.clone(),
            "size": size.clone(),
            "cursor": cursor.clone(),
            "credit": self._credit.clone() if begun else none,
            "known": self._known.clone() if begun and self._known is not None else none,
            "written": torch.cat(self._written) if begun and self._written else none,
            "length": torch.tensor(self._length if begun else 0),
            "ran_out": torch.tensor(self.ran_out),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; ValueError if it is not a sampler's, or at the next sample if it is of other rows."""
        names = ("order", "size", "cursor", "credit", "known", "written", "length", "ran_out")
        if missing := [name for name in names if not isinstance(state_dict.get(name), Tensor)]:
            raise ValueError(f"state_dict must hold {', '.join(names)}; it lacks {', '.join(missing)}")
        order, size, cursor, credit, known, written, length, ran_out = (state_dict[n].cpu().clone() for n in names)
        fits = len(order) == int(size.sum()) and size.shape == cursor.shape == credit.shape
        if not fits or bool((cursor >= size).any()):
            raise ValueError("state_dict must hold the passes of a sampler: rows, and a place in each pass")
        self._order, self._size, self._cursor, self._credit = order, size, cursor, credit
        self._known, self._written = known if len(known) else None, [written] if len(written) else []
        self._length, self.ran_out = int(length), bool(ran_out)
        self._laid_out, self._restored = None, True

    def _check_restored(self, storage: Storage) -> None:
        """Raise unless a restored state is of the storage's rows; with rows written since, all may be grouped again."""
        groups, length = torch.repeat_interleave(self._size), self._covered(storage)
        if self._written:
            old = ~torch.isin(self._order, torch.cat(self._written)) & (self._order < length)
            keys = None if self._known is None else self._keys(storage, self._order[old])
            if keys is None or self._known is None or not torch.equal(keys.reshape(-1).cpu(), self._known[groups[old]]):
                self._length, self._written = 0, []
            self._restored = False
            return
        if length != self._length:
            raise ValueError(f"state_dict must be of the storage's {length} rows, got one of {self._length}")
        label = self._label(storage).cpu()
        rows = (label >= 0).nonzero().flatten()
        if not torch.equal(self._order.sort().values, rows) or not torch.equal(label[self._order], groups):
            raise ValueError("state_dict must be of the storage's rows, got one whose groups differ")
        self._restored = False

    def dumps(self, path: Any) -> None:
        """Write the state to a folder, as one file that is there whole or not at all."""
        write_tensors(Path(path) / _FILE, {}, {}, self.state_dict())

    def loads(self, path: Any) -> None:
        """Read the state that :meth:`dumps` wrote; a ValueError if it is damaged, or of something else."""
        with reading(path, "sampler's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / _FILE)))


class TaskBalancedSampler(GroupSampler):
    """Draw equally many rows of every task; within a task every row comes once before any comes again.

    It works in any :class:`torchrl.data.ReplayBuffer`. The buffer may grow: a new row takes a random place in the rest
    of its task's pass, and an overwritten one leaves it. When a task comes or goes, all passes begin again. The sampler
    draws from the replay buffer's generator, so ``ReplayBuffer(..., generator=...)`` fixes the batches; its state is
    saved with the buffer's. An epoch is a pass over the largest task. TorchRL does not report ``replay[i] = rows`` to
    samplers: add rows of other tasks by ``extend``.

    Args:
        task_key: the entry of the storage that holds the task: one number a row, of any shape.
        exact: refuse a batch size that the number of tasks does not divide. Otherwise some tasks get one row more, in
            turn.

    Raises:
        ValueError: at sampling, a row with several tasks; with ``exact``, a size that cannot be divided exactly.

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

    def __init__(self, task_key: NestedKey = "task_id", *, exact: bool = False) -> None:
        check_key("task_key", task_key)
        self.task_key = task_key
        super().__init__(exact)

    def _label(self, storage: Storage) -> Tensor:
        return torch.unique(column(storage, self.task_key), return_inverse=True)[1]

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor:
        return column(storage, self.task_key, rows)

    def _weights(self, groups: int) -> tuple[list[int], str]:
        return [1] * groups, "the number of tasks"
