"""What a policy must be to be kept in a file, and what a file's must be to be made again."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.modules.module import register_module_parameter_registration_hook

from lw_torchrl._state_tree import check_like
from lw_torchrl.modules.policy import Policy, from_description

_TEXT_TOLERANCE = 0.01  # of numbers of size 1: more than machines differ, far less than encoders do


def check_can_be_saved(actor: Any) -> Policy:
    """Return the actor if a policy file can hold it: what cannot be loaded again is refused before any training.

    Raises:
        TypeError: it is no :class:`Policy`.
        ValueError: it is one that its own description does not make again, or its weights are no finite numbers.
    """
    if not isinstance(actor, Policy):
        raise TypeError(
            f"actor must be a Policy to be kept in a file, got {type(actor).__name__}: save the policy inside of it, "
            "derive your class from lw_torchrl.Policy, or train without a checkpoint"
        )
    described, texts = actor.describe(), text_vectors(actor)
    size = next((vectors.shape[-1] for vectors in texts.values()), 0)
    try:
        with torch.random.fork_rng(devices=[]):
            again = from_description(
                json.loads(json.dumps(described)), (lambda found: torch.ones(len(found), size)) if texts else None
            )
        check_remade(actor, again)
    except Exception as error:
        raise ValueError(
            f"actor cannot be kept in a file, which would not make it again from its description ({first_line(error)})"
        ) from error
    return actor


def check_remade(module: nn.Module, again: nn.Module) -> None:
    """Raise :class:`ValueError` unless what was made again of a description can hold the weights, all finite."""
    weights = module.state_dict(keep_vars=True)
    check_like(weights, again.state_dict(), "weights")
    check_finite(weights, weights)


def check_finite(weights: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` unless the weights of what is a parameter in ``live`` are finite, and the statistics of
    features too, with a standard deviation above 0."""
    for name, tensor in live.items():
        statistics = name.endswith(("features.mean", "features.std"))
        if (statistics or isinstance(tensor, nn.Parameter)) and not weights[name].isfinite().all():
            raise ValueError(f"weights: {name} must be finite, it holds NaN or infinity")
        if name.endswith("features.std") and not (weights[name] > 0).all():
            raise ValueError(f"weights: {name} must be above 0, it holds {weights[name].min().item()}")


def check_trained(weights: Mapping[str, Tensor], step: int) -> None:
    """Raise :class:`ValueError` if training has made parameters that are no numbers."""
    try:
        check_finite(weights, weights)
    except ValueError as error:
        raise ValueError(f"{error} after step {step}: the learning rate is too high") from error


def text_vectors(actor: nn.Module) -> dict[str, Tensor]:
    """The vectors of an actor's texts, by the name of the buffer that holds them."""
    named = actor.named_buffers(remove_duplicate=False)  # an ensemble may have one member twice
    return {name: buffer for name, buffer in named if name.rpartition(".")[2] == "text_vectors"}


def check_options(found: Any, weights: Mapping[str, Tensor]) -> None:
    """Refuse integers that no network of these weights can have, before lists of that length are made."""
    _check_integers(found, sum(tensor.numel() for tensor in weights.values()))


def _check_integers(found: Any, numbers: int) -> None:
    inside = found.values() if isinstance(found, dict) else found if isinstance(found, list) else ()
    if isinstance(found, int) and abs(found) > max(numbers, 2**16):
        raise ValueError(f"it says {found:.3g}, but holds only {numbers} numbers")
    for one in inside:
        _check_integers(one, numbers)


class _Limit(threading.local):
    """How many parameters a thread's new modules may still have, and numbers in them; None where no limit is."""

    parameters: int | None = None
    numbers = 0


_LIMIT = _Limit()


def _count(module: nn.Module, name: str, parameter: nn.Parameter | None) -> None:
    if _LIMIT.parameters is None or parameter is None:
        return
    _LIMIT.parameters -= 1
    _LIMIT.numbers -= parameter.numel()
    if min(_LIMIT.parameters, _LIMIT.numbers) < 0:
        raise ValueError("it describes a network of more weights or numbers than it holds")


# Once and for all: one that came and went would break the threads that are just going through the hooks.
register_module_parameter_registration_hook(_count)


@contextmanager
def at_most(weights: Mapping[str, Tensor]) -> Iterator[None]:
    """Stop a module that this thread makes as soon as it has more parameters than there are weights, or more numbers in
    them, before they are filled."""
    before = _LIMIT.parameters, _LIMIT.numbers
    _LIMIT.parameters, _LIMIT.numbers = len(weights), sum(tensor.numel() for tensor in weights.values())
    try:
        yield
    finally:
        _LIMIT.parameters, _LIMIT.numbers = before


@torch.no_grad()
def copy_weights(stored: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Copy weights in place; :class:`ValueError` where a name, shape or dtype differs, or one is no finite number."""
    check_like(stored, dict(live), "weights")
    check_finite(stored, live)
    for name, tensor in live.items():
        tensor.copy_(stored[name])


def check_texts(stored: Mapping[str, Tensor], ours: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` unless the texts have the vectors that they had when the file was written."""
    for name, vectors in ours.items():
        found = stored.get(name)
        if found is None or found.shape != vectors.shape or found.dtype != vectors.dtype:
            said = "none" if found is None else tuple(found.shape)
            raise ValueError(
                f"text_encoder gives vectors of shape {tuple(vectors.shape)}, the policy was made with {said}"
            )
        if not torch.allclose(found, vectors.cpu(), atol=_TEXT_TOLERANCE, rtol=0.0):
            raise ValueError(
                "text_encoder is not the one that the policy was made with: its texts have other vectors; pass that "
                "one as text_encoder"
            )


def first_line(error: Exception) -> str:
    """What an error says, up to 400 characters of its first line."""
    return (str(error).splitlines() or [type(error).__name__])[0][:400]
