"""Keys of tensordicts as arguments."""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor

from lw_torchrl._checks import missing_keys


def as_keys(argument: str, given: Sequence[NestedKey] | None, default: Sequence[str]) -> list[NestedKey]:
    """The keys ``given``, as many as the default ones and in their order; None for those.

    Raises:
        ValueError: another number of keys, the same twice, or what is no key.

    Example:
        >>> as_keys("in_keys", [("agent", "observation"), "task"], ("observation", "task_id"))
        [('agent', 'observation'), 'task']
    """
    if given is None:
        return list(default)
    error = ValueError(
        f"{argument} must be a list of {len(default)}, in this order: {', '.join(default)}; got {given!r}"
    )
    if isinstance(given, str) or not isinstance(given, Sequence) or len(given) != len(default):
        raise error
    try:  # a list is a nested key too: JSON has no tuples
        keys = [unravel_key(tuple(key) if isinstance(key, list) else key) for key in given]
    except Exception as cause:
        raise error from cause
    if len(set(keys)) != len(keys):
        raise error
    return keys


def check_apart(in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]) -> None:
    """Raise :class:`ValueError` if a module would write over what it reads."""
    if both := [key for key in out_keys if key in in_keys]:
        raise ValueError(f"out_keys must not be among in_keys, {list(in_keys)}: {both} would be written over")


def key_beside(key: NestedKey, ending: str) -> NestedKey:
    """The key beside ``key`` whose name has an ending more.

    Example:
        >>> key_beside(("agent", "qaf"), "_plan")
        ('agent', 'qaf_plan')
    """
    return key + ending if isinstance(key, str) else (*key[:-1], key[-1] + ending)


def read(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> list[Tensor]:
    """The tensors of ``keys``; :class:`ValueError` names those that are missing."""
    found = [tensordict.get(key, None) for key in keys]
    if any(one is None for one in found):
        raise missing_keys(tensordict.keys(True, True), *map(str, keys))
    return found
