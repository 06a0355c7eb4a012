"""Minibatches of a buffer, whose random draws depend only on a seed and the number of the minibatch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from lw_torchrl._devices import CPU, seeded


class Minibatches:
    """Minibatches of a buffer. What sampler, transforms and networks draw depends only on the seed and the step.

    Samplers draw on the CPU, so minibatches are the same on every device.

    Args:
        source: has ``sample(size)``, which returns a TensorDict, as replay buffers do.
        size: number of rows.
        seed: any integer.
    """

    def __init__(self, source: Any, size: int, seed: int) -> None:
        self.source, self.size, self.seed, self.step = source, size, seed, 0
        if hasattr(source, "set_rng"):
            source.set_rng(torch.default_generator)  # which `drawing` seeds

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Seed PyTorch's generators for a step within the block, and count the step."""
        with seeded(device, (self.seed * 1_000_003 + self.step) % 2**63):
            self.step += 1
            yield

    def draw(self, device: torch.device) -> Any:
        """Return a minibatch on the device; the CPU does not wait for the copy."""
        batch = self.source.sample(self.size)
        return batch if device == CPU else batch.to(device, non_blocking=True)

    def state_dict(self) -> dict[str, Any]:
        sampler = getattr(self.source, "sampler", None)
        return {"step": self.step, "sampler": {} if sampler is None else dict(sampler.state_dict())}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.step = state["step"]
        if state["sampler"]:
            self.source.sampler.load_state_dict(state["sampler"])
