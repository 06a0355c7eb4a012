"""Sample minibatches from a buffer, validate the buffer before training, and describe it in checkpoints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import product
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer, TensorStorage
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler
from torchrl.data.replay_buffers.storages import Storage
from torchrl.envs import Compose, Transform
from torchrl.objectives import BCLoss, LossModule

from lw_torchrl._util.devices import CPU, seeded
from lw_torchrl.data.replay import DatasetStorage
from lw_torchrl.data.samplers import GroupSampler, device_of_rows
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.modules.relative_features import FocusFeatures, RoleFeatures
from lw_torchrl.transforms.augmentation import JitterTarget
from lw_torchrl.transforms.random_yaw import RandomYaw

_REPLAY_OPTIONS = ("label", "reward", "terminate_on_success", "n_steps", "gamma", "columns")


class Minibatches:
    """A source of minibatches drawn from a replay buffer, or from an object with methods ``draw(size)`` and ``rows``.

    The random numbers of sampler, transforms and networks depend only on the seed and the index of the minibatch.
    Samplers draw on the CPU, so minibatches are the same on every device. If the rows are on a GPU, only their indices
    are drawn on the CPU; a CUDA graph can then gather and transform the rows.
    """

    def __init__(self, source: Any, size: int, seed: int, device: torch.device = CPU) -> None:
        self.source, self.size, self.seed, self.step = source, size, seed, 0
        # The source if `draw` draws only indices from it, otherwise None.
        self.indexed: Any = source if hasattr(source, "draw") else IndexedReplay.of(source, device)
        if hasattr(source, "set_rng"):
            source.set_rng(torch.default_generator)  # the generator that `drawing` seeds

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Seed PyTorch's generators within a ``with`` block in which one minibatch is drawn and trained on."""
        # The large factor prevents training runs with adjacent seeds from using the same random numbers.
        with seeded(device, (self.seed * 1_000_003 + self.step) % 2**63):
            self.step += 1
            yield

    def draw(self) -> Any:
        """Draw a minibatch. If the rows are on a GPU, draw only their indices, on the CPU."""
        return self.source.sample(self.size) if self.indexed is None else self.indexed.draw(self.size)

    def rows(self, drawn: Any) -> Any:
        """Return the minibatch for ``drawn``, the result of :meth:`draw` after a move to the device."""
        return drawn if self.indexed is None else self.indexed.rows(drawn)

    def state_dict(self) -> dict[str, Any]:
        sampler = getattr(self.source, "sampler", None)
        return {"step": self.step, "sampler": {} if sampler is None else dict(sampler.state_dict())}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.step = state["step"]
        if state["sampler"]:
            self.source.sampler.load_state_dict(state["sampler"])


class IndexedReplay:
    """A wrapper that draws indices on the CPU, and then gathers the rows of a replay buffer on a GPU."""

    def __init__(self, replay: TensorDictReplayBuffer) -> None:
        self.replay, self._given = replay, _GivenRows()

    @classmethod
    def of(cls, source: Any, device: torch.device) -> IndexedReplay | None:
        """Wrap a replay buffer; return None unless its rows are on this GPU and its sampler can draw on the CPU."""
        if device == CPU or not isinstance(source.storage, TensorStorage):
            return None
        is_here = device_of_rows(source.storage) == device and source.storage.ndim == 1
        return cls(source) if is_here and _draws_on_cpu(source) else None

    def draw(self, size: int) -> TensorDict:
        """Draw ``index`` and the other values that the sampler returns, (B,) each, on the CPU."""
        sampler, storage = self.replay.sampler, self.replay.storage
        index, more = sampler.draw(storage, size) if isinstance(sampler, GroupSampler) else (storage.draw(size), {})
        return TensorDict({"index": index, **more}, [size])

    def stored(self, drawn: TensorDictBase) -> TensorDictBase:
        """Return the rows at the indices, without the buffer's transforms."""
        return self.replay.storage.get(drawn.get("index")).update(drawn)

    def rows(self, drawn: TensorDictBase) -> TensorDictBase:
        """Return the rows at the indices, with the buffer's transforms applied."""
        sampler, self._given.rows = self.replay.sampler, drawn
        self.replay._sampler = self._given
        try:
            return self.replay.sample(len(drawn))
        finally:
            self.replay._sampler = sampler


