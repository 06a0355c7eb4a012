"""How many threads a command's networks use."""

from __future__ import annotations

import os


def use_one_thread() -> None:
    """One thread for PyTorch, unless OMP_NUM_THREADS says otherwise: networks this small gain little from a second, and
    lose much where another process wants the core."""
    if "OMP_NUM_THREADS" not in os.environ:
        import torch

        torch.set_num_threads(1)
