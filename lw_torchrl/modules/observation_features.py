"""What a policy sees of an observation, normalised with statistics that are part of the module."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Literal

import torch
from torch import Tensor, nn
from torchrl.objectives import add_random_module

from lw_torchrl._checks import check_choice, check_scale
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.value_checks import check_finite

Features = Literal["raw", "differences", "relative", "opening", "none", "both"]
_FINE, _COARSE = 0.02, 0.1  # metres: where the two squashed copies of each difference bend


def relative(observation: Tensor, layout: Layout = METAWORLD) -> Tensor:
    """The pairwise differences between hand, things and goal, of three metres each, the same through tanh at 2 cm and
    at 10 cm: of Meta-World's two things (..., 39) to (..., 54); those to a thing that a task lacks are zero."""
    places = [observation[..., place] for place in layout.positions]
    absent = {n: (places[n] == 0).all(-1, keepdim=True) for n in range(2, len(places) - 1)}
    pairs = []
    for first, second in combinations(range(len(places)), 2):
        difference = places[second] - places[first]
        for thing in {first, second} & absent.keys():
            difference = torch.where(absent[thing], 0.0, difference)
        pairs.append(difference)
    d = torch.cat(pairs, -1)
    return torch.cat((d, *squash(d)), -1)


def differences(observation: Tensor, layout: Layout = METAWORLD) -> Tensor:
    """:func:`relative`, the hand's height and the gripper's opening, (..., 39) to (..., 56)."""
    height, opening = (observation[..., at : at + 1] for at in (layout.hand + 2, layout.opening))
    return torch.cat((relative(observation, layout), height, opening), -1)


def squash(difference: Tensor) -> tuple[Tensor, Tensor]:
    """Metres through tanh at 2 cm and at 10 cm: alignments, and directions."""
    return torch.tanh(difference / _FINE), torch.tanh(difference / _COARSE)


_KINDS: dict[str, Callable[[Tensor, Layout], Tensor]] = {
    "raw": lambda observation, layout: observation,
    "differences": differences,
    "relative": relative,
    "opening": lambda observation, layout: observation[..., layout.opening : layout.opening + 1],
    "none": lambda observation, layout: observation[..., :0],
    "both": lambda observation, layout: torch.cat((observation, differences(observation, layout)), -1),
}
TRANSFERS = ("opening", "none")
"""The features that mean the same in every layout."""


def check_observation(observation: Tensor, layout: Layout) -> None:
    """Raise :class:`ValueError` unless it is (..., D) float32, of a layout."""
    if observation.shape[-1:] != (layout.size,) or observation.dtype != torch.float32:
        got = f"{observation.dtype} of shape {tuple(observation.shape)}"
        raise ValueError(f"observation must be float32 of shape (..., {layout.size}), got {got}")


class ObservationFeatures(nn.Module):
    """Observation to normalised features.

    In training mode Gaussian noise is added to the normalised features, drawn from PyTorch's global generator.

    Args:
        kind: "raw", the 39 numbers; "differences", see :func:`differences`; "relative", see :func:`relative`;
            "opening", the gripper's opening alone; "none", nothing; "both", the 39 numbers and the differences.
        layout: of the observations.
        noise: standard deviation of the noise, in standard deviations of each feature.

    Attributes:
        width: F, the number of features.
        mean, std: (F,) float32 buffers, set by :meth:`fit` and saved with the module.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, kind: Features = "differences", noise: float = 0.0, layout: Layout = METAWORLD) -> None:
        super().__init__()
        self.layout = layout
        self.noise = check_scale("feature_noise", noise)
        self.kind = check_choice("features", kind, _KINDS)
        self.width = _KINDS[kind](torch.zeros(layout.size), layout).shape[-1]
        self.register_buffer("mean", torch.zeros(self.width))
        self.register_buffer("std", torch.ones(self.width))

    def _select(self, observation: Tensor) -> Tensor:
        check_observation(observation, self.layout)
        check_finite("observation", observation)
        return _KINDS[self.kind](observation, self.layout)

    def for_layout(self, layout: Layout) -> ObservationFeatures:
        """The same statistics, shared, for another layout; :class:`ValueError` if they do not carry over."""
        if layout == self.layout:
            return self
        if self.kind not in TRANSFERS:
            what = f"features={self.kind!r} of layout {self.layout.name!r} do not carry over to {layout.name!r}"
            raise ValueError(f"{what}; those that do are {', '.join(map(repr, TRANSFERS))} with roles=True")
        other = ObservationFeatures(self.kind, self.noise, layout)
        other.mean, other.std = self.mean, self.std
        return other

    @torch.no_grad()
    def fit(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take mean and standard deviation from observations, in place. A feature that hardly varies keeps its scale.

        Args:
            observation: (..., 39) float32, R in all; finite.
            weights: of each, (R,) float32, with the sum 1; None for equal ones.
        """
        found = self._select(observation.reshape(-1, self.layout.size))
        if not found.shape[-1]:
            return  # PyTorch warns of a deviation of nothing
        if weights is None:
            mean, std = found.mean(0), found.std(0, unbiased=False)
        else:
            mean = weights @ found
            std = (weights @ (found - mean).square()).sqrt()
        self.mean.copy_(mean)
        self.std.copy_(torch.where(std > 1e-4, std, 1.0))

    def forward(self, observation: Tensor) -> Tensor:
        """(..., 39) float32 to (..., F) float32, within 10 standard deviations of the mean."""
        found = ((self._select(observation) - self.mean) / self.std).clamp(-10.0, 10.0)
        return found + self.noise * torch.randn_like(found) if self.training and self.noise else found


add_random_module(ObservationFeatures)  # losses that vmap over networks then let each draw its own noise
