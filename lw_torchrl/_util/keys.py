"""Helpers for arguments that are tensordict keys, and for modules that accept either a tensordict or tensors."""

from collections.abc import Callable, Sequence
from functools import wraps
from inspect import Parameter, Signature
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch, skip_existing
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from lw_torchrl._util.checks import checker, missing_keys
from lw_torchrl._util.rendering import naming_absent_renderer

with naming_absent_renderer():  # here, because every subpackage that uses TorchRL imports this module first
    import torchrl.envs  # noqa: F401

Keys = Sequence[NestedKey]


def _key(value: Any) -> NestedKey | None:
    """Convert a value to a tensordict key, or to None if the value is not a valid key. A list becomes a nested key,
    since JSON has no tuples."""
    value = tuple(value) if isinstance(value, list) else value
    return unravel_key(value) if checker(NestedKey)(value) and value else None


def as_keys(argument: str, value: Sequence[NestedKey] | None, default: Sequence[str]) -> list[NestedKey]:
    """Return the keys in ``value``, which replace the ``default`` keys in order, or ``default`` if ``value`` is None.

    Raises:
        ValueError: ``value`` has a wrong number of keys, a repeated key, or an object that is not a key.
    """
    if value is None:
        return list(default)
    is_list = isinstance(value, Sequence) and not isinstance(value, str)
    keys = [key for item in value if (key := _key(item)) is not None] if is_list else []
    if not is_list or len({*keys}) != len(default) or len(value) != len(default):
        raise ValueError(f"{argument} must be {len(default)} distinct keys, for {', '.join(default)}; got {value!r}")
    return keys


def check_apart(in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]) -> None:
    """Raise a :class:`ValueError` if a module would overwrite its inputs."""
    if both := [key for key in out_keys if key in in_keys]:
        raise ValueError(f"out_keys must differ from in_keys ({list(in_keys)}): {both} would be overwritten")


def key_beside(key: NestedKey, ending: str) -> NestedKey:
    """Return ``key`` with a suffix added to the last name."""
    return key + ending if isinstance(key, str) else (*key[:-1], key[-1] + ending)


def last_name(key: NestedKey) -> str:
    """Return the last name of a key, which may be nested."""
    return key if isinstance(key, str) else key[-1]


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> list[Tensor]:
    """Return the tensors at ``keys``; raise a :class:`ValueError` that names the missing keys."""
    tensors = [tensordict.get(key, None) for key in keys]
    if any(tensor is None for tensor in tensors):
        raise missing_keys(tensordict.keys(True, True), *map(str, keys))
    return tensors


def write(tensordict: TensorDictBase, module: TensorDictModuleBase, values: Sequence[Tensor]) -> TensorDictBase:
    """Write one value to each of the module's output keys. TensorDict's ``select_out_keys`` removes unselected keys
    later."""
    for key, value in zip(module.out_keys_source, values, strict=True):
        tensordict.set(key, value)
    return tensordict


def dispatched(forward: Callable[[Any, TensorDictBase], TensorDictBase]) -> Callable[..., Any]:
    """Decorate a module's ``forward`` to accept a tensordict, or (as ``torch.export`` requires) the tensors of
    ``in_keys`` by position or name. Under ``set_skip_existing(True)``, ``forward`` does not run if all ``out_keys``
    exist."""

    @wraps(forward)
    def run(self: TensorDictModuleBase, tensordict: TensorDictBase) -> TensorDictBase:
        if skip_existing() and all(tensordict.get(key, None) is not None for key in self.out_keys):
            return tensordict
        return forward(self, tensordict)

    # An automatic batch size would include all dimensions of a single tensor (B, F).
    return any_arguments(dispatch(auto_batch_size=False)(run))


def any_arguments(forward: Any) -> Any:
    """Set the signature of a dispatched ``forward`` so that ``torch.export`` can pass the tensors of ``in_keys``."""
    forward.__signature__ = Signature([Parameter("self", Parameter.POSITIONAL_OR_KEYWORD), *_ANY])
    return forward


_ANY = Parameter("args", Parameter.VAR_POSITIONAL), Parameter("kwargs", Parameter.VAR_KEYWORD)


def row_mask(tensordict: TensorDictBase | None, key: str, n: int) -> np.ndarray:
    """Return the row mask (n,) bool with the given key, such as "_reset"; if there is no mask, all rows are True."""
    mask = None if tensordict is None else tensordict.get(key, None)
    if mask is None:
        return np.ones(n, dtype=bool)
    if mask.dtype != torch.bool or mask.numel() != n:
        raise ValueError(f"{key} must be bool of shape ({n},) or ({n}, 1), got {mask.dtype}, {tuple(mask.shape)}")
    return mask.reshape(n).cpu().numpy()
