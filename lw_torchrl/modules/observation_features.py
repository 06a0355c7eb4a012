"""What a policy sees of an observation, normalised with statistics that are part of the module."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import Literal

import torch
from torch import Tensor, nn
from torchrl.objectives import add_random_module

from lw_torchrl._checks import check_choice, check_scale
from lw_torchrl.language.observation import HAND, OBSERVATION_SIZE, OPENING, POSITIONS
from lw_torchrl.language.value_checks import check_finite

Features = Literal["raw", "differences", "relative", "opening", "both"]
_FINE, _COARSE = 0.02, 0.1  # metres: where the two squashed copies of each difference bend


def relative(observation: Tensor) -> Tensor:
    """The pairwise differences between hand, both objects and goal, (..., 39) to (..., 54).

    Six differences of three metres each, the same through tanh at 2 cm and at 10 cm. Differences to a second object
    that the task does not have are zero.
    """
    places = [observation[..., place] for place in POSITIONS]
    absent = (places[2] == 0).all(-1, keepdim=True)
    pairs = []
    for first, second in combinations(range(4), 2):
        difference = places[second] - places[first]
        pairs.append(torch.where(absent, 0.0, difference) if 2 in (first, second) else difference)
    d = torch.cat(pairs, -1)
    return torch.cat((d, *squash(d)), -1)


def differences(observation: Tensor) -> Tensor:
    """:func:`relative`, the hand's height and the gripper's opening, (..., 39) to (..., 56)."""
    return torch.cat((relative(observation), observation[..., HAND.stop - 1 : OPENING + 1]), -1)


def squash(difference: Tensor) -> tuple[Tensor, Tensor]:
    """Metres through tanh at 2 cm and at 10 cm: alignments, and directions."""
    return torch.tanh(difference / _FINE), torch.tanh(difference / _COARSE)


_KINDS: dict[str, tuple[int, Callable[[Tensor], Tensor]]] = {
    "raw": (OBSERVATION_SIZE, lambda observation: observation),
    "differences": (56, differences),
    "relative": (54, relative),
    "opening": (1, lambda observation: observation[..., OPENING : OPENING + 1]),
    "both": (OBSERVATION_SIZE + 56, lambda observation: torch.cat((observation, differences(observation)), -1)),
}


def check_observation(observation: Tensor) -> None:
    """Raise :class:`ValueError` unless it is (..., 39) float32."""
    if observation.shape[-1:] != (OBSERVATION_SIZE,) or observation.dtype != torch.float32:
        raise ValueError(
            f"observation must be float32 of shape (..., {OBSERVATION_SIZE}), got {observation.dtype} of shape "
            f"{tuple(observation.shape)}"
        )


class ObservationFeatures(nn.Module):
    """Observation to normalised features.

    In training mode Gaussian noise is added to the normalised features, drawn from PyTorch's global generator.

    Args:
        kind: "raw", the 39 numbers; "differences", see :func:`differences`; "relative", see :func:`relative`;
            "opening", the gripper's opening alone; "both", the 39 numbers and the differences.
        noise: standard deviation of the noise, in standard deviations of each feature.

    Attributes:
        width: F, the number of features.
        mean, std: (F,) float32 buffers, set by :meth:`fit` and saved with the module.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, kind: Features = "differences", noise: float = 0.0) -> None:
        super().__init__()
        self.noise = check_scale("feature_noise", noise)
        self.kind = check_choice("features", kind, _KINDS)
        self.width, _ = _KINDS[kind]
        self.register_buffer("mean", torch.zeros(self.width))
        self.register_buffer("std", torch.ones(self.width))

    def _select(self, observation: Tensor) -> Tensor:
        check_observation(observation)
        check_finite("observation", observation)
        return _KINDS[self.kind][1](observation)

    @torch.no_grad()
    def fit(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """Take mean and standard deviation from observations, in place. A feature that hardly varies keeps its scale.

        Args:
            observation: (..., 39) float32, R in all; finite.
            weights: of each, (R,) float32, with the sum 1; None for equal ones.
        """
        found = self._select(observation.reshape(-1, OBSERVATION_SIZE))
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
