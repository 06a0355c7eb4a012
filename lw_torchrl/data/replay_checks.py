"""Checks of a replay buffer of demonstrations, and of any buffer that a policy is trained on."""

from collections.abc import Iterable, Sequence
from typing import Any

from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler
from torchrl.envs import Compose, MultiStepTransform, Reward2GoTransform

from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.data.samplers import GroupSampler
from lw_torchrl.data.storage import DatasetStorage, device_of_rows
from lw_torchrl.modules.critics import Value
from lw_torchrl.modules.policy import plans_of


def check_transform(transform: Any) -> None:
    """Raise for TorchRL's transforms that act only on written rows, since they would do nothing to samples."""
    if isinstance(transform, Compose):
        for part in transform:
            check_transform(part)
    elif isinstance(transform, (MultiStepTransform, Reward2GoTransform)):
        instead = "compute it once with add_column"
        if isinstance(transform, MultiStepTransform):
            instead = f"use n_steps={transform.n_steps}, gamma={transform.gamma}"
        raise ValueError(f"transform: {type(transform).__name__} does nothing to samples; {instead}")


def check_label(label: str, parts: Sequence[Demonstrations]) -> None:
    """Raise if the label needs an expert's actions, and another policy acted."""
    others = sorted({part.config.behaviour for part in parts if part.config.policy.kind != "expert"})
    if others and label != "executed":
        needs = f"label={label!r} needs an expert's actions, but this dataset was collected by {', '.join(others)!r}"
        raise ValueError(f"{needs}; use label='executed'")


def check_behaviours(parts: Sequence[Demonstrations]) -> None:
    """Raise :class:`ValueError` if two behaviours have the same label."""
    first: dict[str, Demonstrations] = {}
    for part in parts:
        before = first.setdefault(part.config.behaviour, part)
        if before.config.policy.acts != part.config.policy.acts:
            folders = f"{str(before.root)!r} and {str(part.root)!r}"
            raise ValueError(f"root: {part.config.behaviour!r} names different behaviours in {folders}")


def check_minibatches(networks: Iterable[Any], replay: TensorDictReplayBuffer, size: int) -> None:
    """Raise :class:`ValueError` unless networks can be trained on a buffer's minibatches, and training be resumed."""
    for network in networks:
        own = plans_of(network)
        for answered in map(plans_of, replay.transform):
            if own is not None and answered is not None and (different := answered.differences(own)):
                name = "critic" if isinstance(network, Value) else "actor"
                plans = f"the {name}'s plans, they differ for {', '.join(different)}"
                raise ValueError(f"replay's QAFTransform must have {plans}; use {name}.transform()")
    if replay._prefetch:
        raise ValueError("replay must not prefetch: batches drawn ahead would be lost when training is resumed")
    if replay.batch_size not in (None, size):
        wanted = f"None or the configuration's, {size}, got {replay.batch_size}"
        raise ValueError(f"batch_size of the replay buffer must be {wanted}")
    rows, sampler = replay.storage, replay.sampler
    if isinstance(sampler, PrioritizedSampler):
        raise ValueError("replay: the trainers update no priorities, so a PrioritizedSampler draws uniformly")
    on_cpu = isinstance(sampler, GroupSampler) or (isinstance(rows, DatasetStorage) and type(sampler) is RandomSampler)
    if not on_cpu and (device := device_of_rows(rows)).type != "cpu":
        sampled = f"replay: a {type(sampler).__name__} draws on {device} with its own generator, which is not saved"
        raise ValueError(f"{sampled}; use a TaskBalancedSampler or CoLearningSampler, or keep the rows on the CPU")


def check_replay(actor: Any, replay: TensorDictReplayBuffer, size: int) -> None:
    """As :func:`check_minibatches`, for a network that writes ``action``."""
    if "action" not in actor.out_keys:
        raise ValueError(f"actor must write 'action', it writes {', '.join(map(str, actor.out_keys))}")
    check_minibatches([actor], replay, size)
