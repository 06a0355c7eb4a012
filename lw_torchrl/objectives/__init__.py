"""Losses that TorchRL lacks, as TorchRL's are: a value by expectile regression, and imitation by advantage."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.objectives.advantage_weighted import AdvantageWeightedLoss, standardize_by_task
from lw_torchrl.objectives.expectile_value import ExpectileValueLoss

__all__ = ["AdvantageWeightedLoss", "ExpectileValueLoss", "standardize_by_task"]
