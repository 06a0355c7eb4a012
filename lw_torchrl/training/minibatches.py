"""Minibatches of a buffer, checks of the buffer before training, and its description in checkpoints."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.data.replay_buffers.samplers import PrioritizedSampler, RandomSampler
from torchrl.envs import Compose, Transform
from torchrl.objectives import BCLoss, LossModule

from lw_torchrl._util.devices import CPU, seeded
from lw_torchrl.data.replay import DatasetStorage
from lw_torchrl.data.samplers import GroupSampler, device_of_rows
from lw_torchrl.modules.critics import Value
from lw_torchrl.modules.policy import plans_of
from lw_torchrl.modules.relative_features import FocusFeatures, RoleFeatures
from lw_torchrl.transforms.augmentation import JitterTarget
from lw_torchrl.transforms.random_yaw import RandomYaw

_REPLAY_OPTIONS = ("label", "reward", "terminate_on_success", "n_steps", "gamma", "columns")


class Minibatches:
    """Minibatches of a buffer, or of any object with ``sample(size)``.

    The random numbers of sampler, transforms and networks depend only on the seed and the step. Samplers draw on the
    CPU, so minibatches are the same on every device.
    """

    def __init__(self, source: Any, size: int, seed: int) -> None:
        self.source, self.size, self.seed, self.step = source, size, seed, 0
        if hasattr(source, "set_rng"):
            source.set_rng(torch.default_generator)  # which `drawing` seeds

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Seed PyTorch's generators for a step within the block, and count the step."""
        # A large prime keeps the seeds of trainings with neighbouring seeds apart.
        with seeded(device, (self.seed * 1_000_003 + self.step) % 2**63):
            self.step += 1
            yield

    def draw(self, device: torch.device) -> Any:
        """Return a minibatch on the device; the CPU does not wait for the copy."""
        batch = self.source.sample(self.size)
        return batch if device == CPU else batch.to(device, non_blocking=True)

    def state_dict(self) -> dict[str, Any]:
        sampler = getattr(self.source, "sampler", None)
        return {"step": self.step, "sampler": {} if sampler is None else dict(sampler.state_dict())}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.step = state["step"]
        if state["sampler"]:
            self.source.sampler.load_state_dict(state["sampler"])


def check_minibatches(networks: Iterable[Any], replay: TensorDictReplayBuffer, size: int) -> None:
    """Raise :class:`ValueError` unless a buffer's minibatches suit the networks, and training can resume."""
    for network in networks:
        own = plans_of(network)
        for answered in map(plans_of, replay.transform):
            if own is not None and answered is not None and (different := answered.differences(own)):
                name = "critic" if isinstance(network, Value) else "actor"
                plans = f"the {name}'s plans, they differ for {', '.join(different)}"
                raise ValueError(f"replay's QAFTransform must have {plans}; use QAFTransform({name}.plans)")
    if replay._prefetch:
        raise ValueError("replay must not prefetch: batches drawn ahead would be lost when training is resumed")
    if replay.batch_size not in (None, size):
        raise ValueError(f"replay's batch_size must be None or the config's, {size}, got {replay.batch_size}")
    rows, sampler = replay.storage, replay.sampler
    if isinstance(sampler, PrioritizedSampler):
        raise ValueError("replay must not have a PrioritizedSampler, because the trainers update no priorities")
    on_cpu = isinstance(sampler, GroupSampler) or (isinstance(rows, DatasetStorage) and type(sampler) is RandomSampler)
    if not on_cpu and (device := device_of_rows(rows)).type != "cpu":
        raise ValueError(
            f"replay: a {type(sampler).__name__} draws on {device} with its own generator, which is not saved; use a "
            "TaskBalancedSampler or CoLearningSampler, or keep the rows on the CPU"
        )


def check_replay(actor: Any, replay: TensorDictReplayBuffer, size: int) -> None:
    """Call :func:`check_minibatches` for a network that must write ``action``."""
    if "action" not in actor.out_keys:
        raise ValueError(f"actor must write 'action', it writes {', '.join(map(str, actor.out_keys))}")
    check_minibatches([actor], replay, size)


def check_augmentations(loss: LossModule, networks: Iterable[nn.Module], replay: TensorDictReplayBuffer) -> None:
    """Raise :class:`ValueError` if features would not see how an augmentation moved a row.

    TorchRL's losses, except BCLoss, pass on only the ``in_keys`` of a network. The augmentations' angle and offset are
    not among them, because environments do not write them.
    """
    kinds = (base for base in type(loss).__mro__ if base not in (LossModule, BCLoss))
    if isinstance(loss, BCLoss) or not any(base.__module__.startswith("torchrl.objectives") for base in kinds):
        return
    used = [type(part).__name__ for part in replay.transform.modules() if isinstance(part, (RandomYaw, JitterTarget))]
    parts = (part for network in networks for part in network.modules())
    features = [type(part).__name__ for part in parts if isinstance(part, (FocusFeatures, RoleFeatures))]
    if used and features:
        raise ValueError(
            f"replay: {features[0]} would not see what {used[0]} writes, because {type(loss).__name__} passes on only "
            f"the in_keys of a network; leave out {used[0]}, use other features, or train with BCLoss, "
            "AdvantageWeightedLoss or ExpectileValueLoss"
        )


def describe_data(replay: Any) -> dict[str, Any] | None:
    """Describe a replay buffer's demonstrations as JSON; None for a buffer without demonstrations."""
    demonstrations = getattr(replay, "demonstrations", None)
    return None if demonstrations is None else demonstrations.config.to_json()


def describe_replay(replay: Any) -> dict[str, Any]:
    """Describe how a replay buffer makes its batches, as JSON."""
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
    """Return the attributes of a transform or a loss that are booleans, numbers or strings."""
    options = {name: value for name, value in vars(module).items() if name[0] != "_" and name != "training"}
    return {name: value for name, value in options.items() if isinstance(value, (bool, int, float, str))}
