"""Networks on blocks of rows of one size, so that a row's result depends on that row alone."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase

BLOCK = 64


def in_blocks(
    policy: Callable[[TensorDictBase], TensorDictBase],
) -> Callable[[TensorDictBase], TensorDictBase]:
    """``policy``, run on blocks of exactly 64 rows, the last one padded.

    A matrix product of another number of rows rounds differently, and contact amplifies the last bits. With blocks
    of one size a row's action depends on that row alone, whatever the number of environments.
    """

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        n = tensordict.batch_size[0]
        padding = -n % BLOCK
        padded = torch.cat([tensordict, tensordict[:1].expand(padding)]) if padding else tensordict
        outputs = torch.cat([policy(block.copy()) for block in padded.split(BLOCK)])
        return tensordict.update(outputs[:n])

    return run
