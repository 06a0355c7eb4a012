"""What every actor here is made of: a text's vector to a latent, latent and observation to an action."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._checks import check_int
from lw_torchrl.modules.observation_features import Features, ObservationFeatures


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


class ActionDecoder(nn.Module):
    """Makes an observation's features, and with a latent (..., D) float32 an action (..., 4) float32.

    Args:
        latent_size: D.
        features, feature_noise: what it sees of the observation, see :class:`ObservationFeatures`.
        width, depth: of the hidden layers; a tuple of widths says both.
        squash: keep each number of the action in (-1, 1) by tanh; without, the environment clips.
        more: the number of features that the actor adds to them.
    """

    def __init__(
        self,
        latent_size: int,
        features: Features,
        feature_noise: float,
        width: int | Sequence[int],
        depth: int,
        squash: bool = True,
        more: int = 0,
    ) -> None:
        super().__init__()
        self.squash = squash
        self.features = ObservationFeatures(features, feature_noise)
        widths = [width] * check_int("depth", depth, minimum=0) if isinstance(width, int) else list(width)
        self.network = MLP(
            in_features=latent_size + self.features.width + more,
            out_features=4,
            num_cells=[check_int("width", cells, minimum=1) for cells in widths],
            activation_class=nn.ReLU,
        )

    def decode(self, latent: Tensor, features: Tensor) -> Tensor:
        """From features already made, (..., F)."""
        action = self.network(torch.cat((latent, features), -1))
        return torch.tanh(action) if self.squash else action
