"""A device of kind "pretend", whose tensors compute on the CPU, and which records every wait that a GPU would cause.

Its graphs record operations without executing them, and repeat them on the same tensors, as CUDA graphs do. Use it in a
separate process: PyTorch can register one such device, and never removes it.
"""

import traceback
import warnings
from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import torch
from torch.utils import _pytree as pytree
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

from lw_torchrl._util import devices

aten = torch.ops.aten
READS = {aten._local_scalar_dense, aten.equal, aten.nonzero, aten.masked_select, aten._unique2, aten.bincount}
PACKAGE = str(Path(devices.__file__).parents[1])


class Graph:
    """A record of operations on raw tensors."""

    recording = None  # the graph that records now

    def __init__(self):
        self.operations, self.before = [], {}

    def record(self, func, args, kwargs, found, draws, on):
        """Record an operation. A number in a tensor on the CPU becomes a constant, as in a CUDA graph."""
        ours = {id(one.raw) for one in on}
        fixed = lambda one: one if id(one) in ours or not isinstance(one, torch.Tensor) else one.clone()  # noqa: E731
        args, kwargs = pytree.tree_map(fixed, (args, kwargs))
        self.operations.append((func, args, kwargs, found, draws))

    def keep(self, func, args, kwargs):
        """Keep the tensors that an operation writes, since a capture executes nothing."""
        for number, argument in enumerate(func._schema.arguments):
            if argument.alias_info is not None and argument.alias_info.is_write:
                for one in pytree.tree_leaves(args[number] if number < len(args) else kwargs.get(argument.name)):
                    self.before.setdefault(id(one), (one, one.clone()))

    def replay(self):
        assert Graph.recording is None
        for func, args, kwargs, found, draws in self.operations:
            again = _drawn(func, args, kwargs) if draws else func(*args, **kwargs)
            inputs = {one.untyped_storage().data_ptr() for one in _tensors((args, kwargs))}
            for old, new in zip(_tensors(found), _tensors(again), strict=True):
                if old.untyped_storage().data_ptr() not in inputs:
                    old.copy_(new)


def _tensors(values):
    return [one for one in pytree.tree_leaves(values) if isinstance(one, torch.Tensor)]


class Module(_DummyBackendModule):
    """``torch.pretend``, with a generator of its own."""

    state = torch.Generator().get_state()
    mode = "default"
    CUDAGraph = Graph

    def synchronize(self, device=None) -> None:
        _wait("synchronize")

    def set_sync_debug_mode(self, mode) -> None:
        self.mode = mode

    def get_sync_debug_mode(self):
        return self.mode

    def Stream(self, device=None):
        return SimpleNamespace(wait_stream=lambda other: None)

    current_stream = Stream

    def stream(self, stream):
        return nullcontext()

    @contextmanager
    def graph(self, graph, stream=None):
        state, Graph.recording = self.state, graph
        try:
            yield
        finally:
            self.state, Graph.recording = state, None
            for one, before in graph.before.values():
                if one.shape == before.shape:  # otherwise it is the output of an operation, which resized it
                    one.copy_(before)
            graph.before.clear()

    def get_rng_state(self, device=None):
        return self.state

    def set_rng_state(self, state, device=None) -> None:
        self.state = state

    def manual_seed(self, seed) -> None:
        self.state = torch.Generator().manual_seed(seed).get_state()

    manual_seed_all = manual_seed


MODULE = Module()
_setup_privateuseone_for_python_backend("pretend", MODULE)
devices._ASSERTING.add("pretend")
PRETEND = torch.device("pretend:0")
WAITS: list[str] = []  # operations that waited, and where in the package
COPIES: list[torch.Size] = []  # shapes of copies to the device without waiting


class PretendTensor(torch.Tensor):
    """A tensor that claims to be on the device, around one on the CPU."""

    @staticmethod
    def __new__(cls, raw):
        return torch.Tensor._make_wrapper_subclass(
            cls, raw.shape, strides=raw.stride(), dtype=raw.dtype, device=PRETEND, storage_offset=raw.storage_offset()
        )

    def __init__(self, raw):
        self.raw = raw

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _run(func, args, kwargs or {})


def _here() -> str:
    ours = [frame for frame in traceback.extract_stack() if frame.filename.startswith(PACKAGE)]
    return f"{ours[-1].filename}:{ours[-1].lineno}" if ours else "elsewhere"


