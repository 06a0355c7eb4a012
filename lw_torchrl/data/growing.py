"""GrowingStorage: demonstrations on disk, followed by rows that are written during training."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from multiprocessing.context import get_spawning_popen
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.writers import Writer

from lw_torchrl._checks import check_int
from lw_torchrl._files import reading
from lw_torchrl._tensor_files import pop_state, read_tensors, write_tensors
from lw_torchrl.data import trajectories
from lw_torchrl.data.storage import DEMONSTRATION, DONE, REWARD, TRAJECTORY, JoinedStorage, column_name
from lw_torchrl.data.trajectories import NONE_OPEN, Columns, OpenTrajectories

ONE_PROCESS = "a growing buffer cannot be shared between processes: extend it with the batches that a collector yields"


class GrowingStorage(JoinedStorage):
    """A :class:`JoinedStorage` followed by a ring of rows that are written during training.

    The rows of the parts come first and stay; the i-th row ever written is at ``num_joined + i % grow``. A replay
    buffer over it needs a :class:`GrowingWriter` and ``collate_fn=lambda batch: batch``. Samples also have
    ``is_demonstration`` (B,) bool: true for the parts' rows, false for written ones.

    Batches may have any dimensions, the last of which is time. ``("collector", "traj_ids")`` gets new numbers, above
    those of the parts: a trajectory keeps its number from batch to batch as long as its newest row is in the ring, and
    no other trajectory ever gets it. A row follows another if both have the collector's id, the other is not done, and
    its "next" equals this row bit for bit; otherwise a trajectory begins.

    Args:
        parts, rows, n_steps, gamma: as for :class:`JoinedStorage`; ("collector", "traj_ids") and ("next", "done") are
            needed. A row looks fewer than n steps ahead until the rows that follow it are written.
        grow: number of rows of the ring.
        admit: called with the columns of each batch; returns the columns to store, or raises.

    Attributes:
        num_joined, count: number of rows of the parts, and of rows ever written.

    Raises:
        ValueError: as for :class:`JoinedStorage`; at writing, too many rows, or rows that do not fit the parts.

    Example:
        >>> from tensordict import TensorDict
        >>> from torchrl.data import TensorDictReplayBuffer
        >>> from lw_torchrl.data import GrowingWriter
        >>> def rows(number, trajectory):
        ...     time = torch.arange(number)
        ...     after = {"time": time + 1, "done": (time == number - 1)[:, None]}
        ...     ids = torch.full((number,), trajectory)
        ...     columns = {"time": time, "task_id": ids * 0, "collector": {"traj_ids": ids}, "next": after}
        ...     return TensorDict(columns, [number])
        >>> storage, writer = GrowingStorage([rows(6, 0)], grow=4), GrowingWriter()
        >>> replay = TensorDictReplayBuffer(storage=storage, writer=writer, collate_fn=lambda batch: batch)
        >>> for _ in range(2):
        ...     _ = replay.extend(rows(3, 0))
        >>> replay[:]["collector", "traj_ids"].tolist(), replay[6:]["time"].tolist()
        ([0, 0, 0, 0, 0, 0, 2, 2, 1, 2], [1, 2, 2, 0])

    Source: ``torchrl.data.OfflineToOnlineReplayBuffer``, which draws from two buffers.
    """

    def __init__(
        self,
        parts: Sequence[TensorDictBase],
        rows: Sequence[Tensor | None] | None = None,
        *,
        grow: int,
        admit: Callable[[Columns], Columns] | None = None,
        **steps: Any,
    ) -> None:
        self.grow, self.count = check_int("grow", grow, minimum=1), 0
        self._admit = admit
        super().__init__([part.exclude(DEMONSTRATION) for part in parts], rows, **steps)
        if absent := [column_name(key) for key in (TRAJECTORY, DONE) if key not in self._columns]:
            raise ValueError(f"grow={self.grow} needs the columns {', '.join(absent)}, which parts do not have")
        known = [int(leaf.max()) for leaf in self._columns[TRAJECTORY] if len(leaf)]
        self._number, self._open = max(known, default=-1) + 1, NONE_OPEN
        joined = int(self._ends[-1])
        self._ring: dict[NestedKey, Tensor] = {}
        for key, leaves in self._columns.items():
            self._ring[key] = torch.empty((self.grow, *leaves[0].shape[1:]), dtype=leaves[0].dtype)
            leaves.append(self._ring[key])
        self._ends = torch.cat([self._ends, torch.tensor([joined + self.grow])])
        self._rows = torch.cat([self._rows, torch.arange(joined, joined + self.grow)])
        self.num_parts += 1
        self.max_size = self.num_joined + self.grow
        self._places = torch.arange(self.max_size)
        if self.n_steps > 1:
            self._previous = torch.full((self.grow,), -1)
            self._last = torch.cat([self._last, more := torch.arange(self.num_joined, self.max_size)])
            self._earned = torch.cat([self._earned, self._earned.new_zeros(self.grow, 1)])
            self._ahead = torch.cat([self._ahead, torch.ones_like(more)])

    _refusal = "only a GrowingWriter writes rows of a storage that grows, at the end of its ring"

    @property
    def num_grown(self) -> int:
        return min(self.count, self.grow)

    def __len__(self) -> int:
        return self.num_joined + self.num_grown

    def keys(self) -> list[NestedKey]:
        return [*super().keys(), DEMONSTRATION]

    def _read(self, index: Tensor, keys: Sequence[NestedKey]) -> dict[NestedKey, Tensor]:
        found = super()._read(index, [key for key in keys if key != DEMONSTRATION])
        return {**found, DEMONSTRATION: index < self.num_joined} if DEMONSTRATION in keys else found

    def extend(self, batch: TensorDictBase) -> Tensor:
        """Write the rows of a batch; return their places, int64 of the batch's shape."""
        columns: Columns = trajectories.collected_rows(batch, self._ring)
        number = len(columns[DONE])
        if not 0 < number <= self.grow:
            raise ValueError(f"batch must have 1 to {self.grow} rows, as many as grow says, got {number}")
        if self._admit is not None:
            columns = self._admit(columns)
        written = self.count, self._number  # rows and trajectories
        previous, numbers, opened = trajectories.link_rows(columns, self._open, self._ring, *written)
        if (cut := len(numbers.unique()) - len(columns[TRAJECTORY].unique())) > number // 2:
            warnings.warn(
                f"batch: {cut} of {number} rows differ from ('next', ...) of the row before in their trajectory; each "
                "begins a trajectory. Were rows left out?",
                stacklevel=2,
            )
        columns = {**columns, TRAJECTORY: numbers.view(columns[TRAJECTORY].shape)}
        serial = torch.arange(self.count, self.count + number)
        self._write(serial, columns, previous)
        here = opened.last >= self.count - self.grow
        self._open = OpenTrajectories(*(part[here] for part in opened))
        self._number = max(self._number, int(numbers.max()) + 1)
        return (self.num_joined + serial % self.grow).view(batch.shape)

    def _write(self, serial: Tensor, found: Columns, previous: Tensor) -> None:
        slot = serial % self.grow
        for key, leaf in self._ring.items():
            leaf[slot] = found[key].to(leaf.device)
        self.count = int(serial[-1]) + 1
        if self.n_steps > 1:
            self._look_back(serial, found[REWARD], previous)
        self._set_last_cursor(self.num_joined + int(slot[-1]))
        self._bump_mutation_revision()

    def _look_back(self, serial: Tensor, reward: Tensor, previous: Tensor) -> None:
        """Extend the n steps of earlier rows to new ones."""
        slot = serial % self.grow
        place = self.num_joined + slot
        self._previous[slot] = previous
        self._last[place], self._earned[place], self._ahead[place] = place, reward, 1
        behind, oldest = previous, max(0, self.count - self.grow)
        for step in range(1, self.n_steps):
            here = behind >= oldest
            behind, reward, place = behind[here], reward[here], place[here]
            earlier = self.num_joined + behind % self.grow
            self._earned[earlier] += self.gamma**step * reward
            self._last[earlier], self._ahead[earlier] = place, step + 1
            behind = self._previous[behind % self.grow]

    def _empty(self) -> None:  # type: ignore[override]
        """Drop the rows of the ring; numbers of trajectories are not reused."""
        self.count, self._open = 0, NONE_OPEN
        self._set_last_cursor(None)
        self._bump_mutation_revision()

    def state_dict(self) -> dict[str, Any]:
        """The rows of the ring, the oldest first, and which of their trajectories may continue."""
        slot = torch.arange(self.count - self.num_grown, self.count) % self.grow
        return {
            **super().state_dict(),
            "grow": self.grow,
            "count": self.count,
            "number": self._number,
            "open": self._open._asdict(),
            "rows": {column_name(key): leaf[slot] for key, leaf in self._ring.items()},
        }

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a state; ValueError if it has other columns, another ``grow``, or other demonstrations."""
        super().load_state_dict(state_dict)
        count, number, rows, opened = trajectories.check_grown_state(state_dict, self._ring)
        self._empty()
        self.count, self._number, self._open = count, max(number, self._number), opened
        if not count:
            return
        serial = torch.arange(count - self.num_grown, count)
        trajectory = rows[TRAJECTORY].reshape(-1)
        order = trajectory.argsort(stable=True)
        going = (trajectory[order[1:]] == trajectory[order[:-1]]).nonzero().flatten()
        previous = torch.full_like(serial, -1)
        previous[order[going + 1]] = serial[order[going]]
        self._write(serial, rows, previous)

    def dumps(self, path: Any) -> None:
        write_tensors(Path(path) / "grown.safetensors", {}, {}, self.state_dict())

    def loads(self, path: Any) -> None:
        with reading(path, "growing storage's state"):
            self.load_state_dict(pop_state(*read_tensors(Path(path) / "grown.safetensors")))

    def __getstate__(self) -> dict[str, Any]:
        if get_spawning_popen() is not None:
            raise RuntimeError(ONE_PROCESS)
        return super().__getstate__()


class GrowingWriter(Writer):
    """Writes the rows that extend a buffer to its :class:`GrowingStorage`."""

    _storage: GrowingStorage

    @property
    def _write_count(self) -> int:
        return self._storage.count

    def extend(self, data: TensorDictBase) -> Tensor:
        """As :meth:`GrowingStorage.extend`."""
        index = self._storage.extend(data)
        for entity in self._storage._attached_entities_iter():
            entity.mark_update(index.reshape(-1))
        return index

    def add(self, data: TensorDictBase) -> Tensor:
        """Write one step, of one row or of (N,) rows; return their places, int64 of its shape."""
        return self.extend(data if data.ndim else data.unsqueeze(0)).view(data.shape)

    def _empty(self, empty_write_count: bool = True) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: Any) -> None:
        """Do nothing: the storage knows how many rows were written."""

    dumps = loads = load_state_dict
