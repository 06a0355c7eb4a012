"""JoinedStorage: chosen rows of one or more datasets as one read-only storage; no column is copied."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from reprlib import repr as short
from typing import Any, NoReturn

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_leaf_nontensor
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._devices import CPU
from lw_torchrl._files import read_json, write_json
from lw_torchrl.data.rewards import STEPS, check_n_steps

TRAJECTORY, REWARD, DONE = ("collector", "traj_ids"), ("next", "reward"), ("next", "done")
DEMONSTRATION = "is_demonstration"  # true of a dataset's rows, false of those that a buffer was extended with


def column_name(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(key)


def flat_columns(rows: TensorDictBase) -> dict[str, Any]:
    """The columns by their names joined by dots."""
    keys = rows.keys(True, True)
    return {key if isinstance(key, str) else ".".join(key): rows.get(key) for key in keys}


def row_dictionaries(columns: Mapping[str, Any]) -> list[dict[str, Any]]:
    """A dictionary for each row of columns, tensors (n, ...) or lists of n."""
    parts = [column if isinstance(column, list) else column.unbind(0) for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*parts, strict=True)]


def _columns(parts: Sequence[TensorDictBase]) -> dict[NestedKey, list[Tensor]]:
    """The leaves of each column, which must agree in all parts."""
    columns: dict[NestedKey, list[Tensor]] = {}
    for number, part in enumerate(parts):
        leaves = {key: part.get(key) for key in part.keys(True, True, is_leaf=is_leaf_nontensor)}
        if number and (odd := sorted(map(column_name, leaves.keys() ^ columns.keys()))):
            raise ValueError(f"parts[{number}] must have the columns of parts[0], they differ in {', '.join(odd)}")
        for key, leaf in leaves.items():
            before = columns.setdefault(key, [leaf])[0]
            if (leaf.shape[1:], leaf.dtype) != (before.shape[1:], before.dtype):
                expected, actual = (f"{one.dtype} of shape {tuple(one.shape[1:])}" for one in (before, leaf))
                where = f"parts[{number}]: column {column_name(key)}"
                raise ValueError(f"{where} must be {expected} a row as in parts[0], got {actual}")
            if number:
                columns[key].append(leaf)
    return columns


class JoinedStorage(Storage):
    """Rows of several tensordicts, memory-mapped for example, behind one index. Only the requested batch is copied.

    The rows come in the order of the parts, and within a part in the order of ``rows``. The storage is read-only, and
    its state is its length. A replay buffer over it needs ``collate_fn=lambda batch: batch``.

    With ``n_steps``, the entries under ``"next"`` are those of the row N steps ahead, or of the trajectory's last row
    if that comes before. ``("next", "reward")`` is the discounted sum on the way, and ``steps_to_next_obs``, (B,)
    int64, the number of steps, which TorchRL's value estimators read.

    Args:
        parts: P tensordicts of one batch dimension and the same columns (names, dtypes, shapes of a row).
        rows: for each part the rows to take, (n,) int64, or None for all; None for all of all parts.
        n_steps: steps to ``("next", ...)``; 2 or more need the columns ("next", "reward"), (n, 1), ("next", "done") and
            ("collector", "traj_ids").
        gamma: the discount of the rewards on the way, in (0, 1]; the loss must use the same.

    Raises:
        ValueError: the parts' columns differ, or a column that ``n_steps`` needs is missing.
        RuntimeError: at an attempt to write.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> base, target = (TensorDict({"x": torch.arange(n)}, [n]) for n in (4, 100))
        >>> storage = JoinedStorage([base, target], rows=[None, torch.tensor([70, 71])])
        >>> storage[:]["x"].tolist(), storage[[5, 0]]["x"].tolist()
        ([0, 1, 2, 3, 70, 71], [71, 0])

    Source: ``torchrl.data.StorageEnsemble``, whose samplers name a storage with each index.
    """

    def __init__(
        self,
        parts: Sequence[TensorDictBase],
        rows: Sequence[Tensor | None] | None = None,
        *,
        n_steps: int = 1,
        gamma: float | None = None,
    ) -> None:
        self.n_steps, self.gamma = check_n_steps(n_steps, gamma)
        if not parts:
            raise ValueError("parts must hold at least one tensordict, got none")
        self._columns = _columns(parts)
        self._ends = torch.tensor([len(part) for part in parts]).cumsum(0)  # of the parts, all rows counted
        places = []
        chosen = [None] * len(parts) if rows is None else rows
        for number, (one, (start, end)) in enumerate(zip(chosen, pairwise(self._bounds()), strict=True)):
            local = torch.arange(end - start) if one is None else one.to(torch.int64)
            if len(local) and not 0 <= int(local.min()) <= int(local.max()) < end - start:
                raise IndexError(f"rows[{number}] must be in [0, {end - start})")
            places.append(local + start)
        self._rows = torch.cat(places)
        self.num_joined, self.num_parts = len(self._rows), len(parts)
        self._batch_device = parts[0].device
        self._places: Tensor | None = None  # of all rows, where rows have more columns than the parts
        super().__init__(max_size=len(self._rows))
        if self.n_steps > 1:
            self._look_ahead()

    def _bounds(self) -> list[int]:
        """Where each part begins and the last ends, all rows counted."""
        return [0, *self._ends.tolist()]

    def _look_ahead(self) -> None:
        """Note where each row's n steps end, and their discounted reward."""
        if absent := [column_name(key) for key in (REWARD, DONE, TRAJECTORY) if key not in self._columns]:
            raise ValueError(f"n_steps={self.n_steps} needs the columns {', '.join(absent)}, which parts do not have")
        found = self._gather(self._rows, [REWARD, DONE, TRAJECTORY])
        reward, trajectory = found[REWARD], found[TRAJECTORY].reshape(-1)
        part = torch.bucketize(self._rows, self._ends, right=True)
        end = found[DONE].reshape(-1).clone()
        end[:-1] |= (trajectory[1:] != trajectory[:-1]) | (part[1:] != part[:-1]) | (self._rows.diff() != 1)
        rows = self._places = torch.arange(len(end))
        next_end = torch.where(end, rows, max(len(end) - 1, 0)).flip(0).cummin(0).values.flip(0)
        self._last = torch.minimum(rows + self.n_steps - 1, next_end)
        self._ahead = self._last - rows + 1
        self._earned = reward.clone()
        for ahead in range(1, self.n_steps):  # summed in the order of time
            inside = (rows + ahead <= self._last).nonzero().flatten()
            self._earned[inside] += self.gamma**ahead * reward[inside + ahead]

    def __len__(self) -> int:
        return self.num_joined

    def part(self) -> Tensor:
        """The index of each row's part: (R,) int64."""
        return torch.bucketize(self._rows[: len(self)], self._ends, right=True)

    def column(self, key: NestedKey, index: Tensor | None = None) -> Tensor:
        """One column of all rows, (R, ...), or of those at ``index``, (n,) int64."""
        if key not in self.keys():
            raise KeyError(f"no column {column_name(key)}; there are {', '.join(map(column_name, self.keys()))}")
        return self._read(torch.arange(len(self)) if index is None else index, [key])[key]

    def keys(self) -> list[NestedKey]:
        return [*self._columns, *([STEPS] if self.n_steps > 1 else [])]

    def _read(self, index: Tensor, keys: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
        """The columns of the rows at an index (n,) int64, a fresh tensor each."""
        if self.n_steps == 1:
            return self._gather(self._rows[index], keys)
        ahead = [key for key in keys if key[0] == "next" and key != REWARD]
        here = [key for key in keys if key not in (*ahead, REWARD, STEPS)]
        found = self._gather(self._rows[index], here)
        if ahead:
            found |= self._gather(self._rows[self._last[index]], ahead)
        return found | {key: own[index] for key, own in ((REWARD, self._earned), (STEPS, self._ahead)) if key in keys}

    def add_column(self, key: NestedKey, values: Tensor) -> None:
        """Give each row a value, (R, ...) in the order of the rows, held in memory."""
        values = values.to(self._rows.device)
        whole = values.new_zeros((int(self._ends[-1]), *values.shape[1:]))
        whole[self._rows] = values
        self._columns[key] = [whole[start:end] for start, end in pairwise(self._bounds())]

    def _gather(self, rows: Tensor, keys: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
        """The columns of rows counted over all parts, a fresh tensor each."""
        if self.num_parts == 1:
            return {key: self._columns[key][0].index_select(0, rows) for key in keys}
        part, order = torch.bucketize(rows, self._ends, right=True).sort(stable=True)  # read part by part, then back
        starts = torch.tensor(self._bounds()[:-1])
        places = (rows[order] - starts[part]).split(part.bincount(minlength=self.num_parts).tolist())
        back = torch.empty_like(order)
        back[order] = torch.arange(len(order))
        columns = {}
        for key in keys:
            read = [leaf.index_select(0, own) for leaf, own in zip(self._columns[key], places, strict=True)]
            columns[key] = torch.cat(read).index_select(0, back)
        return columns

    def get(self, index: Any) -> TensorDict:
        """The rows at an int, a slice, a list, a mask or a tensor of indices of any shape, as fresh tensors."""
        plain = self._places is None
        rows = (self._rows if self._places is None else self._places)[: len(self)][index]
        rows = rows.contiguous()  # a slice with a step is not
        flat = rows.reshape(-1)
        found = self._gather(flat, list(self._columns)) if plain else self._read(flat, self.keys())
        if rows.dim() != 1:
            found = {key: leaf.reshape(rows.shape + leaf.shape[1:]) for key, leaf in found.items()}
        return TensorDict(found, rows.shape, device=self._batch_device)

    def contains(self, item: Any) -> Any:
        """Whether an index, or each of a tensor of indices, is one of a row."""
        return (item >= -len(self)) & (item < len(self))

    _refusal = "this storage is read-only: it shows datasets as they are on disk"

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise RuntimeError(self._refusal)

    _empty = set

    def state_dict(self) -> dict[str, Any]:
        """The number of rows; the rows themselves stay in their datasets."""
        return {"length": self.num_joined}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a state is of as many rows."""
        if type(length := state_dict.get("length")) is not int or length != self.num_joined:
            raise ValueError(f"state_dict must be of {self.num_joined} rows, got one of {short(length)}")

    def dumps(self, path: Any) -> None:
        write_json(Path(path) / "joined.json", self.state_dict())

    def loads(self, path: Any) -> None:
        self.load_state_dict(read_json(Path(path) / "joined.json", "path: the storage's state"))


class WholeStorage(JoinedStorage):
    """A :class:`JoinedStorage` of one tensordict, whose slices are views: a write to one changes later batches."""

    def get(self, index: Any) -> TensorDict:
        """The rows at an index, as for :class:`JoinedStorage`; of a slice, views."""
        if not isinstance(index, slice):
            return super().get(index)
        found = {key: leaf[index] for key, (leaf,) in self._columns.items()}
        return TensorDict(found, self._rows[index].shape, device=self._batch_device)


def device_of_rows(storage: Storage) -> torch.device:
    """The device of a storage's rows; the CPU for a storage that does not say."""
    said = getattr(storage, "device", None)
    return CPU if said in (None, "auto") else torch.device(said)


def to_device_of(storage: Storage, index: Tensor) -> Tensor:
    """``index``, drawn on the CPU, on the device of the rows, in a copy that does not block."""
    device = device_of_rows(storage)
    return index if device.type == "cpu" else index.to(device, non_blocking=True)


class DeviceStorage(JoinedStorage):
    """The rows of a :class:`JoinedStorage`, copied once to a device's memory; samplers draw on the CPU all the same.
    Source: ``torchrl.data.LazyTensorStorage(device=...)``, whose samplers need a generator of the device."""

    def __init__(self, storage: JoinedStorage, device: torch.device) -> None:
        rows: TensorDictBase = storage.get(slice(None))
        super().__init__([rows.to(device)])
        self._part = storage.part()
        self._rows = self._rows.to(device)
        self.device = device

    def part(self) -> Tensor:
        """The index of each row's part: (R,) int64, on the CPU."""
        return self._part

    def _rand_given_ndim(self, batch_size: int) -> Tensor:
        """Uniform rows, (B,) int64: the ones that are drawn on the CPU."""
        return to_device_of(self, torch.randint(0, len(self), (batch_size,), generator=self._rng))
