"""Devices: which one is meant, which one a module is on, and what is drawn there."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch

from lw_torchrl._checks import shown, unknown_name

_NAMES = ("cpu", "cuda", "cuda:0", "mps", "auto")
CPU = torch.device("cpu")


def check_device(argument: str, given: Any) -> torch.device:
    """The device that is meant, with its number.

    Args:
        argument: its name, for errors.
        given: "cpu", "cuda", "cuda:1", "mps", or "auto" for the first that there is of "cuda", "mps" and "cpu"; or a
            :class:`torch.device`.

    Raises:
        ValueError: it is none of these, or not in this machine.
        TypeError: it is neither a name nor a device.

    Example:
        >>> check_device("device", "cpu")
        device(type='cpu')
    """
    if not isinstance(given, (str, torch.device)):
        raise TypeError(f"{argument} must be a device's name, got {shown(given)}")
    there = ["cpu", *_of_cuda(), *(["mps"] if torch.backends.mps.is_available() else [])]
    if str(given) == "auto":
        return check_device(argument, next((name for name in ("cuda", "mps") if name in there), "cpu"))
    try:
        device = torch.device(given)
    except RuntimeError:
        raise unknown_name(argument, given, _NAMES) from None
    if device.type not in ("cpu", "cuda", "mps"):
        raise unknown_name(argument, str(device), _NAMES)
    if device.type == "cpu":
        return CPU
    if str(device) not in (*there, "mps:0" if "mps" in there else ""):
        lack = {
            "cuda": "this build of PyTorch has no CUDA" if torch.version.cuda is None else "this machine has no CUDA",
            "mps": "this machine has no MPS",
        }[device.type]
        raise ValueError(
            f"{argument} must be one of {', '.join(map(repr, [*there, 'auto']))} here, got {str(device)!r}"
            + ("" if device.type in there else f": {lack}")
        )
    return torch.empty(0, device=device).device


def _of_cuda() -> list[str]:
    if not torch.cuda.is_available():
        return []
    return ["cuda", *(f"cuda:{number}" for number in range(torch.cuda.device_count()))]


def device_of(module: Any) -> torch.device:
    """The device of a module's first parameter, or else buffer; the CPU for whatever has neither.

    Example:
        >>> device_of(torch.nn.Linear(1, 1)), device_of(print)
        (device(type='cpu'), device(type='cpu'))
    """
    if not isinstance(module, torch.nn.Module):
        return CPU
    for tensors in (module.parameters(), module.buffers()):
        for tensor in tensors:
            return tensor.device
    return CPU


def place(module: torch.nn.Module, device: str | torch.device | None) -> torch.device:
    """Move a module to a device; with None it stays. Returns where it is."""
    if device is None:
        return device_of(module)
    found = check_device("device", device)
    module.to(found)
    return found


@contextmanager
def drawn_on(device: torch.device, state: torch.Tensor) -> Iterator[None]:
    """Within the block the global generators draw what ``state``, the CPU's, leads to; afterwards what they would have.

    A device's generator is given a seed that the CPU's draws: so one state says it all, on whatever device.
    """
    if device.type == "cpu":
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(state)
            yield
        return
    with torch.random.fork_rng(devices=[device], device_type=device.type):
        torch.set_rng_state(state)
        seed = int(torch.randint(2**62, ()))
        if device.type == "cuda":
            torch.cuda.default_generators[device.index].manual_seed(seed)
        else:
            torch.get_device_module(device.type).manual_seed(seed)
        yield
