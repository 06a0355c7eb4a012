"""GroupSampler: exact numbers from groups of rows, each group gone through in passes of its own."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl.data.sampler_state import check_state, read_state
from lw_torchrl.data.storage import JoinedStorage


def column(storage: Storage, key: NestedKey) -> Tensor:
    """One column of all rows of a storage; a joined one would otherwise copy all columns."""
    if isinstance(storage, JoinedStorage):
        return storage.column(key)
    found = storage.get(slice(0, len(storage))).get(key, None)
    if found is None:
        raise KeyError(f"the storage has no column {key!r}, by which rows are to be grouped")
    return found


def nearest_sizes(batch_size: int, unit: int) -> str:
    """The multiples of ``unit`` around a batch size that is none, in words."""
    below = batch_size // unit * unit
    return " and ".join(str(size) for size in (below, below + unit) if size)


class GroupSampler(Sampler):
    """Exact numbers from groups of rows; within a group every row comes once before any comes again.

    A subclass says which group each row is in (:meth:`_label`) and how many a batch has of each (:meth:`_shares`).
    A batch holds the groups one after another. A group's pass goes on over the end of a batch and, where a batch asks
    for more than is left, over the end of the pass: the rest comes from the next pass, in a new order.
    """

    def __init__(self) -> None:
        self._empty()

    def _empty(self) -> None:
        self._length = 0
        self._order = torch.empty(0, dtype=torch.int64)  # rows by group, each group shuffled
        self._start = torch.empty(0, dtype=torch.int64)  # of each group
        self._size = torch.empty(0, dtype=torch.int64)
        self._cursor = torch.empty(0, dtype=torch.int64)
        self._ran_out = False
        self._restored = False
        self._laid_out: tuple[int, Tensor, Tensor, Tensor] | None = None  # see _layout

    @abstractmethod
    def _label(self, storage: Storage) -> Tensor:
        """The group of each row: (R,) int64, 0 to G-1 without a gap, or -1 for a row that is left out."""

    @abstractmethod
    def _shares(self, batch_size: int) -> Tensor:
        """The rows of each group in a batch: (G,) int64, at least 1; a size that cannot be exact raises ValueError."""

    @property
    def ran_out(self) -> bool:
        """Whether the last batch ended an epoch: a pass over the group that takes the most batches."""
        return self._ran_out

    @ran_out.setter
    def ran_out(self, value: bool) -> None:
        self._ran_out = value

    def _group(self, storage: Storage) -> None:
        label = self._label(storage).cpu()
        order = torch.argsort(label, stable=True)
        self._order = order[int((label < 0).sum()) :]
        self._size = label[label >= 0].bincount()
        self._start = self._size.cumsum(0) - self._size
        self._cursor = torch.zeros_like(self._size)
        self._length = len(storage)
        self._laid_out = None
        self._restored = False
        for group in range(len(self._size)):
            self._shuffle(group)

    def _shuffle(self, group: int) -> None:
        start, size = int(self._start[group]), int(self._size[group])
        rows = self._order[start : start + size]
        self._order[start : start + size] = rows[torch.randperm(size, generator=self._rng)]
        self._cursor[group] = 0

    def _take(self, group: int, count: int) -> tuple[Tensor, bool]:
        """``count`` rows of a group, over the end of its pass, and whether a pass ended."""
        taken, ended = [], False
        start, size = int(self._start[group]), int(self._size[group])
        while count:
            cursor = int(self._cursor[group])
            found = self._order[start + cursor : start + min(size, cursor + count)].clone()
            taken.append(found)
            self._cursor[group] += len(found)
            count -= len(found)
            if self._cursor[group] == size:
                ended = True
                self._shuffle(group)
        return torch.cat(taken), ended

    def _layout(self, batch_size: int) -> tuple[Tensor, Tensor, Tensor]:
        """The share of each group (G,), the group of each row of a batch (B,), its place within the group's (B,)."""
        if self._laid_out is None or self._laid_out[0] != batch_size:
            shares = self._shares(batch_size)
            group = torch.repeat_interleave(shares)
            place = torch.arange(batch_size) - (shares.cumsum(0) - shares)[group]
            self._laid_out = (batch_size, shares, group, place)
        return self._laid_out[1:]

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        """Draw ``batch_size`` indices, group after group."""
        if not len(storage):
            raise ValueError("storage must hold at least one row, got an empty one")
        if self._restored and self._length:
            self._check_restored(storage)
        elif len(storage) != self._length:
            self._group(storage)
        shares, group, place = self._layout(batch_size)
        at = (self._start + self._cursor)[group].add_(place).clamp_(max=len(self._order) - 1)
        index = self._order[at]
        self._ran_out = False
        ending = self._cursor + shares >= self._size
        self._cursor += torch.where(ending, 0, shares)
        if ending.any():
            batches = self._size / shares
            longest = batches == batches.max()
            first = shares.cumsum(0) - shares
            for number in ending.nonzero().flatten().tolist():
                rows, ended = self._take(number, int(shares[number]))
                index[first[number] : first[number] + len(rows)] = rows
                self._ran_out |= ended and bool(longest[number])
        return index, {}

    def add(self, index: Any) -> None:
        """Group the rows again at the next sample, since one was written, over an old one perhaps."""
        self._length = 0

    extend = add

    def state_dict(self) -> dict[str, Any]:
        """The shuffled order and how far each group's pass has come."""
        return {
            "length": torch.tensor(self._length),
            "order": self._order.clone(),
            "start": self._start.clone(),
            "size": self._size.clone(),
            "cursor": self._cursor.clone(),
            "ran_out": torch.tensor(self._ran_out),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore what :meth:`state_dict` gave.

        Raises:
            ValueError: it is no such state. Whether it is one of the storage's rows shows at the next sample, which
                raises it then.
        """
        state = check_state(state_dict)
        self._length, self._ran_out = state["length"], state["ran_out"]
        self._order, self._start = state["order"].clone(), state["start"].clone()
        self._size, self._cursor = state["size"].clone(), state["cursor"].clone()
        self._laid_out = None
        self._restored = True

    def _check_restored(self, storage: Storage) -> None:
        """Raise unless a restored state is of the storage's rows, in their groups."""
        if len(storage) != self._length:
            raise ValueError(f"state_dict must be of the storage's {len(storage)} rows, got one of {self._length}")
        label = self._label(storage).cpu()
        groups = torch.repeat_interleave(self._size)
        if len(groups) != int((label >= 0).sum()) or not torch.equal(label[self._order], groups):
            raise ValueError("state_dict must be of the storage's rows, got one whose groups are others")
        self._restored = False

    def dumps(self, path: Any) -> None:
        """Write the state to a folder, memory-mapped."""
        TensorDict(self.state_dict()).memmap(path)

    def loads(self, path: Any) -> None:
        """Read the state that :meth:`dumps` wrote.

        Raises:
            ValueError: it is damaged, or of something else.
        """
        self.load_state_dict(read_state(Path(path)))
