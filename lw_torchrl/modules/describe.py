"""Descriptions of modules as JSON: the class and the constructor arguments of each part."""

from __future__ import annotations

import sys
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import Any

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import nn

from lw_torchrl._util.checks import shown, typed
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import TASKS, Task
from lw_torchrl.language.text import TextEncoder

_NETWORKS: dict[type[nn.Module], tuple[str, ...]] = {
    nn.Linear: ("in_features", "out_features"),
    nn.ReLU: (),
    nn.Tanh: (),
    nn.GELU: ("approximate",),
    nn.SiLU: (),
    nn.ELU: ("alpha",),
    nn.Dropout: ("p",),
    nn.LayerNorm: ("normalized_shape", "eps", "elementwise_affine"),
}
"""The PyTorch modules that can be described without ``config``, and the names of their constructor arguments."""
_SEQUENCES: dict[str, Any] = {"TensorDictSequential": TensorDictSequential, "Sequential": nn.Sequential}
_KEYS = ("in_keys", "out_keys")


def describe(module: nn.Module) -> dict[str, Any]:
    """Return a module's description, from which :func:`from_description` rebuilds the module with new random weights.

    The description contains the import path of each part's class, and the constructor arguments from the part's
    attribute ``config``, which may be JSON values, plans, tasks, layouts and other modules.

    Raises:
        TypeError: a part has no ``config``; the message names the part.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.modules.describe(lw.modules.MLPDecoder(width=8))["options"]["width"]
        8
    """
    plans: list[Plans] = []
    node = _encode_module(module, plans, "")
    return {**node, "plans": [each.to_json() for each in plans]}


def _encode_module(module: nn.Module, plans: list[Plans], path: str) -> dict[str, Any]:
    kind = type(module)
    where = path or "the policy"
    if kind in _SEQUENCES.values():
        parts: Any = module.module if kind is TensorDictSequential else module
        named = isinstance(parts, nn.ModuleDict) or [*parts._modules] != [str(n) for n in range(len(parts))]
        children = {name: _encode_module(part, plans, _join(path, name)) for name, part in parts._modules.items()}
        return {"class": kind.__name__, "parts": children if named else [*children.values()]}
    if kind is TensorDictModule:
        wrapped: Any = module
        if wrapped._kwargs is not None or wrapped.method or wrapped.method_kwargs:
            raise TypeError(f"{where} is a TensorDictModule with method= or keyword arguments, which cannot be saved")
        inner = _encode_module(wrapped.module, plans, path)
        keys = {"in_keys": list(wrapped.in_keys), "out_keys": list(wrapped.out_keys_source)}
        return {"class": "TensorDictModule", "options": {"module": {"module": inner}, **keys}}
    if kind in _NETWORKS:
        options: Any = {name: getattr(module, name) for name in _NETWORKS[kind]}
        if kind is nn.Linear:
            options["bias"] = module.bias is not None
        name = f"torch.nn:{kind.__name__}"
    else:
        options = getattr(module, "config", None)
        if not isinstance(options, Mapping):
            raise TypeError(f"{where} cannot be saved: give {kind.__qualname__} an attribute config, its arguments")
        if "plans" not in options and "plans" in signature(getattr(kind, "rebuild", kind)).parameters:
            options = {"plans": module.plans, **options}
        name = kind.__name__ if kind.__module__.startswith("lw_torchrl.") else f"{kind.__module__}:{kind.__qualname__}"
    return {"class": name, "options": {key: _encode(options[key], plans, _join(path, key)) for key in options}}


def _encode(value: Any, plans: list[Plans], path: str) -> Any:
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, (list, tuple, torch.Size, nn.ModuleList)):
        return [_encode(each, plans, f"{path}[{number}]") for number, each in enumerate(value)]
    if isinstance(value, nn.Module):
        return {"module": _encode_module(value, plans, path)}
    if isinstance(value, Plans):
        # Most parts share the same plans, so a description contains each Plans object only once.
        if value not in plans:
            plans.append(value)
        return {"plans": plans.index(value)}
    if isinstance(value, Task):
        return value.name if value == TASKS.get(value.name) else {"task": {"name": value.name, **value.to_json()}}
    if isinstance(value, Layout):
        return {"layout": METAWORLD.name if value == METAWORLD else value.to_json()}
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {"dict": {key: _encode(each, plans, _join(path, key)) for key, each in value.items()}}
    raise TypeError(f"{path} cannot be saved: use a JSON value, Plans, Task, Layout or nn.Module, got {shown(value)}")


