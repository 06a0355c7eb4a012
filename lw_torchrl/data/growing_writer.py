"""GrowingWriter: what a buffer is extended with goes to the part of its storage that grows."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.writers import Writer

from lw_torchrl.data.growing import GrowingStorage


class GrowingWriter(Writer):
    """Writes what a buffer is extended with to its :class:`GrowingStorage`."""

    _storage: GrowingStorage

    @property
    def _write_count(self) -> int:
        return self._storage.count

    def extend(self, data: TensorDictBase) -> Tensor:
        """Write the rows of a batch; their places, int64 of the batch's shape."""
        index = self._storage.extend(data)
        for entity in self._storage._attached_entities_iter():
            entity.mark_update(index.reshape(-1))
        return index

    def add(self, data: TensorDictBase) -> Tensor:
        """Write one step, of one row or of (N,) rows; their places, int64 of its shape."""
        return self.extend(data if data.ndim else data.unsqueeze(0)).view(data.shape)

    def _empty(self, empty_write_count: bool = True) -> None:
        pass

    def state_dict(self) -> dict[str, Any]:
        """Nothing; the storage knows how many rows were written."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Nothing to restore."""

    def dumps(self, path: Any) -> None:
        """Nothing to write."""

    def loads(self, path: Any) -> None:
        """Nothing to read."""
