"""A ``state_dict`` of any nesting as JSON and tensors, and back: what a training state is kept as."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

_STATE = {torch.optim.AdamW: {"step", "exp_avg", "exp_avg_sq"}, torch.optim.SGD: {"momentum_buffer"}}


def split(state: Any, tensors: dict[str, Tensor]) -> Any:
    """JSON for a nested state, whose tensors go into ``tensors``; :class:`TypeError` for what cannot be saved."""
    if isinstance(state, Tensor):
        name = str(len(tensors))
        tensors[name] = state.detach()
        return {"tensor": name}
    if isinstance(state, TensorDictBase):
        device = None if state.device is None else str(state.device)
        return {"tensordict": [list(state.batch_size), device, split(state.to_dict(), tensors)]}
    if isinstance(state, Mapping):
        return {"dict": [[split(key, tensors), split(value, tensors)] for key, value in state.items()]}
    if isinstance(state, (list, tuple)):
        return {type(state).__name__: [split(value, tensors) for value in state]}
    if state is None or isinstance(state, (bool, int, float, str)):
        return state
    raise TypeError(f"a training state holds {type(state).__name__}, which cannot be saved without pickling")


def join(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The state that :func:`split` took apart; :class:`ValueError` if it cannot have made the tree."""
    if not isinstance(tree, dict):
        if isinstance(tree, list):
            raise ValueError("a list stands where a value was to be")
        return tree
    try:
        ((kind, inside),) = tree.items()
        if kind == "tensor":
            return tensors[inside]
        if kind == "tensordict":
            shape, device, entries = inside
            return TensorDict(join(entries, tensors), shape, device=device)
        if kind == "dict":
            return {join(key, tensors): join(value, tensors) for key, value in inside}
        return {"list": list, "tuple": tuple}[kind](join(value, tensors) for value in inside)
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"it is not as a training state is written ({error})") from error


def check_like(found: Any, live: Any, where: str) -> None:
    """Raise :class:`ValueError` unless ``found`` has the structure, types, dtypes and shapes of ``live``."""
    if isinstance(live, Tensor):
        if not isinstance(found, Tensor) or found.dtype != live.dtype or found.shape != live.shape:
            raise ValueError(f"{where} must be {live.dtype} of shape {tuple(live.shape)}, got {_said(found)}")
    elif isinstance(live, Mapping):
        if not isinstance(found, Mapping) or set(found) != set(live):
            raise ValueError(f"{where} must have the keys {sorted(map(str, live))}, got {_said(found)}")
        for key, value in live.items():
            check_like(found[key], value, f"{where}[{key!r}]")
    elif isinstance(live, (list, tuple)):
        if type(found) is not type(live) or len(found) != len(live):
            raise ValueError(f"{where} must be a {type(live).__name__} of {len(live)}, got {_said(found)}")
        for number, (one, other) in enumerate(zip(found, live, strict=True)):
            check_like(one, other, f"{where}[{number}]")
    elif type(found) is not type(live):
        raise ValueError(f"{where} must be {type(live).__name__}, got {_said(found)}")


def check_optimizer_state(found: Any, optimizer: torch.optim.Optimizer, step: int) -> None:
    """Raise :class:`ValueError` unless ``found`` is a state that the optimizer may have after so many steps."""
    live = optimizer.state_dict()
    if not isinstance(found, dict) or set(found) != set(live) or not isinstance(found["state"], dict):
        raise ValueError(f"optimizer must have the keys {sorted(live)}, got {_said(found)}")
    check_like(found["param_groups"], live["param_groups"], "optimizer['param_groups']")
    for group, own in zip(found["param_groups"], live["param_groups"], strict=True):
        check_same(group, own, "optimizer['param_groups']", {"lr"})
        if not 0 <= group["lr"] <= own["initial_lr"]:
            raise ValueError(f"optimizer['param_groups']: lr must be from 0 to {own['initial_lr']}, got {group['lr']}")
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    names = _STATE[type(optimizer)]
    for number, state in found["state"].items():
        if type(number) is not int or not 0 <= number < len(parameters) or not isinstance(state, dict):
            raise ValueError(f"optimizer['state'] must be of parameters 0 to {len(parameters) - 1}, got {number!r}")
        if state and set(state) != names:
            raise ValueError(f"optimizer['state'][{number}] must have {sorted(names)}, got {_said(state)}")
        for name, value in state.items():
            if value is None:
                continue
            where = f"optimizer['state'][{number}][{name!r}]"
            shape = () if name == "step" else parameters[number].shape
            check_like(value, torch.empty(shape, dtype=torch.float32, device="meta"), where)
            low, high = {"step": (1.0, step), "exp_avg_sq": (0.0, inf)}.get(name, (-inf, inf))
            if not bool((value.isfinite() & (value >= low) & (value <= high)).all()):
                raise ValueError(f"{where} holds what {step} steps cannot give")


def check_same(found: Mapping[str, Any], live: Mapping[str, Any], where: str, but: set[str]) -> None:
    """Raise :class:`ValueError` unless two states of one structure are the same, but for some entries."""
    for name, value in live.items():
        if name not in but and found[name] != value:
            raise ValueError(f"{where}: {name} must be {value!r}, got {_said(found[name])}")


def _said(value: Any) -> str:
    if isinstance(value, Tensor):
        return f"{value.dtype} of shape {tuple(value.shape)}"
    return f"{value!r:.80}"
