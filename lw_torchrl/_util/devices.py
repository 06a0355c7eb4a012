"""How networks run: on which device, with which random numbers, and on how many rows at once."""

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

_ASSERTING = {"cuda"}  # where torch._assert_async waits for nobody


def plain(*tensors: Tensor) -> bool:
    """Whether the tensors are plain numbers: not while compiled or exported, nor inside a ``torch.func`` transform."""
    if torch.compiler.is_compiling():
        return False
    for tensor in tensors:  # noqa: SIM110 - in every call, and a generator takes twice as long
        if is_functorch_wrapped_tensor(tensor) or isinstance(tensor, FakeTensor):
            return False
    return True


def waits(*tensors: Tensor) -> bool:
    """Whether reading the tensors' numbers would wait for a device that can check them itself."""
    for tensor in tensors:  # noqa: SIM110 - as above
        if not tensor.is_cpu and tensor.device.type in _ASSERTING:
            return True
    return False


def readable(*tensors: Tensor) -> bool:
    """Whether Python may read the tensors' numbers: they are :func:`plain`, and none is on a CUDA device."""
    return plain(*tensors) and not waits(*tensors)


def asserted(*tensors: Tensor) -> bool:
    """Whether ``torch._assert_async`` checks the tensors: compiled, or on a CUDA device, but not inside ``vmap``."""
    if not torch.compiler.is_compiling():
        return waits(*tensors) and plain(*tensors)
    for tensor in tensors:  # noqa: SIM110 - as above
        if is_batchedtensor(tensor):
            return False
    return True


def check_values(holds: Callable[[Tensor], Tensor], tensor: Tensor, problem: str) -> None:
    """Raise :class:`ValueError` unless ``holds(tensor)``, () bool; compiled or on a GPU, a RuntimeError later."""
    if asserted(tensor):
        torch._assert_async(holds(tensor), problem)
    elif readable(tensor) and not holds(tensor):
        raise ValueError(problem)


def finite(tensor: Tensor) -> bool:
    """Whether all numbers are; the sum is fast, but may overflow."""
    return math.isfinite(tensor.sum().item()) or bool(tensor.isfinite().all())


def check_finite(argument: str, tensor: Tensor) -> None:
    """:func:`check_values` of a tensor whose numbers must be finite."""
    if not (readable(tensor) and finite(tensor)):
        problem = f"{argument} must hold finite numbers, got NaN or infinity"
        check_values(lambda values: values.isfinite().all(), tensor, problem)


_NAMES = ("cpu", "cuda", "cuda:0", "mps", "auto")
CPU = torch.device("cpu")
BLOCK = 64  # rows that networks run on at once


def check_device(argument: str, given: Any) -> torch.device:
    """The device that is meant, with its number: a :class:`torch.device`, a kind that PyTorch knows, such as "cuda",
    with or without a number, or "auto" for this machine's accelerator, or the CPU where it has none. A name of no
    device, or of none in this machine, is a :class:`ValueError`, anything else a :class:`TypeError`."""
    if not isinstance(given, (str, torch.device)):
        raise TypeError(f"{argument} must be a device's name, got {shown(given)}")
    accelerator = torch.accelerator.current_accelerator(check_available=True)
    there = ["cpu"]
    if accelerator is not None:
        kind = accelerator.type
        there += [kind, *(f"{kind}:{number}" for number in range(torch.accelerator.device_count()))]
    if given == "auto":
        given = there[1] if len(there) > 1 else "cpu"
    try:
        device = torch.device(given)
    except RuntimeError:
        raise unknown_name(argument, given, _NAMES) from None
    if device.type == "cpu":
        return CPU
    if str(device) not in there:
        known, none = ", ".join(map(repr, [*there, "auto"])), f"this build of PyTorch, has no {device.type.upper()}"
        lack = "" if device.type in there else f": this machine, or {none}"
        raise ValueError(f"{argument} must be one of {known} here, got {str(device)!r}{lack}")
    return torch.empty(0, device=device).device


def device_of(module: Any) -> torch.device:
    """The device of a module's first parameter, or else buffer; the CPU for whatever has neither."""
    if not isinstance(module, torch.nn.Module):
        return CPU
    first = next(chain(module.parameters(), module.buffers()), None)
    return CPU if first is None else first.device


def place(module: Any, device: str | torch.device | None) -> torch.device:
    """Move a module to a device; None leaves it where it is. Returns its device."""
    if device is None:
        return device_of(module)
    found = check_device("device", device)
    if isinstance(module, torch.nn.Module):
        module.to(found)
    return found


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Seed the default generators of the CPU and of a device within the block, and restore them afterwards."""
    others = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(devices=others, device_type=device.type):
        torch.default_generator.manual_seed(seed)
        if others:
            module = torch.get_device_module(device.type)
            generators = getattr(module, "default_generators", None)  # one for each; manual_seed is of the current one
            (module if generators is None else generators[device.index]).manual_seed(seed)
        yield


def in_blocks(policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[TensorDictBase], TensorDictBase]:
    """``policy`` on blocks of one size: an action then depends on its row alone, bit for bit."""
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
