"""What a configuration adds to the loss of imitation: terms on the latents of a policy's skills."""

from __future__ import annotations

from typing import Any

from torch import Tensor, nn

from lw_torchrl.objectives.skill_latents import Kind, latent_term, skill_encoder
from lw_torchrl.training.config import BehavioralCloningConfig


class LatentTerms(nn.Module):
    """The weighted sum of a configuration's terms, of an actor; a module, for ``functional_call``.

    Attributes:
        weights: of each kind that is asked for; empty for none, and then it is not to be called.

    Raises:
        ValueError: a term is asked for of an actor without plans.
    """

    def __init__(self, actor: Any, config: BehavioralCloningConfig) -> None:
        super().__init__()
        asked: list[tuple[str, Kind]] = [("latent_consistency", "consistency"), ("latent_contrast", "contrastive")]
        self.weights: dict[Kind, float] = {}
        for name, kind in asked:
            if weight := getattr(config, name):
                skill_encoder(name, actor)
                self.weights[kind] = weight
        self.actor = actor

    def forward(self) -> Tensor:
        encoder = skill_encoder("actor", self.actor)
        terms = [weight * latent_term(encoder, kind) for kind, weight in self.weights.items()]
        return sum(terms[1:], terms[0])