def _join(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


@typed
def from_description(
    description: Any, text_encoder: TextEncoder | None = None, parts: Sequence[type[nn.Module]] = ()
) -> Any:
    """Build a module from its description, with new random weights.

    Args:
        description: a result of :func:`describe`.
        text_encoder: passed to parts that encode texts; None for the shipped sentence encoder.
        parts: custom classes. Other classes are found only in Python modules that are already imported: nothing is
            imported, because a description may come from an untrusted file.

    Raises:
        ValueError: a class is unknown. A malformed description can raise any error.
    """
    plans = [Plans.from_json(row) for row in description["plans"]]
    return _Decoder(plans, text_encoder, parts).module(description)


class _Decoder:
    def __init__(self, plans: list[Plans], text_encoder: TextEncoder | None, parts: Sequence[type[nn.Module]]) -> None:
        self.plans, self.text_encoder = plans, text_encoder
        self.custom = {f"{kind.__module__}:{kind.__qualname__}": kind for kind in parts}
        # A class that was defined in a script when it was saved may have moved to a module.
        self.custom |= {f"__main__:{kind.__qualname__}": kind for kind in parts}

    def module(self, node: Any) -> Any:
        name = node["class"]
        if name in _SEQUENCES:
            parts = node["parts"]
            if isinstance(parts, Mapping):
                return _SEQUENCES[name](OrderedDict((key, self.module(part)) for key, part in parts.items()))
            return _SEQUENCES[name](*map(self.module, parts))
        kind = self.find(name)
        options = {key: self.value(value) for key, value in node["options"].items()}
        for key in {*_KEYS} & {*options}:  # JSON has no tuples
            options[key] = [tuple(each) if isinstance(each, list) else each for each in options[key]]
        rebuild: Callable[..., Any] = getattr(kind, "rebuild", kind)
        if "text_encoder" in signature(rebuild).parameters and "text_encoder" not in options:
            options["text_encoder"] = self.text_encoder
        positional = [value for key, values in options.items() if key.startswith("*") for value in values]
        return rebuild(*positional, **{key: value for key, value in options.items() if not key.startswith("*")})

    def find(self, name: str) -> Any:
        """Return the class with this name: from this package, from ``parts``, or from an imported Python module."""
        from lw_torchrl import modules

        place, _, path = name.rpartition(":")
        kind: Any
        hint = ""
        if name == "TensorDictModule":
            kind = TensorDictModule
        elif not place:
            kind = getattr(modules, path, None) if path.isidentifier() else None
        elif place == "torch.nn":
            kind = next((network for network in _NETWORKS if network.__name__ == path), None)
        else:
            kind = self.custom.get(name) or sys.modules.get(place)
            for step in path.split(".") if not isinstance(kind, type) else ():
                kind = getattr(kind, step, None)
            by_import = f"import {place} first (on the command line: --import {place}), or " * (place != "__main__")
            hint = f": {by_import}pass parts=[{path}]"
        if not (isinstance(kind, type) and issubclass(kind, nn.Module)):
            raise ValueError(f"the class {shown(name)} is unknown{hint}")
        return kind

    def value(self, value: Any) -> Any:
        if isinstance(value, list):
            return [self.value(each) for each in value]
        if not isinstance(value, Mapping):
            return value
        ((kind, content),) = value.items()
        if kind == "module":
            return self.module(content)
        if kind == "plans":
            return self.plans[content]
        if kind == "task":
            return Task.from_json(content["name"], {key: each for key, each in content.items() if key != "name"})
        if kind == "layout":
            return METAWORLD if content == METAWORLD.name else Layout.from_json(content)
        if kind == "dict":
            return {key: self.value(each) for key, each in content.items()}
        raise ValueError(f"the description must not contain {shown(value)}, which is no known kind of object")


def same_keys(module: nn.Module, other: nn.Module) -> bool:
    """Return whether two modules read and write the same keys; true for modules without keys."""
    return not isinstance(module, TensorDictModuleBase) or all(
        getattr(module, name) == getattr(other, name) for name in _KEYS
    )
