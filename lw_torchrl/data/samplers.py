"""GroupSampler and TaskBalancedSampler: exact numbers of rows from each group, each group in passes of its own."""

from __future__ import annotations

import os
from abc import abstractmethod
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor
from torch.utils.data import get_worker_info
from torchrl.data.replay_buffers.samplers import Sampler
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._checks import check_int
from lw_torchrl._files import reading
from lw_torchrl._keys import check_key
from lw_torchrl._tensor_archive import TensorArchive, write_archive
from lw_torchrl.data.passes import Passes, check_state
from lw_torchrl.data.storage import JoinedStorage, to_device_of

_FILE = "sampler.zip"


def column(storage: Storage, key: NestedKey, index: Tensor | None = None) -> Tensor:
    """One column of all rows of a storage, row-major if of several dimensions, or of those at an index, on the CPU."""
    if isinstance(storage, JoinedStorage):
        return storage.column(key, index).cpu()
    rows = storage.get(slice(0, len(storage)))
    each = [row.get(key, None) for row in rows] if isinstance(rows, list) else [rows.get(key, None)]
    if any(one is None for one in each):
        raise KeyError(f"the storage has no column {key!r}, by which rows are to be grouped")
    found = torch.stack(each) if isinstance(rows, list) else each[0]
    found = found.flatten(0, storage.ndim - 1)
    return (found if index is None else found[index.to(found.device)]).cpu()


def nearest_sizes(batch_size: int, unit: int) -> str:
    """The multiples of ``unit`` next to a batch size, in words."""
    below = batch_size // unit * unit
    return " and ".join(str(size) for size in (below, below + unit) if size)


