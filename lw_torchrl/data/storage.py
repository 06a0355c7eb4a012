"""DatasetStorage: the rows of datasets as a TorchRL storage, and names of the columns that other parts rely on."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from types import MappingProxyType
from typing import Any, Literal, NoReturn

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor
from torchrl.data import TensorStorage
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs import Compose, MultiStepTransform, Reward2GoTransform

from lw_torchrl._util.devices import CPU
from lw_torchrl.data.dataset import Demonstrations

RewardName = Literal["sparse", "dense", "cost", "dense_cost"]

_MOST = 10.0  # Meta-World's dense reward, which it gives at success


@dataclass(frozen=True)
class Reward:
    """A reward: ``(source + shift) * scale`` of "sparse" or "dense"; at a success ``at_success``, if not None."""

    source: Literal["sparse", "dense"]
    shift: float = 0.0
    scale: float = 1.0
    at_success: float | None = None

    def of(self, source: Tensor, success: Tensor) -> Tensor:
        """The reward, (R, 1) float32, of the source's and of success (R, 1) bool."""
        if (self.shift, self.scale, self.at_success) == (0.0, 1.0, None):
            return source  # as in the file
        reward = (source + self.shift) * self.scale
        return reward if self.at_success is None else torch.where(success, self.at_success, reward)


REWARDS: Mapping[RewardName, Reward] = MappingProxyType(
    {
        "sparse": Reward("sparse"),
        "dense": Reward("dense"),
        "cost": Reward("sparse", shift=-1.0, scale=0.01),
        "dense_cost": Reward("dense", shift=-_MOST, scale=0.01, at_success=0.0),
    }
)
"""By name: the success as 0 and 1; Meta-World's own, at most 10; a cost of 0.01 a step, none at success; (dense
reward - 10) / 100, a cost of at most about 0.1 a step, none at success. Costs need episodes that end at
success (``terminate_on_success``): then the best return is 0, and staying short of the goal earns nothing."""


TRAJECTORY, REWARD, DONE = ("collector", "traj_ids"), ("next", "reward"), ("next", "done")
STEPS = "steps_to_next_obs"  # TorchRL's name of the column with the steps from an observation to its "next"
DEMONSTRATION = "is_demonstration"  # true in the rows of a dataset
DATASET = "dataset"  # the number of a row's folder, if several folders are joined


def column_name(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(key)


def device_of_rows(storage: Storage) -> torch.device:
    """Return the device of a storage's rows; the CPU for a storage that names none."""
    device = getattr(storage, "device", None)
    return CPU if device in (None, "auto") else torch.device(device)


def to_device_of(storage: Storage, index: Tensor) -> Tensor:
    """Copy ``index``, drawn on the CPU, to the device of the rows, without blocking."""
    device = device_of_rows(storage)
    return index if device.type == "cpu" else index.to(device, non_blocking=True)


class DatasetStorage(TensorStorage):
    """A :class:`torchrl.data.TensorStorage` of the rows of datasets, which it neither changes nor saves.

    Uniform samplers draw on the CPU, so the minibatches are the same on every device.

    Args:
        rows: of :func:`load_demonstrations`, (R,).
        fingerprint: identifies the rows; the storage's whole state.
    """

    def __init__(self, rows: TensorDict, fingerprint: str) -> None:
        super().__init__(rows, device=rows.device or CPU)
        self.fingerprint = fingerprint

    def _rand_given_ndim(self, batch_size: int) -> Tensor:
        return to_device_of(self, torch.randint(0, len(self), (batch_size,), generator=self._rng))

    def get(self, index: Any) -> TensorDict:
        """The rows at an index: views for a slice, in a TensorDict of their own; copies for anything else."""
        rows: TensorDict = super().get(index)
        return rows if isinstance(index, Tensor) and index.dim() else rows.clone(recurse=not isinstance(index, slice))

    def add_column(self, name: str, values: Tensor) -> None:
        """Give each row a value, (R, ...)."""
        self._storage.set(name, values)

    def set(self, *args: Any, **kwargs: Any) -> NoReturn:
        raise RuntimeError("a dataset's rows are read-only; change the samples, or use add_column")

    _empty = set

    def state_dict(self) -> dict[str, Any]:
        return {"rows": self.fingerprint}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Check that a state belongs to these rows."""
        if state_dict.get("rows") != self.fingerprint:
            raise ValueError("state_dict must be of the rows that this buffer shows, got one of other rows")


def rows_fingerprint(parts: Sequence[Demonstrations], *cuts: Any) -> str:
    """A digest of the rows of these episodes, cut short as ``cuts`` say."""
    listed = [[[e.task, e.episode, e.start, e.length, e.checksum] for e in part.episodes] for part in parts]
    return sha256(json.dumps([listed, *cuts]).encode()).hexdigest()


def check_transform(transform: Any) -> None:
    """Raise for TorchRL's transforms that act only on written rows: they would do nothing to samples."""
    if isinstance(transform, Compose):
        for part in transform:
            check_transform(part)
    elif isinstance(transform, (MultiStepTransform, Reward2GoTransform)):
        instead = "compute it once with add_column"
        if isinstance(transform, MultiStepTransform):
            instead = f"use n_steps={transform.n_steps}, gamma={transform.gamma}"
        raise ValueError(f"transform: {type(transform).__name__} does nothing to samples; {instead}")
