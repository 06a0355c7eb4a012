"""What a buffer must be, so that a network can be trained on it and training be resumed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler

from lw_torchrl.data.samplers import GroupSampler
from lw_torchrl.data.storage import DeviceStorage, device_of_rows
from lw_torchrl.modules.critics import Value
from lw_torchrl.modules.policy import plans_of


def check_minibatches(networks: Iterable[Any], replay: TensorDictReplayBuffer, size: int) -> None:
    """Raise :class:`ValueError` unless networks can be trained on a buffer's minibatches, and training be resumed: the
    buffer answers the queries of their plans, and draws neither ahead, nor on a device, where the trainers' generators
    are not, nor by priorities, which no trainer changes."""
    for network in networks:
        own = plans_of(network)
        for answered in map(plans_of, replay.transform):
            if own is not None and answered is not None and (different := answered.differences(own)):
                name = "critic" if isinstance(network, Value) else "actor"
                raise ValueError(
                    f"replay's QAFTransform must have the {name}'s plans, they differ for {', '.join(different)}; use "
                    f"{name}.transform()"
                )
    if replay._prefetch:
        raise ValueError("replay must not prefetch: batches drawn ahead would be lost when training is resumed")
    if replay.batch_size not in (None, size):
        raise ValueError(
            f"batch_size of the replay buffer must be None or the configuration's, {size}, got {replay.batch_size}"
        )
    rows, sampler = replay.storage, replay.sampler
    if isinstance(sampler, PrioritizedSampler):
        raise ValueError("replay: nothing here gives rows new priorities, so a PrioritizedSampler draws them all alike")
    ours = isinstance(sampler, GroupSampler) or (isinstance(rows, DeviceStorage) and type(sampler) is RandomSampler)
    if not ours and (device := device_of_rows(rows)).type != "cpu":
        raise ValueError(
            f"replay: a {type(sampler).__name__} draws on {device}, where its rows are, with a generator of its own; "
            "take a TaskBalancedSampler or a CoLearningSampler, or leave the rows on the CPU: minibatches then go over"
        )


def check_replay(actor: Any, replay: TensorDictReplayBuffer, size: int) -> None:
    """As :func:`check_minibatches`, of what writes ``action``."""
    if "action" not in actor.out_keys:
        raise ValueError(f"actor must write 'action', it writes {', '.join(map(str, actor.out_keys))}")
    check_minibatches([actor], replay, size)