class GroupSampler(Sampler):
    """Exact numbers from groups of rows; within a group every row comes once before any comes again.

    A subclass gives the group of each row (:meth:`_label`) and the rows of each group in a batch (:meth:`_shares`). A
    batch holds the groups one after another. Where a group's pass ends within a batch, the rest comes from the next
    pass, in a new order. For a storage of several dimensions (``ndim=2``) an index is a tuple of as many tensors.

    Rows may be written and overwritten. If the subclass tells a row's group by a column (:meth:`_keys`), groups and
    passes are updated: a new row takes a random place in what is left of its group's pass, and the work is that of the
    new rows. Otherwise, when a group comes or goes, and with several dimensions, all are grouped and all passes begin.
    """

    ran_out = False  # whether the last batch ended an epoch: a pass over the group that takes the most batches

    def __init__(self) -> None:
        self._process = os.getpid()
        self._empty()

    def _empty(self) -> None:
        self._length = 0
        none = torch.empty(0, dtype=torch.int64)
        self._passes = Passes(none, none)
        self._known: Tensor | None = None  # the key of each group's rows
        self._written: list[Tensor] = []  # rows written since the last batch
        self.ran_out = False
        self._restored = False
        self._laid_out: tuple[int, Tensor, Tensor, Tensor] | None = None  # see _layout

    @abstractmethod
    def _label(self, storage: Storage) -> Tensor:
        """The group of each row: (R,) int64, 0 to G-1 without a gap, or -1 for a row that is left out."""

    @abstractmethod
    def _shares(self, batch_size: int) -> Tensor:
        """The rows of each group in a batch: (G,) int64, at least 1; a size that cannot be exact raises ValueError."""

    def _keys(self, storage: Storage, rows: Tensor) -> Tensor | None:
        """The key of each row's group, (n,) int64; None where that takes a look at all rows."""
        return None

    def _covered(self, storage: Storage) -> int:
        """How many of the first rows are grouped."""
        return len(storage) if storage.ndim == 1 else storage.shape.numel()

    def _group(self, storage: Storage) -> None:
        label = self._label(storage).cpu()
        order = torch.argsort(label, stable=True)
        self._passes = Passes(order[int((label < 0).sum()) :], label[label >= 0].bincount())
        self._length = self._covered(storage)
        self._laid_out = None
        self._restored, self._written = False, []
        self._know(storage)
        for group in range(len(self._passes.size)):
            self._passes.shuffle(group, self._rng)

    def _know(self, storage: Storage) -> None:
        found = self._keys(storage, self._passes.order[self._passes.start]) if storage.ndim == 1 else None
        self._known = None if found is None else found.reshape(-1).cpu()

    def _take_in(self, storage: Storage) -> bool:
        """Move the rows that were written to their groups; False if all rows must be grouped again."""
        if self._known is None or not self._written:
            return False
        rows = torch.cat(self._written).unique()
        self._written = []
        length = self._covered(storage)
        if rows[0] < 0 or rows[-1] >= length or int((rows >= self._length).sum()) != length - self._length:
            return False
        keys = self._keys(storage, rows)
        assert keys is not None
        same = keys.reshape(-1, 1).cpu() == self._known
        if not same.any(1).all():
            return False
        self._passes.exchange(rows, same.int().argmax(1), self._rng)
        self._length = length
        return bool((self._passes.size > 0).all())

    def _layout(self, batch_size: int) -> tuple[Tensor, Tensor, Tensor]:
        """The share of each group (G,), the group of each row of a batch (B,), its place within the group's (B,)."""
        if self._laid_out is None or self._laid_out[0] != batch_size:
            shares = self._shares(batch_size)
            group = torch.repeat_interleave(shares)
            place = torch.arange(len(group)) - (shares.cumsum(0) - shares)[group]
            self._laid_out = (batch_size, shares, group, place)
        return self._laid_out[1:]

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        batch_size = check_int("batch_size", batch_size, minimum=1)
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
        if (self._written or self._covered(storage) != self._length) and not self._take_in(storage):
            self._group(storage)
        shares, group, place = self._layout(batch_size)
        passes = self._passes
        at = (passes.start + passes.cursor)[group].add_(place).clamp_(max=len(passes.order) - 1)
        index = passes.order[at]
        self.ran_out = False
        ending = passes.cursor + shares >= passes.size
        passes.cursor += torch.where(ending, 0, shares)
        if ending.any():
            batches = passes.size / shares
            longest = batches == batches.max()
            first = shares.cumsum(0) - shares
            for number in ending.nonzero().flatten().tolist():
                rows, ended = passes.take(number, int(shares[number]), self._rng)
                index[first[number] : first[number] + len(rows)] = rows
                self.ran_out |= ended and bool(longest[number])
        index = to_device_of(storage, index)
        return (index if storage.ndim == 1 else torch.unravel_index(index, storage.shape)), {}

    def add(self, index: Any, *, storage: Storage | None = None) -> None:
        """Note that rows were written, perhaps by another buffer of the same storage."""
        rows = torch.as_tensor(index, device="cpu").reshape(-1)
        self._written.append(rows)
        if sum(map(len, self._written)) > 2 * self._length:
            self._length, self._written = 0, []  # it is as much work to group all rows again

    extend = mark_update = add

    def state_dict(self) -> dict[str, Any]:
        """The shuffled order, how far each group's pass has come, and the rows written since the last batch."""
        none = torch.empty(0, dtype=torch.int64)
        begun = self._length > 0 and not (self._written and self._known is None)  # otherwise all is grouped again
        passes = self._passes if begun else Passes(none, none)
        return {
            "length": torch.tensor(self._length if begun else 0),
            "order": passes.compact(),
            "start": passes.size.cumsum(0) - passes.size,
            "size": passes.size.clone(),
            "cursor": passes.cursor.clone(),
            "known": self._known.clone() if begun and self._known is not None else none,
            "written": torch.cat(self._written) if begun and self._written else none,
            "ran_out": torch.tensor(self.ran_out),
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; :class:`ValueError` if it is none, or at the next sample if it is of other rows."""
        state = check_state(state_dict)
        self._length, self.ran_out = state["length"], state["ran_out"]
        self._passes = Passes(state["order"].clone(), state["size"].clone(), state["cursor"].clone())
        self._known = state["known"].clone() if len(state["known"]) else None
        self._written = [state["written"].clone()] if len(state["written"]) else []
        self._laid_out = None
        self._restored = True

    def _check_restored(self, storage: Storage) -> None:
        """Raise unless a restored state is of the storage's rows; with rows written since, all may be grouped again."""
        rows, groups = self._passes.order, torch.repeat_interleave(self._passes.size)
        length = self._covered(storage)
        if self._written:
            old = ~torch.isin(rows, torch.cat(self._written)) & (rows < length)
            keys = None if self._known is None else self._keys(storage, rows[old])
            if keys is None or not torch.equal(keys.reshape(-1).cpu(), self._known[groups[old]]):  # type: ignore[index]
                self._length = 0
            self._restored = False
            return
        if length != self._length:
            raise ValueError(f"state_dict must be of the storage's {length} rows, got one of {self._length}")
        label = self._label(storage).cpu()
        if len(rows) != int((label >= 0).sum()) or not torch.equal(label[rows], groups):
            raise ValueError("state_dict must be of the storage's rows, got one whose groups are others")
        self._know(storage)
        self._restored = False

    def dumps(self, path: Any) -> None:
        """Write the state to a folder, as one file that is there whole or not at all."""
        write_archive(Path(path) / _FILE, {}, {"state": self.state_dict()})

    def loads(self, path: Any) -> None:
        """Read the state that :meth:`dumps` wrote; a ValueError if it is damaged, or of something else."""
        with reading(path, "sampler's state"):
            self.load_state_dict(TensorArchive(Path(path) / _FILE).tensors("state"))


class TaskBalancedSampler(GroupSampler):
    """Equal numbers from every task, exactly; within a task every row comes once before any comes again.

    The buffer may grow: new rows take random places in the present passes, and overwritten ones leave them; when a task
    comes or goes, all passes begin anew. It draws from the replay buffer's generator, so ``ReplayBuffer(...,
    generator=...)`` fixes the batches; its state is saved with the buffer's. An epoch is a pass over the largest task.
    The storage's entry ``task_key`` holds the task.

    Raises:
        ValueError: at sampling, a batch size that the number of tasks does not divide (with the nearest that it does).

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
            what = f"batch_size must be divisible by the number of tasks, {groups}, got {batch_size}"
            raise ValueError(f"{what}; the nearest are {nearest_sizes(batch_size, groups)}")
        return torch.full((groups,), count)
