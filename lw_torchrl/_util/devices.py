"""Devices: their names, checks of tensors that do not wait for them, seeds, and networks in blocks of rows."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch._C._functorch import is_batchedtensor, is_functorch_wrapped_tensor
from torch._subclasses.fake_tensor import FakeTensor

from lw_torchrl._util.checks import shown, unknown_name

_ASSERTING = {"cuda"}  # devices on which torch._assert_async checks without waiting


def plain(*tensors: Tensor) -> bool:
    """Return whether the tensors hold numbers: not while compiling or exporting, nor in a ``torch.func`` transform."""
    if torch.compiler.is_compiling():
        return False
    for tensor in tensors:  # noqa: SIM110 - called at every step, and a generator takes twice as long
        if is_functorch_wrapped_tensor(tensor) or isinstance(tensor, FakeTensor):
            return False
    return True


def waits(*tensors: Tensor) -> bool:
    """Return whether reading the tensors would wait for a device that can check them itself."""
    for tensor in tensors:  # noqa: SIM110 - as above
        if not tensor.is_cpu and tensor.device.type in _ASSERTING:
            return True
    return False


def readable(*tensors: Tensor) -> bool:
    """Return whether Python may read the tensors: they are :func:`plain`, and none is on a CUDA device."""
    return plain(*tensors) and not waits(*tensors)


def asserted(*tensors: Tensor) -> bool:
    """Return whether ``torch._assert_async`` can check the tensors: compiled or on a CUDA device, not in ``vmap``."""
    if not torch.compiler.is_compiling():
        return waits(*tensors) and plain(*tensors)
    for tensor in tensors:  # noqa: SIM110 - as above
        if is_batchedtensor(tensor):
            return False
    return True


def check_values(holds: Callable[[Tensor], Tensor], tensor: Tensor, problem: str) -> None:
    """Raise :class:`ValueError` unless ``holds(tensor)``, () bool; if compiled or on a GPU, a later RuntimeError."""
    if asserted(tensor):
        torch._assert_async(holds(tensor), problem)
    elif readable(tensor) and not holds(tensor):
        raise ValueError(problem)


def finite(tensor: Tensor) -> bool:
    """Return whether all numbers are finite."""
    # The sum is faster than isfinite(), but may overflow.
    return math.isfinite(tensor.sum().item()) or bool(tensor.isfinite().all())


def check_finite(argument: str, tensor: Tensor) -> None:
    """Raise as :func:`check_values` unless all numbers of a tensor are finite."""
    if not (readable(tensor) and finite(tensor)):
        problem = f"{argument} must hold finite numbers, got NaN or infinity"
        check_values(lambda values: values.isfinite().all(), tensor, problem)


_NAMES = ("cpu", "cuda", "cuda:0", "mps", "auto")
CPU = torch.device("cpu")
BLOCK = 64  # rows on which networks run at once


def check_device(argument: str, value: Any) -> torch.device:
    """Return a device with its number. ``value`` is a :class:`torch.device`, a name that PyTorch knows, such as "cuda"
    or "cuda:0", or "auto" for this machine's accelerator, or the CPU without one. Raise :class:`ValueError` for a
    device that does not exist or is not in this machine, and :class:`TypeError` for another object."""
    if not isinstance(value, (str, torch.device)):
        raise TypeError(f"{argument} must be a device's name, got {shown(value)}")
    accelerator = torch.accelerator.current_accelerator(check_available=True)
    available = ["cpu"]
    if accelerator is not None:
        kind = accelerator.type
        available += [kind, *(f"{kind}:{number}" for number in range(torch.accelerator.device_count()))]
    if value == "auto":
        value = available[1] if len(available) > 1 else "cpu"
    try:
        device = torch.device(value)
    except RuntimeError:
        raise unknown_name(argument, value, _NAMES) from None
    if device.type == "cpu":
        return CPU
    if str(device) not in available:
        known = ", ".join(map(repr, [*available, "auto"]))
        absent = f"this machine, or this build of PyTorch, has no {device.type.upper()}"
        reason = "" if device.type in available else f": {absent}"
        raise ValueError(f"{argument} must be one of {known} here, got {str(device)!r}{reason}")
    return torch.empty(0, device=device).device


def device_of(module: Any) -> torch.device:
    """Return the device of a module's first parameter or buffer; the CPU for anything without them."""
    if not isinstance(module, torch.nn.Module):
        return CPU
    first = next(chain(module.parameters(), module.buffers()), None)
    return CPU if first is None else first.device


def place(module: Any, device: str | torch.device | None) -> torch.device:
    """Move a module to a device, unless that is None, and return the module's device."""
    if device is None:
        return device_of(module)
    checked = check_device("device", device)
    if isinstance(module, torch.nn.Module):
        module.to(checked)
    return checked


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Seed the default generators of the CPU and of a device within the block, and restore them afterwards."""
    others = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(devices=others, device_type=device.type):
        torch.default_generator.manual_seed(seed)
        if others:
            module = torch.get_device_module(device.type)
            generators = getattr(module, "default_generators", None)  # manual_seed would seed the current device only
            (module if generators is None else generators[device.index]).manual_seed(seed)
        yield


def in_blocks(policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return ``policy`` run on blocks of one size, so that an action depends only on its row, bit for bit."""
    modules = policy.modules() if isinstance(policy, torch.nn.Module) else [policy]
    size = min(getattr(module, "rows_at_once", BLOCK) for module in modules)

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        n = tensordict.batch_size[0]
        padding = -n % size
        padded = torch.cat([tensordict, tensordict[:1].expand(padding)]) if padding else tensordict
        outputs = [policy(block.copy()) for block in padded.split(size)]
        if not isinstance(outputs[0], TensorDictBase):
            raise TypeError(f"a policy must return the TensorDict that it is given, got a {type(outputs[0]).__name__}")
        return tensordict.update(torch.cat(outputs)[:n])

    return run
