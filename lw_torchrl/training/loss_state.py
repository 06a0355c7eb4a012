"""What a TorchRL loss learns from and goes on from: its tensors, its optimizer's groups, its targets."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs import MultiStepTransform
from torchrl.objectives import BCLoss, LossModule, SoftUpdate

from lw_torchrl._state_tree import check_like, join, split
from lw_torchrl._tensor_archive import TensorArchive, write_archive
from lw_torchrl._versions import warn_of_other_versions
from lw_torchrl.training.policy_checks import check_finite
from lw_torchrl.training.training_state import check_same_description

FORMAT = "lw_torchrl.training"
FORMAT_VERSION = 1

_INSTEAD = {"loss_actor_bc"}
"""What is to be minimised instead of another entry, for a while: CQL's first steps of the actor."""


def bc_loss(actor: nn.Module, distance: str) -> BCLoss:
    """TorchRL's BCLoss, without its warning about itself."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        return BCLoss(actor, loss_function=distance)


def networks_of(loss: LossModule) -> list[nn.Module]:
    """The networks that a loss holds, without their parameters."""
    found = (getattr(loss, name.removesuffix("_params"), None) for name, _ in loss.named_children())
    return [network for network in found if isinstance(network, nn.Module)]


def targets_of(loss: LossModule, eps: float) -> SoftUpdate | None:
    """What moves a loss's target networks by 1 - eps a step; None for a loss without any."""
    delayed = any(name.startswith("target_") and name.endswith("_params") for name, _ in loss.named_children())
    return SoftUpdate(loss, eps=eps) if delayed else None


def trained_parameters(loss: LossModule) -> tuple[list[Tensor], list[Tensor]]:
    """The parameters of a loss's actor, and the others."""
    actor: list[Tensor] = []
    others: list[Tensor] = []
    for name, parameter in loss.named_parameters():
        if parameter.requires_grad:
            (actor if name.startswith("actor_network_params") else others).append(parameter)
    return actor, others


def tensors_of(loss: nn.Module) -> dict[str, Tensor]:
    """All parameters and buffers of a loss by name, targets and statistics among them."""
    return {**dict(loss.named_parameters()), **dict(loss.named_buffers())}


@torch.no_grad()
def load_tensors(loss: nn.Module, found: Mapping[str, Tensor]) -> None:
    """Give a loss the tensors that :func:`tensors_of` gave, in place.

    Raises:
        ValueError: they are those of another loss, or hold NaN.
    """
    live = tensors_of(loss)
    check_like(dict(found), {name: tensor.detach() for name, tensor in live.items()}, "loss")
    check_finite(found, live)
    for name, tensor in live.items():
        tensor.copy_(found[name])


def check_loss(loss: LossModule, replay: TensorDictReplayBuffer) -> None:
    """Raise unless a loss can be trained on a buffer; a value estimator that TorchRL would make later is made.

    Raises:
        TypeError: it is no :class:`LossModule`, but what ``torch.compile`` made of one.
        ValueError: its sum must not be minimised, or its discount is not that of the buffer's n steps.
    """
    if not isinstance(loss, LossModule):
        raise TypeError(
            f"loss must be a LossModule, got {type(loss).__name__}, whose targets and actor cannot be found; compile a "
            "loss in place, by loss.compile()"
        )
    if getattr(loss, "reduction", "mean") == "none":
        raise ValueError("loss must give the mean of its rows, got reduction='none'")
    if getattr(loss, "with_lagrange", False):
        raise ValueError(
            "loss: with_lagrange=True gives a loss_alpha_prime that reaches the critics, and takes from them what "
            "loss_cql adds; give with_lagrange=False"
        )
    if (shown := _gamma_of(replay)) is None or loss.default_value_estimator is None:
        return
    own = getattr(loss.value_estimator, "gamma", None)
    if own is not None and abs(float(own) - shown) > 1e-6:
        raise ValueError(
            f"loss: its value estimator's gamma must be that of the replay buffer's n steps, {shown}, got "
            f"{float(own):.6g}; call loss.make_value_estimator(gamma={shown})"
        )


def _gamma_of(replay: TensorDictReplayBuffer) -> float | None:
    """The discount of the rewards that a buffer sums; None where ``next`` is one step ahead."""
    summed = [part.gamma for part in replay.transform if isinstance(part, MultiStepTransform)]
    return next(iter(summed), getattr(replay, "gamma", None))


def sum_of_losses(found: Mapping[str, Any]) -> Tensor:
    """What is minimised of what a loss gives: the sum of its ``loss_`` entries, without those that stand for another.

    Raises:
        ValueError: there is none.
    """
    terms = [value for name, value in found.items() if name.startswith("loss_") and name not in _INSTEAD]
    if not terms:
        raise ValueError(f"loss must give entries that begin with 'loss_', it gives {', '.join(found.keys())}")
    return torch.stack(terms).sum()


def describe_loss(loss: LossModule) -> dict[str, Any]:
    """What tells a loss from another, its trained weights aside: its class and options, the kinds of its networks, and
    a digest of what no training changes, plans and texts among it."""
    digest = sha256()
    for name, tensor in sorted(loss.named_buffers()):
        fixed = not name.startswith("target_") and not name.endswith(("features.mean", "features.std"))
        digest.update(f"{name} {tuple(tensor.shape)}".encode())
        if fixed:
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    options = {name: value for name, value in vars(loss).items() if name[0] != "_" and name != "training"}
    return {
        "class": type(loss).__name__,
        "options": {name: v for name, v in options.items() if isinstance(v, (bool, int, float, str))},
        "networks": [type(network).__name__ for network in networks_of(loss)],
        "shapes": {name: list(parameter.shape) for name, parameter in loss.named_parameters()},
        "fixed": digest.hexdigest(),
    }


def write_training(
    path: Path, described: Mapping[str, Any], state: Mapping[str, Any], tensors: Mapping[str, Tensor]
) -> None:
    """Write how the training of a loss stands, and its tensors; an earlier file is replaced whole."""
    training: dict[str, Tensor] = {}
    tree = split(state, training)
    write_archive(
        path,
        {"format": FORMAT, "version": FORMAT_VERSION, **described, "state": tree},
        {"loss": tensors, "training": training},
    )


def open_training(path: Path, described: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """The state and the tensors that :func:`write_training` wrote of a training of this description.

    Warns:
        UserWarning: it was written under other versions of packages.

    Raises:
        ValueError: it is no such file, damaged, or of another description.
    """
    try:
        archive = TensorArchive(path)
        found = archive.description
        if (found.get("format"), found.get("version")) != (FORMAT, FORMAT_VERSION):
            raise ValueError(f"it is of format {found.get('format')!r:.60} version {found.get('version')!r:.60}")
        state, tensors = join(found.get("state"), archive.tensors("training")), archive.tensors("loss")
    except (ValueError, OSError, RecursionError) as error:
        raise ValueError(f"checkpoint: {str(path)!r} is damaged or none of a loss's training ({error})") from error
    check_same_description(path, found, dict(described))
    warn_of_other_versions(path, found.get("versions"))
    return state, tensors
