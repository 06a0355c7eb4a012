"""Minibatches of a buffer, drawn from a random state that a checkpoint can hold."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch

from lw_torchrl._devices import CPU, drawn_on


class Minibatches:
    """Minibatches of a buffer. Sampler, transforms and networks draw from one random state, which starts at a seed.

    The state is on the CPU, so minibatches are the same on every device.

    Args:
        source: has ``sample(size)``, which returns a TensorDict, as replay buffers do.
        size: number of rows.
        seed: of the random state.
    """

    def __init__(self, source: Any, size: int, seed: int) -> None:
        self.source, self.size = source, size
        self.random = torch.Generator().manual_seed(seed).get_state()
        if hasattr(source, "set_rng"):
            source.set_rng(torch.default_generator)  # which `drawing` sets to this object's state

    @contextmanager
    def drawing(self, device: torch.device) -> Iterator[None]:
        """Within the block PyTorch's generators draw from this object's random state."""
        with drawn_on(device, self.random):
            yield
            self.random = torch.get_rng_state()

    def draw(self, device: torch.device) -> Any:
        """Return the next minibatch on the device; the CPU does not wait for the copy."""
        batch = self.source.sample(self.size)
        return batch if device == CPU else batch.to(device, non_blocking=True)

    def state_dict(self) -> dict[str, Any]:
        sampler = getattr(self.source, "sampler", None)
        return {"random": self.random.clone(), "sampler": {} if sampler is None else dict(sampler.state_dict())}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self.random = state["random"].clone()
        if state["sampler"]:
            self.source.sampler.load_state_dict(state["sampler"])
