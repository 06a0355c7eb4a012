"""NamedParts: a sequence of TensorDict modules whose parts are attributes, can be replaced, and read renamed keys."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from tensordict.utils import NestedKey
from torch import nn

from lw_torchrl._keys import as_keys


class NamedParts(TensorDictSequential):
    """A TensorDictSequential of named parts: ``actor.decoder`` is a part, and ``actor.decoder = network`` replaces it.

    New names that are assigned to ``in_keys``, in the same order, are read by all parts.
    """

    def as_part(self, name: str, module: nn.Module) -> TensorDictModuleBase:
        """Return a module as the part ``name``: a plain module reads and writes the keys of the part before it."""
        if isinstance(module, TensorDictModuleBase):
            return module
        before = self.module[name]
        return TensorDictModule(module, in_keys=before.in_keys[:1], out_keys=before.out_keys)

    def __getattr__(self, name: str) -> Any:
        parts = self.__dict__.get("_modules", {}).get("module") or {}
        return parts[name] if name in parts else super().__getattr__(name)

    def __setattr__(self, name: str, value: Any) -> None:
        parts = self.__dict__.get("_modules", {}).get("module") or {}
        if name not in parts:
            super().__setattr__(name, value)
            return
        if not isinstance(value, nn.Module):
            raise TypeError(f"{name} must be a module, got {value!r:.80}")
        parts[name] = self.as_part(name, value)
        self._update_keys()

    @property
    def in_keys(self) -> list[NestedKey]:
        """What is read. New names can be assigned, in the same order."""
        return self._in_keys

    @in_keys.setter
    def in_keys(self, keys: Sequence[NestedKey]) -> None:
        if "module" not in self._modules:  # TensorDictSequential's constructor
            self._in_keys = list(keys)
            return
        renamed = dict(zip(self._in_keys, as_keys("in_keys", keys, list(map(str, self._in_keys))), strict=True))
        for part in self.module.values():
            part.in_keys = [renamed.get(key, key) for key in part.in_keys]
        self._update_keys()

    def _update_keys(self) -> None:
        self._in_keys, out_keys = self._compute_in_and_out_keys(list(self.module.values()))
        self._out_keys = self._out_keys_apparent = self._complete_out_keys = out_keys


def trunk_attributes(trunk: TensorDictSequential) -> dict[str, Any]:
    """Return the ``plans``, ``tasks`` and ``layout`` of a trunk's first part that has them; plans may be None."""
    part = next((part for part in trunk.module.values() if hasattr(part, "layout")), None)
    if part is None:
        raise ValueError("trunk must have a part with a layout: PlanAttention, SkillMixer, TaskLatent or features")
    return {name: getattr(part, name, None) for name in ("plans", "tasks", "layout")}


def encoding_width(trunk: TensorDictSequential) -> int | None:
    """Return D + F, how many numbers the trunk's latent and features are; None if its parts do not state it."""
    latent, features = [*trunk.module.values()][-2:]
    size, width = getattr(latent, "latent_size", None), getattr(features, "width", None)
    return None if size is None or width is None else size + width
