"""What weights, texts and sizes a module and its file must have, so that one can be made of the other."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from lw_torchrl._tensor_archive import check_like
from lw_torchrl.language.text import TEXT_DIMENSION, TextEncoder

_TEXT_TOLERANCE = 0.01  # of numbers of size 1: more than machines differ, far less than encoders do


def check_finite(weights: Mapping[str, Tensor], live: Mapping[str, Tensor]) -> None:
    """Raise :class:`ValueError` unless the weights of parameters in ``live`` are finite, and statistics, std over 0."""
    for name, tensor in live.items():
        statistics = name.endswith(("features.mean", "features.std"))
        if (statistics or isinstance(tensor, nn.Parameter)) and not weights[name].isfinite().all():
            raise ValueError(f"weights: {name} must be finite, it holds NaN or infinity")
        if name.endswith("features.std") and not (weights[name] > 0).all():
            raise ValueError(f"weights: {name} must be above 0, it holds {weights[name].min().item()}")


def text_vectors(actor: nn.Module) -> dict[str, Tensor]:
    """The vectors of an actor's texts, by the name of the buffer that holds them; not those of canonical plans, which
    no text encoder gives."""
    found = {}
    for name, module in actor.named_modules(remove_duplicate=False):  # an ensemble may have one member twice
        vectors = module._buffers.get("text_vectors")
        if vectors is not None and not getattr(module, "canonical", False):
            found[f"{name}.text_vectors".lstrip(".")] = vectors
    return found


def tensors_of(module: nn.Module) -> dict[str, Tensor]:
    """All parameters and buffers of a module by name; a loss's targets and statistics among them."""
    return {**dict(module.named_parameters()), **dict(module.named_buffers())}


def check_integers(found: Any, numbers: int, tensors: int, name: str = "") -> None:
    """Refuse integers in a description that no network of so many numbers has, before lists of that length are made."""
    if isinstance(found, dict):
        for key, one in found.items():
            check_integers(one, numbers, tensors, key)
    elif isinstance(found, list):
        for one in found:
            check_integers(one, numbers, tensors, name)
    elif isinstance(found, int) and abs(found) > max(numbers, 2**16):
        raise ValueError(f"it says {found:.3g}, but holds only {numbers} numbers")
    elif isinstance(found, int) and name.endswith("depth") and found > max(tensors, 64):
        raise ValueError(f"it describes a network of {found:.3g} layers, but holds only {tensors} tensors")


_FACTORIES = {torch.empty, torch.zeros, torch.ones, torch.full, torch.rand, torch.randn}
_MORE_TENSORS, _MORE_NUMBERS = 10_000, 2**20  # that a constructor may make besides its weights
_MORE_OF_TEXTS = 2**24  # numbers; an evaluator's file holds one text, whatever plans it is for


class _Budget(TorchFunctionMode):
    """Inside of it, PyTorch raises once it has made many more tensors, or numbers, than some weights have."""

    def __init__(self, weights: Mapping[str, Tensor]) -> None:
        super().__init__()
        self.stored = sum(tensor.numel() for tensor in weights.values())
        self.tensors = 10 * len(weights) + _MORE_TENSORS
        self.numbers = 2 * self.stored + _MORE_NUMBERS

    def __torch_function__(
        self, func: Callable[..., Any], types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        made = func(*args, **(kwargs or {}))
        if func in _FACTORIES:
            self.tensors -= 1
            self.numbers -= made.numel()
            if min(self.tensors, self.numbers) < 0:
                raise ValueError(f"it describes a network of more weights or numbers than it holds, {self.stored}")
        return made


def check_size(
    make: Callable[[TextEncoder], nn.Module], weights: Mapping[str, Tensor], texts: Mapping[str, Tensor]
) -> None:
    """Make a module for a trial, and raise :class:`ValueError` as soon as it has more weights than are stored. ``make``
    gets a text encoder that gives vectors as wide as the stored ``texts``, so that no text model is loaded."""
    with torch.random.fork_rng(devices=[]), _Budget(weights):
        make(stand_in(texts))


def stand_in(found: Mapping[str, Tensor]) -> TextEncoder:
    """An encoder that gives ones: vectors as wide as those of a file's texts, and not many more numbers in all."""
    width = next((vectors.shape[-1] for vectors in found.values() if vectors.ndim == 2), TEXT_DIMENSION)
    stored = sum(vectors.numel() for vectors in found.values())
    left = stored + _MORE_OF_TEXTS

    def ones(texts: Sequence[str]) -> Tensor:
        nonlocal left
        left -= len(texts) * width
        if left < 0:
            raise ValueError(f"its texts have more numbers than the {stored} that it holds of them")
        return torch.tensor(1.0).expand(len(texts), width)

    return ones


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
            given = f"text_encoder gives vectors of shape {tuple(vectors.shape)}, the policy was made with {said}"
            if found is not None and found.ndim and found.shape[-1] != vectors.shape[-1]:
                given += f"; its texts have {found.shape[-1]} numbers each: text_encoder must be the one that gave them"
            raise ValueError(given)
        if not torch.allclose(found, vectors.cpu(), atol=_TEXT_TOLERANCE, rtol=0.0):
            raise ValueError(
                "text_encoder is not the one that the policy was made with, whose vectors are others; pass that one as "
                "text_encoder"
            )


def first_line(error: Exception) -> str:
    """What an error says, up to 400 characters of its first line, of a longer one whole words."""
    line = (str(error).splitlines() or [type(error).__name__])[0]
    if len(line) <= 400:
        return line
    end = next((at for mark in (", ", " ") if (at := line.rfind(mark, 300, 400)) > 0), 400)
    return f"{line[:end]} ..."
