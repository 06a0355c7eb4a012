"""The minibatches of a training: what their buffer must be, and how one is drawn."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import RandomSampler

from lw_torchrl._devices import CPU
from lw_torchrl.data.device_storage import DeviceStorage, device_of_rows
from lw_torchrl.data.group_sampler import GroupSampler
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.trainers.config import BehavioralCloningConfig


def check_belongs(actor: Any, replay: TensorDictReplayBuffer) -> None:
    """Raise :class:`ValueError` unless the actor writes ``action``, and the buffer answers the queries of its plans."""
    if "action" not in actor.out_keys:
        raise ValueError(f"actor must write 'action', it writes {', '.join(map(str, actor.out_keys))}")
    if (own := plans_of(actor)) is None:
        return
    for transform in replay.transform:
        answered = plans_of(transform)
        if answered is not None and (different := answered.differences(own)):
            raise ValueError(
                f"replay's QAFTransform must have the actor's plans, they differ for {', '.join(different)}; use "
                "actor.transform()"
            )


def _check_batch_size(replay: TensorDictReplayBuffer, config: BehavioralCloningConfig) -> None:
    """Raise :class:`ValueError` if the buffer was made for minibatches of another size."""
    if replay._batch_size not in (None, config.batch_size):
        raise ValueError(
            f"batch_size of the replay buffer must be None or the configuration's, {config.batch_size}, got "
            f"{replay._batch_size}"
        )


def _check_draws(replay: TensorDictReplayBuffer) -> None:
    """Raise :class:`ValueError` if the sampler would draw on a device, where the trainers' generators are not."""
    rows, sampler = replay.storage, replay.sampler
    ours = isinstance(sampler, GroupSampler) or (isinstance(rows, DeviceStorage) and type(sampler) is RandomSampler)
    if not ours and (device := device_of_rows(rows)).type != "cpu":
        raise ValueError(
            f"replay: a {type(sampler).__name__} draws on {device}, where its rows are, with a generator of its own; "
            "take a TaskBalancedSampler or a CoLearningSampler, or leave the rows on the CPU: minibatches then go over"
        )


def draw_batch(replay: TensorDictReplayBuffer, size: int, device: torch.device) -> TensorDictBase:
    """A minibatch on the device; of a buffer whose rows are elsewhere, it goes over."""
    batch = replay.sample(size)
    return batch if device == CPU else batch.to(device, non_blocking=True)


def check_replay(actor: Any, replay: TensorDictReplayBuffer, config: BehavioralCloningConfig) -> None:
    """Raise :class:`ValueError` unless an actor can be trained on a buffer's minibatches, and training be resumed."""
    check_belongs(actor, replay)
    if replay._prefetch:
        raise ValueError("replay must not prefetch: batches drawn ahead would be lost when training is resumed")
    _check_batch_size(replay, config)
    _check_draws(replay)
