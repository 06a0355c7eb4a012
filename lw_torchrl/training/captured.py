"""CapturedFunction: run a training step on a GPU as one CUDA graph."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Iterable
from types import NoneType
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

PACKAGES = ("torch", "torchrl", "tensordict", "lw_torchrl")
"""The packages whose modules can be captured, because the modules do not change Python attributes from step to step."""
_WARM_UP = 2  # number of calls before the capture; the first call creates tables and the optimizer's state


def foreign_code(objects: Iterable[Any]) -> str:
    """Return the name of the first class or function that is defined outside :data:`PACKAGES`, or "".

    The search covers the objects and their submodules.
    """
    for item in objects:
        for part in item.modules() if isinstance(item, nn.Module) else [item]:
            function = getattr(part, "func", None)  # not None for a transform that wraps a function
            codes: list[Any] = [type(part), function if hasattr(function, "__qualname__") else type(function)]
            for code in codes:
                if code is not NoneType and code.__module__.partition(".")[0] not in PACKAGES:
                    return f"{code.__module__}.{code.__qualname__}"
    return ""


def captures(device: torch.device) -> bool:
    """Return whether PyTorch can capture graphs, such as CUDA graphs, on a device."""
    return device.type != "cpu" and hasattr(torch.get_device_module(device), "CUDAGraph")


class CapturedFunction:
    """A function of a minibatch that runs as one CUDA graph on a CUDA device, and without a graph elsewhere.

    A graph repeats the function's kernels on the same memory without running Python, so the function may depend only on
    the minibatch and on tensors. The first two calls run the function without a graph. If the second call waits for the
    device, or if the capture fails, a warning states the reason, and all later calls also run without a graph.

    Args:
        function: a function of a TensorDict on the device, which returns tensors by name.
        device: the device.

    Attributes:
        tries: whether to capture the function; set it to False to run the function without a graph.
        is_captured: whether the function runs as a graph.
    """

    def __init__(self, function: Callable[[Any], dict[str, Tensor]], device: torch.device) -> None:
        self._function, self._device = function, device
        self._module = None if device.type == "cpu" else torch.get_device_module(device)
        self.tries = captures(device)
        self._stream: Any = None
        self.reset()

    def reset(self) -> None:
        """Discard the graph, for example because tensors were replaced; later calls capture the function again."""
        self._kind: Hashable = None
        self._calls, self.is_captured = 0, False
        self._graph: Any = None
        self._inputs: list[tuple[Tensor, Any]] = []
        self._outputs: dict[str, Tensor] = {}

    def __call__(self, minibatch: Any, mode: Hashable = None) -> dict[str, Tensor]:
        """Run the function on a minibatch on the CPU or on the device.

        The graph is discarded if ``mode`` or the keys, shapes or dtypes of the minibatch change.
        """
        if self._module is None:
            return self._function(minibatch)
        if self.tries and isinstance(minibatch, TensorDictBase):
            kind = mode, *((key, each.shape, each.dtype) for key, each in minibatch.items(True, True))
            if kind != self._kind:
                self.reset()
                self._kind, self._stream = kind, self._stream or self._module.Stream(self._device)
            self._calls += 1
            if self._calls > _WARM_UP and not self.is_captured:
                minibatch = _moved(minibatch, self._device)
                self._capture(minibatch)
            if self.is_captured:
                return self._replay(minibatch)
        return self._run(_moved(minibatch, self._device))

    def _replay(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        for own, key in self._inputs:
            own.copy_(_pinned(minibatch.get(key), self._device), non_blocking=True)
        self._graph.replay()
        return {name: value.clone() for name, value in self._outputs.items()}  # the next replay overwrites the values

    def _run(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Run the function; in the last call before the capture, detect operations that wait for the device."""
        assert self._module is not None
        if self._stream is None:
            return self._function(minibatch)
        current = self._module.current_stream(self._device)
        self._stream.wait_stream(current)
        with self._module.stream(self._stream):  # autograd stays on the stream of the first backward pass
            if self.tries and self._calls == _WARM_UP:
                values, wait = _watched(lambda: self._function(minibatch), self._module)
                if wait:
                    self.give_up(f"{wait} waits for the device")
            else:
                values = self._function(minibatch)
        current.wait_stream(self._stream)
        return values

    def _capture(self, minibatch: TensorDictBase) -> None:
        assert self._module is not None
        kept = minibatch.clone()
        graph = self._module.CUDAGraph()
        try:
            with self._module.graph(graph, stream=self._stream):
                self._outputs = self._function(kept.copy())
        except Exception as error:  # PyTorch and CUDA raise several types
            self.give_up(f"CUDA cannot capture the step ({type(error).__name__}: {str(error).partition(chr(10))[0]})")
            return
        self._inputs = [(each, key) for key, each in kept.items(True, True)]
        self._graph, self.is_captured = graph, True

    def give_up(self, reason: str) -> None:
        """Warn with the ``reason``, and run the function without a graph in all later calls."""
        self.tries = False
        warnings.warn(f"training steps run without a CUDA graph, and therefore slower: {reason}", stacklevel=2)


def _watched(call: Callable[[], Any], module: Any) -> tuple[Any, str]:
    """Return the result of a call, and the first source line that waited for the device ("" if none did)."""
    before, places = module.get_sync_debug_mode(), list[str]()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        module.set_sync_debug_mode("warn")
        try:
            result = call()
        finally:
            module.set_sync_debug_mode(before)
    for each in caught:
        if "called a synchronizing" in str(each.message):
            places.append(f"{each.filename}:{each.lineno}")
        elif "Synchronization debug mode" not in str(each.message):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return result, next(iter(places), "")


def _pinned(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor that can be copied to the device without waiting; copy a CPU tensor to pinned memory first."""
    return tensor.pin_memory() if tensor.is_cpu and device.type == "cuda" else tensor


def _moved(minibatch: Any, device: torch.device) -> Any:
    """Copy a minibatch to the device without waiting."""
    if not isinstance(minibatch, TensorDictBase):
        return minibatch.to(device, non_blocking=True)
    if minibatch.device == device:
        return minibatch
    return minibatch.apply(lambda each: _pinned(each, device).to(device, non_blocking=True), device=device)
