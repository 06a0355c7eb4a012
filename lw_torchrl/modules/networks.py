"""Multilayer perceptrons, and tools for modules that share weights."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TypeVar

import torch
from torch import Tensor, nn
from torchrl.modules import MLP as TorchRLMLP

from lw_torchrl._util.checks import Count, Natural, check_value

Module = TypeVar("Module", bound=nn.Module)


class MLP(TorchRLMLP):
    """TorchRL's MLP with ReLU, whose input width is that of the first input. Several inputs are concatenated.

    A sequence of widths gives the hidden layers and replaces ``depth``.
    """

    def __init__(
        self, out_features: int, *, width: int | Sequence[int] = 256, depth: int = 3, layer_norm: bool = False
    ) -> None:
        widths = [width] * check_value("depth", depth, Natural) if isinstance(width, int) else list(width)
        for cells in [width] if isinstance(width, int) else widths:
            check_value("width", cells, Count)
        super().__init__(
            out_features=out_features,
            num_cells=widths,
            activation_class=nn.ReLU,
            norm_class=nn.LayerNorm if layer_norm else None,
            norm_kwargs=[{"normalized_shape": cells} for cells in widths] if layer_norm else None,
        )


@torch.no_grad()
def materialize(module: nn.Module, *inputs: Tensor) -> None:
    """Give a module's lazy layers their shapes by a forward pass, if it has lazy layers."""
    if any(isinstance(parameter, nn.parameter.UninitializedParameter) for parameter in module.parameters()):
        with evaluating(module):
            module(*inputs)


@torch.no_grad()
def probe(module: nn.Module, example: Tensor) -> Any:
    """Return what a module gives for an example, moved to its device, without drawing from the global generator."""
    weight = next(module.parameters(), None)
    with evaluating(module), torch.random.fork_rng(devices=[]):
        return module(example if weight is None else example.to(weight.device))


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """Within the block the network is in eval mode; afterwards each of its modules is in its own mode again."""
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


def in_mode_of(own: nn.Module, other: Module) -> Module:
    """Return the other module in train or eval mode as ``own`` is; the modules that both share keep their modes."""
    other.training = own.training
    return other


def with_weights_of(own: nn.Module, other: Module) -> Module:
    """Return the other, fresh module on the weights and saved buffers of ``own``: training either trains both."""
    other.load_state_dict(own.state_dict())
    for name, module in other.named_modules():
        mine, passing = own.get_submodule(name), module._non_persistent_buffers_set
        module._parameters.update(mine._parameters)
        module._buffers.update({key: kept for key, kept in mine._buffers.items() if key not in passing})
    other.train(own.training)
    return other
