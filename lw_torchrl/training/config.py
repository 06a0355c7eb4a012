"""How an actor is trained: the options, and the optimizer and schedule that they say."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from lw_torchrl._checks import check_choice, check_fields, check_int, check_positive, check_scale

LOSSES = ("l1", "l2", "smooth_l1")
_LATER = {"latent_consistency", "latent_contrast", "qaf_anchor"}
"""Options that files did not say at first: at 0, training is what it was before them."""


@dataclass(frozen=True)
class BehavioralCloningConfig:
    """How an actor is trained.

    Attributes:
        steps: minibatches.
        batch_size: rows of a minibatch; the number of tasks must divide it.
        learning_rate: at the start.
        optimizer: "adamw" or "sgd".
        weight_decay: the optimizer's.
        momentum: of "sgd".
        schedule: of the learning rate, "cosine" to 0 or "constant".
        normalize: first take the statistics of the observation's features from the demonstrations.
        loss_function: between the actor's and the demonstrated action: "l1", "l2" or "smooth_l1".
        max_grad_norm: gradients are clipped to it.
        seed: of the minibatches, and of what the buffer's transforms and the actor draw while training.
        checkpoint_every: steps between checkpoints; the last step always makes one.
        latent_consistency: weight of :class:`SkillLatentLoss` "consistency" in the loss, of a policy with plans: skills
            whose texts are near stay near.
        latent_contrast: weight of the "contrastive" one: different skills keep apart.
        qaf_anchor: weight of the cross entropy of an evaluator's answers with the query answering function's, of a
            policy with an evaluator: its conditions keep to their words.
    """

    steps: int = 8000
    batch_size: int = 500
    learning_rate: float = 1e-3
    optimizer: str = "adamw"
    weight_decay: float = 1e-4
    momentum: float = 0.9
    schedule: str = "cosine"
    normalize: bool = True
    loss_function: str = "l2"
    max_grad_norm: float = 1.0
    seed: int = 0
    checkpoint_every: int = 500
    latent_consistency: float = 0.0
    latent_contrast: float = 0.0
    qaf_anchor: float = 0.0

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("steps", "batch_size", "checkpoint_every"):
            check_int(name, getattr(self, name), minimum=1)
        for name in ("learning_rate", "weight_decay", "momentum", *sorted(_LATER)):
            check_scale(name, getattr(self, name))
        check_positive("max_grad_norm", self.max_grad_norm)
        check_int("seed", self.seed)
        check_choice("loss_function", self.loss_function, LOSSES)
        check_choice("optimizer", self.optimizer, ("adamw", "sgd"))
        check_choice("schedule", self.schedule, ("cosine", "constant"))

    def describe(self) -> dict[str, Any]:
        """What files say of it, as JSON: files from before an option hold what those with its default hold."""
        return {name: value for name, value in asdict(self).items() if value or name not in _LATER}


def last_step(config: BehavioralCloningConfig, until: int | None) -> int:
    """After how many steps training ends that is asked to end at ``until``."""
    if until is None:
        return config.steps
    check_int("until", until, minimum=1)
    if until > config.steps:
        raise ValueError(f"until must be at most the configuration's steps, {config.steps}, got {until}")
    return until


def make_optimizer(
    parameters: Iterable[Tensor], config: BehavioralCloningConfig
) -> tuple[torch.optim.Optimizer, torch.optim.lr_scheduler.LRScheduler]:
    """The optimizer of a configuration, and its schedule."""
    optimizer: torch.optim.Optimizer
    rate = float(config.learning_rate)  # as it is in a checkpoint
    if config.optimizer == "adamw":
        optimizer = torch.optim.AdamW(parameters, lr=rate, weight_decay=config.weight_decay, fused=True)
    else:
        decay, momentum = config.weight_decay, config.momentum
        optimizer = torch.optim.SGD(parameters, lr=rate, momentum=momentum, weight_decay=decay, fused=True)
    if config.schedule == "cosine":
        return optimizer, torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, config.steps)
    return optimizer, torch.optim.lr_scheduler.LambdaLR(optimizer, lambda _: 1.0)
