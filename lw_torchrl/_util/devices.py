"""Device helpers: parse device names, check tensors without synchronization, set seeds, and run policies in blocks."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import accumulate, chain
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch._C._functorch import is_batchedtensor, is_functorch_wrapped_tensor
from torch._subclasses.fake_tensor import FakeTensor

from lw_torchrl._util.checks import shown

_ASSERTING = {"cuda"}  # devices on which torch._assert_async checks without synchronization


def plain(*tensors: Tensor) -> bool:
    """Return whether Python can read the tensors' values, which is impossible during compilation or export, and inside
    a ``torch.func`` transform."""
    if torch.compiler.is_compiling():
        return False
    for tensor in tensors:  # noqa: SIM110 - called at every step, and a generator takes twice as long
        if is_functorch_wrapped_tensor(tensor) or isinstance(tensor, FakeTensor):
            return False
    return True


def waits(*tensors: Tensor) -> bool:
    """Return whether reading a tensor would synchronize with a device that supports ``torch._assert_async``."""
    for tensor in tensors:  # noqa: SIM110 - as above
        if not tensor.is_cpu and tensor.device.type in _ASSERTING:
            return True
    return False


def readable(*tensors: Tensor) -> bool:
    """Return whether Python may read the tensors: all are :func:`plain`, and none is on a CUDA device."""
    return plain(*tensors) and not waits(*tensors)


def asserted(*tensors: Tensor) -> bool:
    """Return whether ``torch._assert_async`` can check the tensors: in compiled code or on a CUDA device, but not in
    ``vmap``."""
    if not torch.compiler.is_compiling():
        return waits(*tensors) and plain(*tensors)
    for tensor in tensors:  # noqa: SIM110 - as above
        if is_batchedtensor(tensor):
            return False
    return True


def check_values(holds: Callable[[Tensor], Tensor], tensor: Tensor, problem: str) -> None:
    """Raise a :class:`ValueError` unless ``holds(tensor)``. Compiled code and GPUs raise a RuntimeError later."""
    if asserted(tensor):
        torch._assert_async(holds(tensor), problem)
    elif readable(tensor) and not holds(tensor):
        raise ValueError(problem)


def finite(tensor: Tensor) -> bool:
    """Return whether all elements of a tensor are finite."""
    # The sum is faster than isfinite(), but can overflow.
    return math.isfinite(tensor.sum().item()) or bool(tensor.isfinite().all())


def check_finite(argument: str, tensor: Tensor) -> None:
    """Raise an error, as :func:`check_values` does, unless all elements of a tensor are finite."""
    if not (readable(tensor) and finite(tensor)):
        check_values(lambda x: x.isfinite().all(), tensor, f"{argument} must hold finite numbers, got NaN or infinity")


CPU = torch.device("cpu")
BLOCK = 64  # number of rows in each forward pass of a policy
_ALIGNED = 16  # each tensor in a transfer buffer begins at a multiple of this number of bytes


def check_device(argument: str, value: Any) -> torch.device:
    """Return a device with an explicit index. ``value`` is a :class:`torch.device`, a name such as "cuda:0", or "auto"
    for this machine's accelerator (the CPU if there is none). Raise a :class:`ValueError` for any other value."""
    try:
        accelerator = torch.accelerator.current_accelerator(check_available=True)
        device = (accelerator or CPU) if value == "auto" else torch.device(value)
        return CPU if device.type == "cpu" else torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError) as error:  # PyTorch raises several types, with long messages
        reason = str(error).partition("\n")[0]
        must = f"{argument} must be 'cpu', 'auto' or a device of this machine"
        raise ValueError(f"{must}, got {shown(value)} ({reason})") from error


def device_of(module: Any) -> torch.device:
    """Return the device of a module's first parameter or buffer, or the CPU if the object has neither."""
    if not isinstance(module, torch.nn.Module):
        return CPU
    first = next(chain(module.parameters(), module.buffers()), None)
    return CPU if first is None else first.device


def place(module: Any, device: str | torch.device | None) -> torch.device:
    """Move a module to ``device``, unless ``device`` is None, and return the module's device."""
    if device is None:
        return device_of(module)
    checked = check_device("device", device)
    if isinstance(module, torch.nn.Module):
        module.to(checked)
    return checked


def copied_at_once(tensordict: TensorDictBase, device: torch.device) -> TensorDict:
    """Copy the tensors of a flat tensordict from the CPU to a device in one asynchronous transfer."""
    arrays = {key: value.numpy() for key, value in tensordict.items()}
    ends = list(accumulate(-(-array.nbytes // _ALIGNED) * _ALIGNED for array in arrays.values()))
    buffer = torch.empty(ends[-1], dtype=torch.uint8, pin_memory=device.type == "cuda")
    raw, begins = buffer.numpy(), [0, *ends]
    for begin, array in zip(begins, arrays.values(), strict=False):
        raw[begin : begin + array.nbytes].view(array.dtype)[:] = array.reshape(-1)
    moved = buffer.to(device, non_blocking=True)
    copies = {
        key: moved[begin : begin + arrays[key].nbytes].view(value.dtype).view(value.shape)
        for begin, (key, value) in zip(begins, tensordict.items(), strict=False)
    }
    return TensorDict(copies, tensordict.batch_size, device=device)


@contextmanager
def seeded(device: torch.device, seed: int) -> Iterator[None]:
    """Seed the default generators of the CPU and of ``device`` inside the block, then restore their states."""
    others = [] if device.type == "cpu" else [device]
    with torch.random.fork_rng(devices=others, device_type=device.type):
        torch.default_generator.manual_seed(seed)
        if others:
            module = torch.get_device_module(device.type)
            generators = getattr(module, "default_generators", None)  # manual_seed only seeds the current device
            (module if generators is None else generators[device.index]).manual_seed(seed)
        yield


def in_blocks(policy: Callable[[TensorDictBase], TensorDictBase]) -> Callable[[TensorDictBase], TensorDictBase]:
    """Return a function that runs ``policy`` on blocks of a fixed size, so that each action depends only on its own row
    of the batch, bit for bit."""
    modules = policy.modules() if isinstance(policy, torch.nn.Module) else [policy]
    size = min(getattr(module, "rows_at_once", BLOCK) for module in modules)

    def run(tensordict: TensorDictBase) -> TensorDictBase:
        n = tensordict.batch_size[0]
        rows = torch.arange(n + -n % size, device=tensordict.device).clamp(max=n - 1)  # the last row fills the block
        padded = tensordict[rows] if n % size else tensordict
        outputs = [policy(block.copy()) for block in (padded.split(size) if n > size else [padded])]
        if not isinstance(outputs[0], TensorDictBase):
            raise TypeError(f"policy must return its input TensorDict, got {type(outputs[0]).__name__}")
        return tensordict.update((torch.cat(outputs) if n > size else outputs[0])[:n])

    return run