def _wait(text: str) -> None:
    if Graph.recording is not None:
        raise RuntimeError(f"operation not permitted when stream is capturing: {text}")
    WAITS.append(text)
    if MODULE.mode == "warn":
        warnings.warn(f"called a synchronizing operation: {text}", stacklevel=2)


def _note(func, flat, kwargs, there) -> None:
    """Record what would wait for a GPU; raise for what a GPU would refuse."""
    packet = func.overloadpacket
    on = [one for one in flat if isinstance(one, PretendTensor)]
    off = [one for one in flat if isinstance(one, torch.Tensor) and not isinstance(one, PretendTensor) and one.dim()]
    if packet in (aten._to_copy, aten.copy_):
        source = flat[1] if packet is aten.copy_ else flat[0]
        over = isinstance(source, PretendTensor) != there if packet is aten._to_copy else bool(off and on)
        waited = kwargs.get("non_blocking") or (packet is aten.copy_ and len(flat) > 2 and flat[2] is True)
        if over and there and waited and Graph.recording is None:
            COPIES.append(source.shape)
        elif over:
            _wait(f"{func} at {_here()}")
        return
    masks = packet in (aten.index, aten.index_put, aten.index_put_) and any(one.dtype == torch.bool for one in on[1:])
    if on and (packet in READS or masks):
        _wait(f"{func} at {_here()}")
    if on and off:
        # A GPU accepts only indices on the CPU into a tensor on the GPU.
        by_index = packet in (aten.index, aten.index_put, aten.index_put_) and isinstance(flat[0], PretendTensor)
        if not by_index:
            raise RuntimeError(f"{func}: expected all tensors to be on the same device, at {_here()}")
        _wait(f"{func} of the CPU's indices at {_here()}")
    if there and kwargs.get("generator") is not None:
        raise RuntimeError("expected a 'pretend' device type for generator but found 'cpu'")


def _drawn(func, args, kwargs):
    """Run an operation with the device's generator."""
    before = torch.get_rng_state()
    torch.set_rng_state(MODULE.state)
    found = func(*args, **kwargs)
    MODULE.state = torch.get_rng_state()
    torch.set_rng_state(before)
    return found


def _run(func, args, kwargs):
    flat = pytree.tree_leaves((args, kwargs))
    device = kwargs.get("device")
    on = any(isinstance(one, PretendTensor) for one in flat)
    there = on if device is None else torch.device(device).type == "pretend"
    if not on and not there:
        return func(*args, **kwargs)
    _note(func, flat, kwargs, there)
    own = lambda one: one.raw if isinstance(one, PretendTensor) else one  # noqa: E731
    raw_args, raw_kwargs = pytree.tree_map(own, (args, kwargs))
    if device is not None:
        raw_kwargs["device"] = torch.device("cpu")
    draws = there and torch.Tag.nondeterministic_seeded in func.tags
    if Graph.recording is not None and func._schema.is_mutable:
        Graph.recording.keep(func, raw_args, raw_kwargs)
    found = _drawn(func, raw_args, raw_kwargs) if draws else func(*raw_args, **raw_kwargs)
    if Graph.recording is not None:
        ours = [one for one in flat if isinstance(one, PretendTensor)]
        Graph.recording.record(func, raw_args, raw_kwargs, found, draws, ours)
    if not there or func.overloadpacket is aten._local_scalar_dense:
        return found
    if func.overloadpacket is aten._to_copy and not on and found is raw_args[0]:
        found = found.clone()
    same = {id(one.raw): one for one in flat if isinstance(one, PretendTensor)} if func._schema.is_mutable else {}
    wrap = lambda one: same.get(id(one), PretendTensor(one)) if isinstance(one, torch.Tensor) else one  # noqa: E731
    return pytree.tree_map(wrap, found)


def _empty(size, *, dtype=None, layout=None, device=None, pin_memory=None, memory_format=None):
    return PretendTensor(torch.empty(size, dtype=dtype))


def _empty_strided(size, stride, *, dtype=None, layout=None, device=None, pin_memory=None):
    return PretendTensor(torch.empty_strided(size, stride, dtype=dtype))


def _copy_from(source, here, non_blocking=False):
    """Copy a tensor, for ``torch.tensor(..., device="pretend")``."""
    return _run(aten.copy_.default, (here, source, non_blocking), {})


_LIBRARY = torch.library.Library("aten", "IMPL")
_LIBRARY.impl("empty.memory_format", _empty, "PrivateUse1")
_LIBRARY.impl("empty_strided", _empty_strided, "PrivateUse1")
_LIBRARY.impl("_copy_from", _copy_from, "PrivateUse1")
