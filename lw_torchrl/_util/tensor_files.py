"""Write and read .safetensors files that hold tensors and a JSON description, without pickling."""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping
from contextlib import ExitStack
from math import prod
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from lw_torchrl._util.files import AnyPath, parse_json, replacing
from lw_torchrl._util.reproducibility import package_versions

SUFFIX = ".safetensors"
_METADATA = "lw_torchrl"  # key of the JSON description in the file's metadata
_CHECKSUM = "crc32"
_STATE = "state/"  # name prefix of tensors that belong to the state


def write_tensors(
    path: AnyPath, description: Mapping[str, Any], tensors: Mapping[str, Tensor], state: Any = None
) -> None:
    """Write named tensors with a JSON description, to which the package ``versions`` are added. :func:`pop_state`
    restores ``state``, a nested structure of numbers, strings and tensors."""
    tensors, described = dict(tensors), {"versions": package_versions(), **description}
    if state is not None:
        described["state"] = _split(state, tensors)
    parse_json(_text(described).encode())  # raises for keys that are equal in JSON, such as 1 and "1"
    copies = {name: tensor.detach().cpu().contiguous().clone() for name, tensor in tensors.items()}
    described[_CHECKSUM] = _checksum(described, copies)
    content = save(copies, metadata={_METADATA: _text(described)})
    with replacing(path) as temporary:
        temporary.write_bytes(content)


def read_tensors(path: AnyPath) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Read the description and the tensors from a file; raise a :class:`ValueError` if the file is corrupted or was not
    written by :func:`write_tensors`."""
    if Path(path).is_dir():
        inside = ", ".join(file.name for file in sorted(Path(path).glob(f"*{SUFFIX}"))[:3])
        raise ValueError("the path is a folder" + (f"; use a file in the folder: {inside}" if inside else ""))
    with ExitStack() as stack:  # safe_open opens the file several times, but its errors hide the limit on open files
        for _ in range(3):
            stack.enter_context(Path(path).open("rb"))
    try:
        with safe_open(path, framework="pt") as file:
            description = parse_json((file.metadata() or {})[_METADATA].encode())
            stored = description.pop(_CHECKSUM)
            tensors = {name: file.get_tensor(name).clone() for name in file.keys()}
    except KeyError:
        raise ValueError("the .safetensors file was not written by lw_torchrl") from None
    except SafetensorError as error:
        raise ValueError(f"the file is corrupted or not a .safetensors file: {error}") from error
    if _checksum(description, tensors) != stored:
        raise ValueError("the file is corrupted: checksum mismatch")
    return description, tensors


class AllocationLimit(TorchDispatchMode):
    """A context in which creating more than ``allowed`` bytes of tensors raises a :class:`ValueError`.

    A module that is rebuilt from a file's description must not be much larger than the tensors in the file.
    """

    _FACTORIES = ("empty", "zeros", "ones", "full", "rand", "randn", "arange", "eye", "new_empty", "new_zeros")

    def __init__(self, allowed: int) -> None:
        super().__init__()
        self.allowed = allowed

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func.overloadpacket.__name__ in self._FACTORIES:
            sizes = [size for arg in args for size in (arg if isinstance(arg, (list, tuple)) else (arg,))]
            numbers = prod(size for size in sizes if isinstance(size, int) and size > 0)
            self.allowed -= 4 * numbers
            if self.allowed < 0:
                raise ValueError("the description requires larger tensors than the file holds")
        return func(*args, **kwargs or {})


def _text(description: Mapping[str, Any]) -> str:
    return json.dumps(description, separators=(",", ":"), allow_nan=False)


def _checksum(description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> str:
    """Return the CRC-32 checksum of a description and of the tensors, sorted by name."""
    value = zlib.crc32(_text(description).encode())
    for name in sorted(tensors):
        content = memoryview(tensors[name].reshape(-1).view(torch.uint8).numpy())  # type: ignore[arg-type]
        value = zlib.crc32(content, zlib.crc32(name.encode(), value))
    return f"{value:08x}"


def pop_state(description: dict[str, Any], tensors: dict[str, Tensor]) -> Any:
    """Remove the state from a file's description and tensors, and return the state."""
    try:
        state = _join(description.pop("state"), tensors)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"the file holds no valid state ({type(error).__name__}: {error})") from error
    for name in [name for name in tensors if name.startswith(_STATE)]:
        del tensors[name]
    return state


def _split(state: Any, tensors: dict[str, Tensor]) -> Any:
    """Convert a nested state to JSON, and add the state's tensors to ``tensors``."""
    if isinstance(state, Tensor):
        name = f"{_STATE}{len(tensors)}"
        tensors[name] = state
        return {"tensor": name}
    if isinstance(state, TensorDictBase):
        device = None if state.device is None else str(state.device)
        return {"tensordict": [list(state.batch_size), device, _split(state.to_dict(), tensors)]}
    if isinstance(state, Mapping):  # keys may be numbers, which JSON does not allow
        return {"dict": [[_split(key, tensors), _split(value, tensors)] for key, value in state.items()]}
    if isinstance(state, (list, tuple)):
        return {type(state).__name__: [_split(value, tensors) for value in state]}
    if state is None or isinstance(state, (bool, int, float, str)):
        return state
    raise TypeError(f"state must not contain {type(state).__name__} objects, which cannot be saved without pickling")


def _join(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """Rebuild the state that :func:`_split` took apart."""
    if not isinstance(tree, dict):
        return tree
    ((kind, value),) = tree.items()
    if kind == "tensor":
        return tensors[value]
    if kind == "tensordict":
        shape, device, entries = value
        return TensorDict(_join(entries, tensors), shape, device=device)
    if kind == "dict":
        return {_join(key, tensors): _join(entry, tensors) for key, entry in value}
    return {"list": list, "tuple": tuple}[kind](_join(entry, tensors) for entry in value)
