"""Normalisation of what policies, critics and whole losses see, from the rows of a replay buffer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.objectives import LossModule

from lw_torchrl._checks import checked
from lw_torchrl.language.layout import Layout
from lw_torchrl.modules.features import Features, ObservationFeatures
from lw_torchrl.modules.relative_features import RoleFeatures


@checked
def fit_normalization(target: nn.Module, replay: TensorDictReplayBuffer) -> None:
    """Give a policy, a critic, or all that a loss holds, copies and targets too, the statistics of a buffer's rows.

    Each row counts as often as :class:`CoLearningSampler` draws it: a target's few rows would not count otherwise.

    Args:
        target: an actor, a critic, any module with :class:`Features` in it, or a loss of such.
        replay: rows of ``observation`` (D,) float32.

    Raises:
        ValueError: there is nothing in it to normalise, or a row holds NaN or infinity, or no ``observation``; a loss
            has an actor with ``roles`` that has taken no contacts yet, by this function.

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
    weigh = getattr(replay.sampler, "row_weights", None)
    weights = None if weigh is None else weigh(replay.storage)
    rows = replay.storage.get(slice(0, len(replay)))
    if rows.get("observation", None) is None:
        raise ValueError(f"replay must hold 'observation', its rows hold {', '.join(map(str, rows.keys(True, True)))}")
    if not isinstance(target, LossModule):
        features = [part for part in target.modules() if isinstance(part, Features)]
        if not features:
            raise ValueError(f"{type(target).__name__} holds no Features: there is nothing to normalise")
        for part in features:
            part.fit(rows.cpu(), weights)
        return
    check_contacts(target)
    known: dict[tuple[str, Layout], ObservationFeatures] = {}
    for features, of in _held(target, ObservationFeatures):
        kind = features.kind, features.layout
        if kind not in known:
            known[kind] = ObservationFeatures(features.kind, layout=features.layout)
            known[kind].fit(rows.cpu(), weights)
        with torch.no_grad():
            of("mean").copy_(known[kind].mean)
            of("std").copy_(known[kind].std)
    if not known:
        raise ValueError(f"{type(target).__name__} holds no ObservationFeatures: there is nothing to normalise")


def check_contacts(actor: nn.Module) -> None:
    """Raise :class:`ValueError` if an actor with ``roles`` would be trained without contacts."""
    if any(not of("fitted") for _, of in _held(actor, RoleFeatures)):
        raise ValueError(
            "roles want to know where the demonstrations touch things; call fit_normalization(actor, replay) of "
            "lw_torchrl.training, as normalize=True does; with roles: do so before the loss is made of the actor"
        )


def fit_untrained(loss: LossModule, replay: TensorDictReplayBuffer) -> None:
    """As :func:`fit_normalization`; :class:`ValueError` if a network was trained with other statistics."""
    held = [(of("mean"), of("std")) for _, of in _held(loss, ObservationFeatures)]
    before = [(mean, mean.clone(), std, std.clone()) for mean, std in held]
    fit_normalization(loss, replay)
    for mean, old_mean, std, old_std in before:
        untrained = not old_mean.any() and bool((old_std == 1).all())
        if not untrained and not (torch.allclose(mean, old_mean) and torch.allclose(std, old_std)):
            for row in before:
                row[0].copy_(row[1])
                row[2].copy_(row[3])
            raise ValueError(
                "normalize: a network of the loss has the statistics of other rows, with which it was trained: give "
                "normalize=False to keep them, and fresh networks theirs by fit_normalization(network, replay)"
            )


def _held(target: nn.Module, kind: type[nn.Module]) -> Iterator[tuple[Any, Callable[[str], Tensor]]]:
    """Each module of a kind, and what gives a buffer of it by name; of a loss, those of every copy."""
    if not isinstance(target, LossModule):
        for module in target.modules():
            if isinstance(module, kind):
                yield module, module.get_buffer
        return
    held = dict(target.named_children())  # asked for by name, targets warn where nothing moves them yet
    for name, network in vars(target).items():  # a loss keeps its networks there, without their parameters
        if not isinstance(network, nn.Module):
            continue
        for path, module in network.named_modules():
            if isinstance(module, kind):
                for copy in (f"{name}_params", f"target_{name}_params"):
                    params: Any = held.get(copy)
                    if isinstance(params, TensorDictBase):
                        yield module, params.get(tuple(path.split("."))).data.get
