"""Losses that TorchRL lacks, in its style."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss

__all__ = [
    "DemonstratedSACLoss",
    "DemonstratedTD3Loss",
]
