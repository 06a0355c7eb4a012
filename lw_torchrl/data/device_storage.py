"""DeviceStorage: rows copied once to a GPU's memory, so that a batch is read there and nobody waits."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data.replay_buffers.storages import Storage

from lw_torchrl._devices import CPU
from lw_torchrl.data.storage import JoinedStorage


def device_of_rows(storage: Storage) -> torch.device:
    """Where a storage's rows are; the CPU for one that does not say."""
    said = getattr(storage, "device", None)
    return CPU if said in (None, "auto") else torch.device(said)


def beside(storage: Storage, index: Tensor) -> Tensor:
    """``index``, drawn on the CPU, where the rows are: a copy that nobody waits for."""
    device = device_of_rows(storage)
    return index if device.type == "cpu" else index.to(device, non_blocking=True)


class DeviceStorage(JoinedStorage):
    """The rows of a :class:`JoinedStorage`, in a device's memory.

    Samplers draw on the CPU, with the buffer's generator, so that minibatches are the same on every device; their
    indices go over in one copy that nobody waits for.

    Args:
        storage: the rows, which are all copied.
        device: where to.

    Attributes:
        device: where the rows are.

    Source: ``torchrl.data.LazyTensorStorage(device=...)``, whose samplers want a generator of the device.
    """

    def __init__(self, storage: JoinedStorage, device: torch.device) -> None:
        rows: TensorDictBase = storage.get(slice(None))
        super().__init__([rows.to(device)])
        self._part = storage.part()
        self._rows = self._rows.to(device)
        self.device = device

    def part(self) -> Tensor:
        """The number of the part that each row is from: (R,) int64, from 0, on the CPU."""
        return self._part

    def _rand_given_ndim(self, batch_size: int) -> Tensor:
        """Uniform rows, (B,) int64: the ones that are drawn on the CPU."""
        return beside(self, torch.randint(0, len(self), (batch_size,), generator=self._rng))
