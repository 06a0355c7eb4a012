"""Networks run on blocks of one size, so that rows do not feel one another."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import nn

BLOCK = 64


def in_blocks(policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[TensorDictBase], TensorDictBase]:
    """``policy``, run on blocks of exactly 64 rows, the last one padded; of fewer where a module in it says so, by
    ``rows_at_once``: what looks at pictures works for each row that a block is padded with.

    A matrix product of another number of rows rounds differently, and contact amplifies the last bits. With blocks
    of one size a row's action depends on that row alone, whatever the number of environments.
    """
    modules = policy.modules() if isinstance(policy, nn.Module) else [policy]
    size = min(getattr(module, "rows_at_once", BLOCK) for module in modules)

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        n = tensordict.batch_size[0]
        padding = -n % size
        padded = torch.cat([tensordict, tensordict[:1].expand(padding)]) if padding else tensordict
        outputs = torch.cat([policy(block.copy()) for block in padded.split(size)])
        return tensordict.update(outputs[:n])

    return run
