"""Building blocks of policies: MLPs, parts, and sequences whose named parts can be replaced."""

from __future__ import annotations

import copy
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import torch
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite
from torchrl.modules import MLP as TorchRLMLP

from lw_torchrl._util.checks import Count, check_value
from lw_torchrl._util.keys import Keys, any_arguments, as_keys, check_apart, last_name

if TYPE_CHECKING:
    from lw_torchrl.language.layout import Layout
    from lw_torchrl.language.plans import AnyPlans

Module = TypeVar("Module", bound=nn.Module)
Width = Count | Sequence[Count]

# --- networks ------------------------------------------------------------------------------------------------------


class MLP(TorchRLMLP):
    """TorchRL's MLP with ReLU, applied to the concatenated inputs. A sequence of widths overrides ``depth``."""

    def __init__(self, out_features: int, *, width: Width = 256, depth: int = 3, layer_norm: bool = False) -> None:
        widths = list(width) if isinstance(width, Sequence) else [width] * depth
        super().__init__(
            out_features=out_features,
            num_cells=widths,
            activation_class=nn.ReLU,
            norm_class=nn.LayerNorm if layer_norm else None,
            norm_kwargs=[{"normalized_shape": cells} for cells in widths] if layer_norm else None,
        )
        self.float()  # independent of torch.get_default_dtype()


@torch.no_grad()
def materialize(module: nn.Module, *inputs: Tensor) -> None:
    """Initialize the lazy layers of a module, if any, by a forward pass."""
    if any(isinstance(parameter, nn.parameter.UninitializedParameter) for parameter in module.parameters()):
        with evaluating(module):
            module(*inputs)


@torch.no_grad()
def probe(module: nn.Module, example: Tensor) -> Any:
    """Return a module's output for an example on the module's device, without changing the global random state."""
    weight = next(module.parameters(), None)
    with evaluating(module), torch.random.fork_rng(devices=[]):
        return module(example if weight is None else example.to(weight.device))


@contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """Put a network into eval mode within a ``with`` block; restore the mode of every submodule afterwards."""
    modes = [(module, module.training) for module in network.modules()]
    network.eval()
    try:
        yield
    finally:
        for module, mode in modes:
            module.training = mode


def in_mode_of(own: nn.Module, other: Module) -> Module:
    """Set ``other`` itself, not its submodules, to the train or eval mode of ``own``, and return ``other``."""
    other.training = own.training
    return other


# --- parts ---------------------------------------------------------------------------------------------------------


