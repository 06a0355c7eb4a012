"""Losses that TorchRL lacks: expectile regression, weighted imitation, and TD3 and SAC with demonstrations."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss
from lw_torchrl.objectives.offline import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task, with_n_steps

__all__ = [
    "AdvantageWeightedLoss", "DemonstratedSACLoss", "DemonstratedTD3Loss", "ExpectileValueLoss",
    "standardize_by_task", "with_n_steps",
]  # fmt: skip
