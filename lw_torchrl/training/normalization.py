"""Fit the normalization statistics of features in policies, critics and losses to the rows of a replay buffer."""

from __future__ import annotations

import copy
from collections.abc import Iterator

import torch
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import LossModule

from lw_torchrl._util.checks import typed
from lw_torchrl.modules.features import Features
from lw_torchrl.modules.relative_features import RoleFeatures


@typed
def fit_normalization(target: nn.Module, replay: TensorDictReplayBuffer) -> None:
    """Fit all features in a module, or in the networks of a loss, to a buffer's rows with :meth:`Features.fit`.

    In a loss, the statistics are also copied to all copies of a network and to the target networks. Rows have equal
    weights, except with :class:`CoLearningSampler`, which puts half of the weight on the target task's few rows.

    Args:
        target: an actor, a critic, any module that contains :class:`~lw_torchrl.modules.Features`, or a loss.
        replay: a replay buffer whose rows hold the keys that the features read.

    Raises:
        ValueError: the module contains no features, the buffer is empty, a row lacks a key, or a value is not finite.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl.objectives import TD3Loss
        >>> from lw_torchrl.training import fit_normalization
        >>> replay = TensorDictReplayBuffer(storage=LazyTensorStorage(64), batch_size=8)
        >>> _ = replay.extend(TensorDict(observation=torch.rand(64, 39)).auto_batch_size_(1))
        >>> plans = lw.load_plans("MT10")
        >>> loss = TD3Loss(lw.PlanConditionedActor(plans), lw.PlanConditionedQValue(plans), bounds=(-1.0, 1.0))
        >>> fit_normalization(loss, replay)
        >>> loss.qvalue_network_params["trunk", "module", "features", "mean"].shape  # of two critics
        torch.Size([2, 56])

    Source: ``torchrl.envs.ObservationNorm``.
    """
    features = _features_of(target)
    if not features:
        raise ValueError(f"target must contain Features to normalize, got a {type(target).__name__} without Features")
    if not len(replay):
        raise ValueError("replay must hold rows to fit the features to, but it is empty")
    row_weights = getattr(replay.sampler, "row_weights", None)
    weights = None if row_weights is None else row_weights(replay.storage)
    keys = {key for _, part in features for key in part.in_keys}
    stored = replay.storage.get(slice(0, len(replay)))
    if isinstance(stored, list):  # a ListStorage returns a list
        stored = torch.stack([row.select(*keys, strict=False) for row in stored])
    rows = stored.select(*keys, strict=False).cpu()  # the statistics are then bit-identical on every device
    held = statistics_of(target) if isinstance(target, LossModule) else {}
    for path, part in features:
        # Fit a copy of the features, because a loss stores the buffers of its networks outside the networks.
        fitted = copy.deepcopy(part).cpu() if held else part
        fitted.fit(rows, weights)
        for name, value in fitted.state_dict().items() if held else ():
            for copied in _copies(f"{path}.{name}"):
                if copied in held:
                    held[copied].copy_(value)
    share_contacts(target)


def share_contacts(module: nn.Module) -> None:
    """Call :meth:`RoleFeatures.share` for the role features in a module or loss, after their buffers were changed.

    If a loss holds several copies of a critic, the copies have separate buffers, so there is nothing to share.
    """
    changed = {buffer.data_ptr() for buffer in statistics_of(module).values()}
    for _, part in _features_of(module):
        if isinstance(part, RoleFeatures) and part.contact.data_ptr() in changed:
            part.share()


def statistics_of(module: nn.Module) -> dict[str, Tensor]:
    """Return the buffers that :func:`fit_normalization` fits, by name; for a loss, this includes the buffers of its
    target networks and of other copies of its networks.
    """
    names = [f"{path}.{name}".lstrip(".") for path, part in _features_of(module) for name in part.state_dict()]
    buffers = dict(module.named_buffers())
    if isinstance(module, LossModule):
        names = [copied for name in names for copied in _copies(name)]
    return {name: buffers[name].data for name in names if name in buffers}


def _features_of(module: nn.Module) -> list[tuple[str, Features]]:
    """Return the features in a module, or in the networks of a loss, with their paths."""
    networks: Iterator[tuple[str, nn.Module]] = iter([("", module)])
    if isinstance(module, LossModule):  # the networks of a loss are attributes, but not registered as children
        networks = ((name, value) for name, value in vars(module).items() if isinstance(value, nn.Module))
    parts = (named for name, network in networks for named in network.named_modules(prefix=name))
    return [(path, part) for path, part in parts if isinstance(part, Features)]


def _copies(name: str) -> list[str]:
    """Return the names under which a loss stores a network's buffer, such as ``actor_network.features.mean``."""
    network, _, path = name.partition(".")
    return [f"{network}_params.{path}", f"target_{network}_params.{path}"]


def check_contacts(module: nn.Module) -> None:
    """Raise :class:`ValueError` if role features were not yet fitted to the points where objects are touched."""
    if any(name.endswith("fitted") and not fitted.all() for name, fitted in statistics_of(module).items()):
        advice = "use normalize=True, or call lw.training.fit_normalization(actor, replay)"
        raise ValueError(f"RoleFeatures needs contact points from demonstrations; {advice}")


def fit_untrained(loss: LossModule, replay: TensorDictReplayBuffer) -> None:
    """Call :func:`fit_normalization`; raise ValueError if a network was already fitted to different statistics."""
    held = statistics_of(loss)
    before = {name: buffer.clone() for name, buffer in held.items()}
    fit_normalization(loss, replay)
    for name, old in before.items():
        is_fresh = bool((old == 1).all()) if name.endswith(".std") else not old.any()
        if not is_fresh and not torch.allclose(held[name].double(), old.double()):
            for restored, value in before.items():
                held[restored].copy_(value)
            share_contacts(loss)
            advice = "use normalize=False, and call fit_normalization(network, replay) for untrained networks"
            raise ValueError(f"normalize=True would replace the statistics of a trained network; {advice}")
