"""Losses that TorchRL lacks, as TorchRL's are: a value by expectile regression, imitation by advantage, TD3 and SAC
that imitate demonstrations, and terms on skills' latents; and n steps for those that hide them."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.objectives.advantage_weighted import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss
from lw_torchrl.objectives.reduction import with_n_steps
from lw_torchrl.objectives.skill_latents import SkillLatentLoss

__all__ = [
    "AdvantageWeightedLoss", "DemonstratedSACLoss", "DemonstratedTD3Loss", "ExpectileValueLoss", "SkillLatentLoss",
    "standardize_by_task", "with_n_steps",
]  # fmt: skip
