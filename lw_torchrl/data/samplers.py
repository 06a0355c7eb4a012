"""Samplers whose counts are exact: groups of rows, each gone through in passes of its own."""

from __future__ import annotations

from abc import abstractmethod
from math import prod
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._files import read_json
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
        state = _checked(state_dict)
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
        self.load_state_dict(_read_state(Path(path)))


def _read_state(folder: Path) -> dict[str, Any]:
    """The tensors in a folder, if each file is as long as its description says; a shorter one would be lengthened."""
    try:
        for name, leaf in read_json(folder / "meta.json", "path: the description", limit=2**20).items():
            if not isinstance(leaf, dict):
                continue
            if set(leaf) != {"device", "shape", "dtype", "is_nested"} or leaf["is_nested"] or "/" in name:
                raise ValueError(f"{name} is no tensor")
            dtype = {"torch.int64": torch.int64, "torch.bool": torch.bool}[leaf["dtype"]]
            if not all(type(size) is int and 0 <= size < 2**48 for size in leaf["shape"]):
                raise ValueError(f"{name} is of no shape")
            size, file = prod(leaf["shape"]) * dtype.itemsize, folder / f"{name}.memmap"
            if (there := file.stat().st_size if file.is_file() else 0) != size:
                raise ValueError(f"{name}.memmap has {there} bytes, not {size}")
        return TensorDict.load_memmap(folder, allow_pickle=False).to_dict()
    except (OSError, RuntimeError, TypeError, KeyError, ValueError) as error:
        raise ValueError(f"path: {str(folder)!r} holds no sampler's state ({type(error).__name__}: {error})") from error


def _checked(state: Any) -> dict[str, Any]:
    """A sampler's state whose parts fit one another: the groups' rows one after another, each row once."""

    def require(holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ValueError(f"state_dict: {name} must be {wanted}, got {short(state.get(name))}")

    found: dict[str, Any] = {}
    for name, dtype in (("length", torch.int64), ("ran_out", torch.bool)):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == dtype and given.numel() == 1, name, f"one {dtype}")
        found[name] = given.item()
    require(found["length"] >= 0, "length", "at least 0")
    for name in ("order", "start", "size", "cursor"):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == torch.int64 and given.dim() == 1, name, "(n,) int64")
        found[name] = given.cpu()
    order, start, size, cursor = (found[name] for name in ("order", "start", "size", "cursor"))
    rows = len(order)
    require(
        bool(((size > 0) & (size <= rows)).all()) and int(size.sum()) == rows, "size", f"of {rows} rows, none empty"
    )
    require(torch.equal(start, size.cumsum(0) - size), "start", "where the groups begin")
    fits = cursor.shape == size.shape and bool(((cursor >= 0) & (cursor < size)).all())
    require(fits, "cursor", "a place within each group")
    inside = rows <= found["length"] and bool(((order >= 0) & (order < found["length"])).all())
    require(inside and len(order.unique()) == rows, "order", f"rows below {found['length']}, each once")
    return found


class TaskBalancedSampler(GroupSampler):
    """Equal numbers from every task, exactly; within a task every row once before any comes again.

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

    def __init__(self, task_key: str = "task_id") -> None:
        self.task_key = task_key
        super().__init__()

    def _label(self, storage: Storage) -> Tensor:
        return torch.unique(column(storage, self.task_key).reshape(-1), return_inverse=True)[1]

    def _shares(self, batch_size: int) -> Tensor:
        groups = len(self._size)
        count, rest = divmod(batch_size, groups)
        if rest or not count:
            raise ValueError(
                f"batch_size must be divisible by the number of tasks, {groups}, got {batch_size}; the nearest are "
                + nearest_sizes(batch_size, groups)
            )
        return torch.full((groups,), count)
