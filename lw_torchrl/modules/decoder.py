"""Decoders: networks that map a skill latent and features to an action or to the parameters of a distribution."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn

from lw_torchrl._util.checks import Count, Natural, Scale, typed
from lw_torchrl._util.keys import Keys, dispatched, read, write
from lw_torchrl.modules.parts import (
    MLP,
    Part,
    Width,
    encoding_keys,
    encoding_width,
    materialize,
    probe,
    trunk_attributes,
)

LEAST_STD = 1e-3


class _ActionMLP(MLP):
    """Base class for MLP decoders. ``squash`` can change after construction, so ``config`` reads its current value."""

    _options: dict[str, Any]
    squash: bool

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        return {**self._options, "squash": self.squash}


class MLPDecoder(_ActionMLP):
    """The paper's action decoder: an MLP that maps a latent and features (..., D + F) to an action (..., A).

    Args:
        width, depth: units per hidden layer and number of hidden layers; a sequence of widths sets both.
        actions: A, the size of an action.
        squash: squash the action to (-1, 1) by tanh; if False, as in the paper, the environment clips the action.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> lw.modules.MLPDecoder(width=64)(torch.rand(5, 120)).shape
        torch.Size([5, 4])

    Source: paper section 'Plan Conditioning'.
    """

    @typed
    def __init__(self, *, width: Width = 256, depth: Natural = 3, actions: Count = 4, squash: bool = True) -> None:
        super().__init__(actions, width=width, depth=depth)
        self.actions, self.squash = actions, squash
        self._options = {"width": width, "depth": depth, "actions": actions}

    def forward(self, *inputs: Tensor) -> Tensor:
        action = super().forward(*inputs)
        return torch.tanh(action) if self.squash else action


class GaussianDecoder(_ActionMLP):
    """An MLP that maps a latent and features (..., D + F) to the mean and standard deviation (..., A) of a Gaussian.

    Args:
        width, depth, actions: see :class:`MLPDecoder`.
        squash: squash the mean to (-1, 1) by tanh; use False with ``TanhNormal``, which squashes the samples.
        init_std: initial standard deviation, the same in every state (above 0.001).

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.modules import ProbabilisticActor, TanhNormal
        >>> decoder = lw.modules.GaussianDecoder(init_std=0.2)
        >>> parts = {"features": lw.modules.ObservationFeatures(), "decoder": decoder}  # no noise in the likelihoods
        >>> trunk = lw.PlanConditionedActor(lw.load_plans("MT10"), **parts, out_keys=["loc", "scale"])
        >>> policy = ProbabilisticActor(trunk, in_keys=["loc", "scale"], distribution_class=TanhNormal)

    Source: ``torchrl.modules.NormalParamExtractor``, with softplus.
    """

    @typed
    def __init__(
        self, *, width: Width = 256, depth: Natural = 3, actions: Count = 4, squash: bool = False, init_std: Scale = 0.3
    ) -> None:
        if init_std <= LEAST_STD:
            raise ValueError(f"init_std must be above {LEAST_STD}, got {init_std}")
        super().__init__(2 * actions, width=width, depth=depth)
        self.actions, self.squash = actions, squash
        self._options = {"width": width, "depth": depth, "actions": actions, "init_std": init_std}
        # The inverse of softplus, which is the identity for large numbers.
        self._offset = math.log(math.expm1(init_std - LEAST_STD)) if init_std < 20 else init_std

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = super().forward(*inputs).chunk(2, -1)
        loc = torch.tanh(loc) if self.squash else loc
        return loc, nn.functional.softplus(scale + self._offset) + LEAST_STD

    @torch.no_grad()
    def copy_from(self, decoder: MLPDecoder) -> None:
        """Use a deterministic decoder's weights for the mean, and reset the standard deviation to ``init_std``."""
        for own, theirs in zip([*self][:-1], [*decoder][:-1], strict=True):
            own.load_state_dict(theirs.state_dict())
        last, trained = self[-1], decoder[-1]
        last.weight.zero_()
        last.bias.zero_()
        last.weight[: self.actions] = trained.weight
        last.bias[: self.actions] = trained.bias


class Decode(Part):
    """A TensorDict module that applies a network to the concatenation of the latent and the features.

    Reads ``skill_latent`` (B, D) and ``features`` (B, F) float32; writes the network's outputs, by default
    ``action`` (B, A) float32.

    Args:
        network: a module that maps the concatenation (B, D + F) to one tensor for each of ``out_keys``.
        in_keys, out_keys: replacements for the default input and output keys; nested keys are allowed.
    """

    _options = ("network",)

    def __init__(self, network: nn.Module, *, in_keys: Keys | None = None, out_keys: Keys) -> None:
        super().__init__(("skill_latent", "features"), list(map(str, out_keys)) or ("action",), in_keys, out_keys)
        self.network = network

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        decoded = self.network(torch.cat(read(tensordict, self.in_keys), -1))
        outputs = decoded if isinstance(decoded, tuple) else (decoded,)
        if len(outputs) != len(self.out_keys_source):
            names = ", ".join(map(str, self.out_keys_source))
            raise ValueError(f"decoder must return one tensor for each of {names}, got {len(outputs)} tensors")
        return write(tensordict, self, outputs)


def as_decoder(decoder: nn.Module, trunk: TensorDictSequential, out_keys: Keys | None = None) -> TensorDictModuleBase:
    """Return a decoder for a trunk. A plain module is wrapped in :class:`Decode`, which reads the trunk's latent
    and features and writes ``out_keys``."""
    width = encoding_width(trunk)
    network = decoder.network if isinstance(decoder, Decode) else decoder
    if width is not None and not isinstance(network, TensorDictModuleBase):
        materialize(network, torch.zeros(1, width, dtype=torch.float32))
    if isinstance(decoder, TensorDictModuleBase):
        if out_keys is not None and list(out_keys) != list(decoder.out_keys_source):
            raise ValueError(f"out_keys must be None or the decoder's own {decoder.out_keys_source}, got {out_keys}")
        return decoder
    decode = Decode(decoder, in_keys=encoding_keys(trunk), out_keys=("action",) if out_keys is None else out_keys)
    if width is not None and len(decode.out_keys) == 1:  # several outputs are parameters of a distribution
        _, _, layout = trunk_attributes(trunk)
        action, size = probe(decoder, torch.zeros(1, width, dtype=torch.float32)), layout.action_size
        if action.shape[-1:] != (size,):
            raise ValueError(f"decoder must return actions (B, {size}) from (B, {width}), got {tuple(action.shape)}")
    return decode
