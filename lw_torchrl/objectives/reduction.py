"""What losses share: how the rows' losses become one, the weights that a sampler gave rows, references to let go."""

from __future__ import annotations

from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import LossModule

from lw_torchrl._checks import check_choice

Reduction = Literal["none", "mean", "sum"]
REDUCTIONS = ("none", "mean", "sum")


def set_reduction(loss: LossModule, given: Any) -> None:
    """Take one of "none", "mean" and "sum"; None for "mean", which the loss's class says, as older checkpoints do."""
    if given is not None and check_choice("reduction", given, REDUCTIONS) != loss.reduction:
        loss.reduction = given


def priority_weight(loss: LossModule, tensordict: TensorDictBase) -> Tensor | None:
    """The weights that a ``PrioritizedSampler`` gave the rows, (B,); None where there are none or none are wanted."""
    return tensordict.get(loss.tensor_keys.priority_weight, None) if loss.use_prioritized_weights else None


def let_go(*tensordicts: TensorDictBase) -> None:
    """Drop the references that tensordicts keep to modules, which ``torch.compile`` cannot make again."""
    if torch.compiler.is_compiling():
        for one in tensordicts:
            one.clear_refs_for_compile_()
