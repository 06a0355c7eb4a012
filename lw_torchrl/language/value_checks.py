"""Checks of tensors' values: at once where Python may look at the numbers, by the device itself where it may not."""

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch._C._functorch import is_batchedtensor, is_functorch_wrapped_tensor
from torch._subclasses.fake_tensor import FakeTensor

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