class Part(TensorDictModuleBase):
    """Base class for policy parts. ``reads`` and ``writes`` are the default input and output keys."""

    _options: ClassVar[Sequence[str]] = ()  # constructor arguments that are also attributes

    def __init__(
        self, reads: Sequence[str], writes: Sequence[str], in_keys: Keys | None, out_keys: Keys | None
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = as_keys("in_keys", in_keys, reads), as_keys("out_keys", out_keys, writes)
        check_apart(self.in_keys, self.out_keys)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        options = {name: getattr(self, name) for name in self._options}
        return {**options, "in_keys": self.in_keys, "out_keys": self.out_keys_source}


class RenamedInputs(TensorDictModuleBase):
    """Base class for modules with assignable ``in_keys``. Assigning keys also renames the keys that the submodules
    read, but not in other modules that share these submodules."""

    @property
    def in_keys(self) -> list[NestedKey]:
        """The keys that the module reads. New keys can be assigned, in the same order."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: Keys) -> None:
        before = self.__dict__.get("_in_keys")
        if before is not None:  # false in the constructor, where the parts already read these keys
            keys = as_keys("in_keys", keys, list(map(str, before)))
            check_apart(keys, self.out_keys_source)
            _rename_parts(self, dict(zip(before, keys, strict=True)), {})
        self._in_keys = list(keys)


# Two policies may share a part, and each policy must keep its own keys. So renaming copies the module objects, but not
# their weights.


def _reading(module: Any, renamed: Mapping[NestedKey, NestedKey], copies: dict[Any, Any], in_order: bool) -> Any:
    """Copy a module; the copy shares the weights but reads renamed keys. ``copies`` holds earlier copies."""
    if not isinstance(module, (TensorDictModuleBase, nn.ModuleDict, nn.ModuleList)):
        return module
    if module not in copies:
        other = copies[module] = copy.copy(module)
        _rename_parts(other, renamed, copies, in_order)
        if isinstance(module, TensorDictModuleBase):
            other.__dict__["_in_keys"] = [renamed.get(key, key) for key in module.in_keys]
    return copies[module]


def _rename_parts(
    module: Any, renamed: Mapping[NestedKey, NestedKey], copies: dict[Any, Any], in_order: bool = False
) -> None:
    """Replace a module's parts with copies that read renamed keys. If the parts run ``in_order``, a key that an
    earlier part writes keeps its name in later parts."""
    in_sequence, remaining, parts = isinstance(module, TensorDictSequential), renamed, {}
    for name, part in module._modules.items():
        parts[name] = _reading(part, remaining, copies, in_sequence)
        if in_order:
            remaining = {key: new for key, new in remaining.items() if key not in getattr(part, "out_keys", ())}
    # ProbabilisticTensorDictSequential also keeps its deterministic part in an attribute, outside of _modules.
    hidden = {name: part for name, part in vars(module).items() if isinstance(part, TensorDictModuleBase)}
    module.__dict__.update({name: _reading(part, renamed, copies, False) for name, part in hidden.items()})
    module.__dict__["_modules"] = parts


class NamedParts(RenamedInputs, TensorDictSequential):
    """A sequence of named parts: ``actor.decoder`` is a part, and ``actor.decoder = network`` replaces this part."""

    @any_arguments
    def forward(self, *args: Any, **kwargs: Any) -> Any:
        return super().forward(*args, **kwargs)

    def as_part(self, name: str, module: nn.Module) -> TensorDictModuleBase:
        """Wrap a module as the part ``name``; a plain module gets the keys of the part that it replaces."""
        before = self.module[name]
        if not isinstance(module, TensorDictModuleBase):
            return TensorDictModule(module, in_keys=before.in_keys[:1], out_keys=before.out_keys)
        if missing := [key for key in before.out_keys_source if key not in module.out_keys_source]:
            raise ValueError(f"{name} must write {before.out_keys_source}, which later parts read; missing: {missing}")
        return module

    def __getattr__(self, name: str) -> Any:
        parts = self.__dict__.get("_modules", {}).get("module") or {}
        return parts[name] if name in parts else super().__getattr__(name)

    def __setattr__(self, name: str, value: Any) -> None:
        parts = self.__dict__.get("_modules", {}).get("module") or {}
        if name not in parts:
            # Otherwise, a misspelt part name would create an unused attribute. Custom subclasses may add modules.
            if parts and isinstance(value, nn.Module) and type(self).__module__.startswith("lw_torchrl."):
                raise AttributeError(f"{type(self).__name__} has no part {name}, only {', '.join(parts)}")
            super().__setattr__(name, value)
            return
        part = self.as_part(name, check_value(name, value, nn.Module))
        check_same_plans({**parts, name: part})
        parts[name] = part
        self.plans, self.tasks, self.layout = trunk_attributes(self)
        self._in_keys, out_keys = self._compute_in_and_out_keys(list(self.module.values()))
        self._out_keys = self._out_keys_apparent = self._complete_out_keys = out_keys

    @property
    def out_keys(self) -> list[NestedKey]:
        """The keys that the sequence writes. To rename them, use the ``out_keys`` of a part or of the constructor."""
        return self._out_keys_apparent

    @out_keys.setter
    def out_keys(self, keys: Keys) -> None:
        if list(keys) != self._complete_out_keys:
            raise ValueError(f"out_keys cannot be assigned; use select_out_keys, or the constructor; got {list(keys)}")
        self._out_keys = self._out_keys_apparent = list(keys)


def action_spec(key: NestedKey, layout: Layout) -> Composite:
    """Return the spec of a layout's actions, (A,) float32 in [-1, 1]."""
    spec = Composite()
    spec[key] = Bounded(-1.0, 1.0, (layout.action_size,), dtype=torch.float32)
    return spec


# --- plans and keys of parts ---------------------------------------------------------------------------------------


def check_same_plans(parts: Mapping[str, nn.Module]) -> None:
    """Raise a :class:`ValueError` unless all parts follow the same plans."""
    followed = [(name, plans) for name, part in parts.items() if (plans := _plans_inside(part)) is not None]
    for name, plans in followed[1:]:
        if plans is not followed[0][1] and plans != followed[0][1]:
            raise ValueError(f"{followed[0][0]} and {name} must follow the same plans; pass the same Plans to both")


def _plans_inside(part: nn.Module) -> Any:
    """Return the plans of a part or of its first submodule with plans; None if no submodule has plans."""
    return next((plans for each in part.modules() if (plans := getattr(each, "plans", None)) is not None), None)


def follow(part: Any, plans: AnyPlans) -> Any:
    """Return a part that follows ``plans`` and shares the networks of ``part``. A part without plans is unchanged.
    Raise a :class:`TypeError` if the part follows plans but has no method ``with_plans``."""
    if hasattr(part, "with_plans"):
        return part.with_plans(plans)
    if isinstance(part, nn.Module) and _plans_inside(part) is None:
        return part
    if type(part) is not TensorDictSequential:
        raise TypeError(f"{type(part).__name__} cannot follow other plans: add a method with_plans(plans)")
    parts = {name: follow(each, plans) for name, each in part.module._modules.items()}
    named = isinstance(part.module, nn.ModuleDict)
    other = TensorDictSequential(OrderedDict(parts)) if named else TensorDictSequential(*parts.values())
    return in_mode_of(part, other)


def _named_parts(trunk: TensorDictSequential) -> list[Any]:
    if not isinstance(trunk.module, nn.ModuleDict) or len(trunk.module) < 2:
        raise ValueError("trunk must have at least two named parts: TensorDictSequential(OrderedDict(mixer=..., ...))")
    return list(trunk.module.values())


def trunk_attributes(trunk: TensorDictSequential) -> tuple[Any, Any, Layout]:
    """Return ``(plans, tasks, layout)`` of a trunk's first part with a layout; missing plans or tasks are None."""
    part = next((part for part in _named_parts(trunk) if hasattr(part, "layout")), None)
    if part is None:
        raise ValueError("trunk must have a part with a layout, such as PlanAttention, SkillMixer or TaskLatent")
    return getattr(part, "plans", None), getattr(part, "tasks", None), part.layout


def encoding_width(trunk: TensorDictSequential) -> int | None:
    """Return D + F, the total size of a trunk's latent and features; None if the parts do not state their sizes."""
    latent, features = _named_parts(trunk)[-2:]
    size, width = getattr(latent, "latent_size", None), getattr(features, "width", None)
    return None if size is None or width is None else size + width


def encoding_keys(trunk: TensorDictSequential) -> list[NestedKey]:
    """Return the keys of a trunk's latent and features, which the last two parts write."""
    return [written_key(part) for part in _named_parts(trunk)[-2:]]


def written_key(part: TensorDictModuleBase) -> NestedKey:
    """Return the key that a part writes; if the part writes several keys, return the key named ``features``."""
    keys: list[NestedKey] = list(part.out_keys_source)
    named = keys if len(keys) == 1 else [key for key in keys if last_name(key) == "features"]
    if len(named) != 1:
        kind = type(part).__name__
        raise ValueError(f"features must write a single key or a key named 'features', but {kind} writes {keys}")
    return named[0]
