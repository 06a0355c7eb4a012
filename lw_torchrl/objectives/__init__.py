"""Losses that TorchRL lacks, as TorchRL's are: a value by expectile regression, imitation by advantage, and TD3 and SAC
that imitate demonstrations."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.objectives.advantage_weighted import AdvantageWeightedLoss, standardize_by_task
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss
from lw_torchrl.objectives.expectile_value import ExpectileValueLoss

__all__ = [
    "AdvantageWeightedLoss",
    "DemonstratedSACLoss",
    "DemonstratedTD3Loss",
    "ExpectileValueLoss",
    "standardize_by_task",
]