def _draws_on_cpu(replay: TensorDictReplayBuffer) -> bool:
    """Return whether a buffer's sampler can draw indices on the CPU for rows on a GPU."""
    is_random = isinstance(replay.storage, DatasetStorage) and type(replay.sampler) is RandomSampler
    return is_random or isinstance(replay.sampler, GroupSampler)


class _GivenRows(RandomSampler):
    """A sampler that returns given indices."""

    rows: TensorDictBase

    def sample(self, storage: Storage, batch_size: int) -> tuple[Tensor, dict[str, Any]]:
        more = {key: value for key, value in self.rows.items() if key != "index"}
        return self.rows.get("index"), more


def check_minibatches(networks: Iterable[Any], replay: TensorDictReplayBuffer, size: int) -> None:
    """Raise :class:`ValueError` unless a buffer's minibatches fit the networks and training on them can be resumed."""
    for network, answered in product(networks, map(plans_of, replay.transform)):
        own = plans_of(network)
        if own is not None and answered is not None and (different := answered.differences(own)):
            problem = f"QAFTransform must use {type(network).__name__}'s plans; they differ in {', '.join(different)}"
            raise ValueError(f"replay: {problem}")
    if replay._prefetch:
        raise ValueError("replay must not prefetch: prefetched batches would be lost when training resumes")
    if replay.batch_size not in (None, size):
        raise ValueError(f"replay's batch_size must be None or config.batch_size = {size}, got {replay.batch_size}")
    if isinstance(replay.sampler, PrioritizedSampler):
        raise ValueError("replay must not use a PrioritizedSampler, because the trainers do not update priorities")
    if not _draws_on_cpu(replay) and device_of_rows(replay.storage) != CPU:
        raise ValueError(f"replay: {type(replay.sampler).__name__} cannot resume on a GPU; use a TaskBalancedSampler")


def check_augmentations(loss: LossModule, networks: Iterable[nn.Module], replay: TensorDictReplayBuffer) -> None:
    """Raise :class:`ValueError` if a loss would hide an augmentation's angle or offset from the features: TorchRL's
    losses, except BCLoss, pass on only a network's ``in_keys``, which do not include the angle and the offset."""
    kinds = (base for base in type(loss).__mro__ if base not in (LossModule, BCLoss))
    if isinstance(loss, BCLoss) or not any(base.__module__.startswith("torchrl.objectives") for base in kinds):
        return
    used = [type(part).__name__ for part in replay.transform.modules() if isinstance(part, (RandomYaw, JitterTarget))]
    parts = (part for network in networks for part in network.modules())
    features = [type(part).__name__ for part in parts if isinstance(part, (FocusFeatures, RoleFeatures))]
    if used and features:
        cause = f"cannot read the key that {used[0]} writes, because {type(loss).__name__} passes on only in_keys"
        raise ValueError(f"replay: {features[0]} {cause}; leave out {used[0]}, or use other features or another loss")


def describe_data(replay: Any) -> dict[str, Any] | None:
    """Return a JSON description of a replay buffer's demonstrations, or None if there are none."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def describe_replay(replay: Any) -> dict[str, Any]:
    """Return a JSON description of a replay buffer's options, sampler and transforms."""
    options = {name: getattr(replay, name) for name in _REPLAY_OPTIONS if hasattr(replay, name)}
    return options | {
        "rows": None if describe_data(replay) is None else len(replay),  # depends on after_success
        "sampler": type(replay.sampler).__name__,
        "transforms": [
            {"class": type(part).__name__} | {name: repr(value) for name, value in plain_options(part).items()}
            for part in replay.transform.modules()
            if isinstance(part, Transform) and not isinstance(part, Compose)
        ],
    }


def plain_options(module: nn.Module) -> dict[str, bool | int | float | str]:
    """Return the public boolean, numeric and string attributes of a transform or loss."""
    options = {name: value for name, value in vars(module).items() if name[0] != "_" and name != "training"}
    return {name: value for name, value in options.items() if isinstance(value, (bool, int, float, str))}
