"""The networks that policies and critics are made of, and the head from an encoding to an action."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.modules import MLP, IndependentNormal, TanhNormal

from lw_torchrl._checks import check_choice, check_flag, check_int, check_scale

Module = TypeVar("Module", bound=nn.Module)


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


def with_weights_of(own: nn.Module, other: Module) -> Module:
    """The other module, a fresh one, on the parameters and saved buffers of ``own``: training either trains both.

    :class:`RuntimeError` if their names or shapes differ.
    """
    other.load_state_dict(own.state_dict())
    for name, module in other.named_modules():
        mine, passing = own.get_submodule(name), module._non_persistent_buffers_set
        module._parameters.update(mine._parameters)
        module._buffers.update({key: kept for key, kept in mine._buffers.items() if key not in passing})
    other.train(own.training)
    return other


def unit_scale(vectors: Tensor) -> Tensor:
    """Texts' vectors (n, E) rescaled to numbers of size 1: a fresh network hardly tells smaller ones apart."""
    vectors = vectors.to(torch.float32)
    return vectors / vectors.square().mean(-1, keepdim=True).sqrt().clamp(min=1e-6)


def text_to_latent(text_size: int, latent_size: int, width: int, depth: int) -> MLP:
    """An MLP from a text's vector to a skill latent, with ``depth`` hidden layers of ``width``."""
    check_int("latent_size", latent_size, minimum=1)
    return head(text_size, latent_size, width, depth, named="encoder_")


def check_width(argument: str, width: int | Sequence[int]) -> None:
    """Raise unless it is the width of hidden layers, or a width for each."""
    for cells in [width] if isinstance(width, int) else width:
        check_int(argument, cells, minimum=1)


def head(
    size: int, out: int, width: int | Sequence[int], depth: int, *, layer_norm: bool = False, named: str = ""
) -> MLP:
    """An MLP from (..., size) to (..., out); a tuple of widths says both. Errors name ``named`` width and depth."""
    check_width(f"{named}width", width)
    widths = [width] * check_int(f"{named}depth", depth, minimum=0) if isinstance(width, int) else list(width)
    return MLP(
        in_features=size,
        out_features=out,
        num_cells=widths,
        activation_class=nn.ReLU,
        norm_class=nn.LayerNorm if layer_norm else None,
        norm_kwargs=[{"normalized_shape": cells} for cells in widths] if layer_norm else None,
    )


_LEAST_STD = 1e-3

DistributionName = Literal["tanh_normal", "normal"]
DISTRIBUTIONS: dict[str, Callable[..., Distribution]] = {"tanh_normal": TanhNormal, "normal": IndependentNormal}


class ActionHead(nn.Module):
    """An MLP from an encoding of ``size`` to the A numbers of an action, and to its standard deviation where there is a
    distribution; the options are those of :class:`ConditionedActor`."""

    def __init__(
        self,
        size: int,
        width: int | Sequence[int],
        depth: int,
        squash: bool = True,
        distribution: DistributionName | None = None,
        init_std: float = 0.3,
        actions: int = 4,
    ) -> None:
        super().__init__()
        check_flag("squash", squash)
        if distribution is not None:
            check_choice("distribution", distribution, DISTRIBUTIONS)
        if distribution == "tanh_normal" and not squash:
            raise ValueError("squash must be true for the distribution 'tanh_normal', which squashes; take 'normal'")
        if check_scale("init_std", init_std) <= _LEAST_STD:
            raise ValueError(f"init_std must be over {_LEAST_STD}, got {init_std}")
        self.squash, self.distribution, self.actions = squash, distribution, actions
        self.network = head(size, actions * (1 if distribution is None else 2), width, depth)
        self._first = math.log(math.expm1(init_std - _LEAST_STD)) if init_std < 20 else init_std
        if distribution is not None:  # the same at every state, until it is trained
            with torch.no_grad():
                self.network[-1].weight[actions:] = 0.0
                self.network[-1].bias[actions:] = 0.0

    def forward(self, encoding: Tensor) -> Tensor:
        """(..., size) float32 to the action (..., A) float32, the distribution's mode where there is one."""
        return self.mode(self.loc_scale(encoding)[0]) if self.distribution else self._squashed(self.network(encoding))

    def loc_scale(self, encoding: Tensor) -> tuple[Tensor, Tensor]:
        """(..., size) float32 to the Normal's mean and standard deviation, (..., A) float32 each."""
        loc, scale = self.network(encoding).chunk(2, -1)
        if self.distribution == "normal":
            loc = self._squashed(loc)
        return loc, nn.functional.softplus(scale + self._first) + _LEAST_STD

    def mode(self, loc: Tensor) -> Tensor:
        """The action that the Normal's mean stands for."""
        return torch.tanh(loc) if self.distribution == "tanh_normal" else loc

    def dist(self, loc: Tensor, scale: Tensor) -> Distribution:
        """The distribution of actions."""
        assert self.distribution is not None
        return DISTRIBUTIONS[self.distribution](loc, scale)

    def _squashed(self, action: Tensor) -> Tensor:
        return torch.tanh(action) if self.squash else action

    def copy_from(self, other: ActionHead) -> None:
        """Take the weights of a head without a distribution; the standard deviation stays as it is."""
        for own, theirs in zip([*self.network][:-1], [*other.network][:-1], strict=True):
            own.load_state_dict(theirs.state_dict())
        with torch.no_grad():
            self.network[-1].weight[: self.actions] = other.network[-1].weight
            self.network[-1].bias[: self.actions] = other.network[-1].bias
