"""The networks that policies and critics are made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._checks import check_int

ACTION_SIZE = 4


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """The network is in evaluation's mode meanwhile, and each of its modules in its own again afterwards."""
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


def unit_scale(vectors: Tensor) -> Tensor:
    """Texts' vectors (n, E), rescaled so that their numbers are of size 1; encoders give vectors of length 1, whose
    numbers are so small that a fresh network hardly tells texts apart."""
    vectors = vectors.to(torch.float32)
    return vectors / vectors.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-6)


def text_to_latent(text_size: int, latent_size: int, width: int, depth: int) -> MLP:
    """An MLP from a text's vector to a skill latent, with ``depth`` hidden layers of ``width``."""
    check_int("latent_size", latent_size, minimum=1)
    check_int("encoder_width", width, minimum=1)
    return MLP(
        in_features=text_size,
        out_features=latent_size,
        num_cells=[width] * check_int("encoder_depth", depth, minimum=0),
        activation_class=nn.ReLU,
    )


def check_width(argument: str, width: int | Sequence[int]) -> None:
    """Raise unless it is the width of hidden layers, or a width for each."""
    for cells in [width] if isinstance(width, int) else width:
        check_int(argument, cells, minimum=1)


def head(size: int, out: int, width: int | Sequence[int], depth: int, *, layer_norm: bool = False) -> MLP:
    """An MLP from an encoding (..., size) to (..., out); a tuple of widths says both width and depth."""
    check_width("width", width)
    widths = [width] * check_int("depth", depth, minimum=0) if isinstance(width, int) else list(width)
    return MLP(
        in_features=size,
        out_features=out,
        num_cells=widths,
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": cells} for cells in widths] if layer_norm else None,
    )
