"""The optimizer of every trainer, and the schedule of its learning rates."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


def make_optimizer(
    rates: Iterable[tuple[Iterable[Tensor], float]], config: Any, device: torch.device
) -> torch.optim.Optimizer:
    """Return the config's optimizer over groups of parameters and their learning rates.

    On a CUDA device the learning rates are tensors, and the optimizer's step can be captured in a graph.
    """
    on_gpu = device.type == "cuda"
    groups: list[dict[str, Any]] = []
    for parameters, rate in rates:
        initial = float(rate)
        lr = torch.tensor(initial, device=device) if on_gpu else initial
        groups.append({"params": list(parameters), "lr": lr, "initial_lr": initial})
    groups = [group for group in groups if group["params"]]
    decay = config.weight_decay
    if getattr(config, "optimizer", "adamw") == "sgd":
        return torch.optim.SGD(groups, momentum=config.momentum, weight_decay=decay, fused=True)
    return torch.optim.AdamW(groups, weight_decay=decay, fused=True, capturable=on_gpu)


def rate_factor(config: Any, step: int) -> float:
    """Return the factor of the learning rates after N steps: a cosine from 1 to 0, or 1 with schedule="constant"."""
    if getattr(config, "schedule", "cosine") == "constant":
        return 1.0
    return 0.5 * (1.0 + math.cos(math.pi * step / config.steps))


def set_learning_rates(optimizer: torch.optim.Optimizer, factor: float) -> None:
    """Set each group's learning rate to its initial one times a factor."""
    for group in optimizer.param_groups:
        rate = group["initial_lr"] * factor
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate


def check_loss(losses: Tensor, step: int, config: Any) -> None:
    """Raise :class:`ValueError` if a loss, () or (M,) of M actors, is not finite."""
    if losses.isfinite().all():
        return
    which = int((~losses.reshape(-1).isfinite()).nonzero()[0])
    model = f" of actor {which}" if losses.ndim else ""
    raise ValueError(
        f"the loss{model} is {losses.reshape(-1)[which].item()} at step {step}: the demonstrations hold NaN, or the "
        f"learning rate {config.learning_rate} is too high"
    )
