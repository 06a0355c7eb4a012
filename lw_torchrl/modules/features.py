"""Feature modules, which turn an observation into normalized inputs of a policy and store the statistics."""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.objectives import add_random_module

from lw_torchrl._util.checks import Scale, check_value, typed
from lw_torchrl._util.devices import check_finite
from lw_torchrl._util.keys import Keys, as_keys, check_apart, dispatched, read, write
from lw_torchrl.language.task_index import as_plans
from lw_torchrl.modules.parts import follow, in_mode_of, probe, written_key

if TYPE_CHECKING:
    from lw_torchrl.language.layout import Layout
    from lw_torchrl.language.plans import AnyPlans

Kind = Literal["raw", "differences", "relative", "opening", "none", "both"]
_FINE, _COARSE = 0.02, 0.1  # metres, the scales at which tanh squashes each difference


class Features(TensorDictModuleBase):
    """Base class for feature modules. A subclass implements :meth:`compute`; noise is added during training.

    Reads ``in_keys``; writes ``features`` (B, F) float32. The noise is drawn from PyTorch's global generator.

    Args:
        noise: standard deviation of the Gaussian noise during training, in units of the normalized features.
        in_keys: the keys to read.
        out_keys: a replacement for the default key ``features``.

    Attributes:
        width: F, the number of features.
    """

    width: int

    @typed
    def __init__(self, noise: Scale, in_keys: Keys, out_keys: Keys | None = None) -> None:
        super().__init__()
        self.noise, self.in_keys, self.out_keys = noise, list(in_keys), as_keys("out_keys", out_keys, ("features",))
        check_apart(self.in_keys, self.out_keys)

    @property
    def observation_key(self) -> NestedKey:
        """The key of the observation."""
        return self.in_keys[0]

    def compute(self, tensordict: TensorDictBase) -> Tensor:
        """Return the features (B, F) without noise."""
        raise NotImplementedError(f"{type(self).__name__} must override compute")

    def fit(self, rows: TensorDictBase, weights: Tensor | None = None) -> None:
        """Compute statistics of R rows, weighted by ``weights`` (R,) float32 with sum 1; do nothing by default."""

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = self.compute(tensordict)
        if self.training and self.noise:
            features = features + self.noise * torch.randn_like(features)
        return write(tensordict, self, [features])


add_random_module(Features)  # each network draws its own noise in losses that vmap over networks


class ObservationFeatures(Features):
    """A module that computes normalized features from the observation only.

    Reads ``observation`` (B, D) float; writes ``features`` (B, F), clipped to 10 standard deviations from the mean.

    Args:
        kind: "raw", the observation; "differences", see :func:`differences`; "relative", see :func:`relative`;
            "opening", only the gripper's opening; "none", no features; "both", the observation and the differences.
        noise: standard deviation of the noise during training, in standard deviations of each feature.
        layout: the layout of the observations; None for Meta-World's.
        in_keys, out_keys: replacements for the default input and output keys; nested keys are allowed.

    Attributes:
        width: F, the number of features.
        mean, std: (F,) float32 buffers, set by :meth:`fit` and saved with the module.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> lw.modules.ObservationFeatures("differences")(observation=torch.rand(5, 39)).shape
        torch.Size([5, 56])
    """

    mean: Tensor
    std: Tensor

    @typed
    def __init__(
        self,
        kind: Kind = "differences",
        noise: Scale = 0.0,
        layout: Layout | None = None,
        *,
        in_keys: Keys | None = None,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__(noise, as_keys("in_keys", in_keys, ("observation",)), out_keys)
        from lw_torchrl.language.layout import METAWORLD, Layout

        self.kind = kind
        self.layout: Layout = METAWORLD if layout is None else check_value("layout", layout, Layout)
        self.width = _KINDS[kind](torch.zeros(self.layout.size, dtype=torch.float32), self.layout).shape[-1]
        self.register_buffer("mean", torch.zeros(self.width, dtype=torch.float32))
        self.register_buffer("std", torch.ones(self.width, dtype=torch.float32))

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        keys = {"in_keys": self.in_keys, "out_keys": self.out_keys_source}
        return {"kind": self.kind, "noise": self.noise, "layout": self.layout, **keys}

    def with_plans(self, plans: AnyPlans) -> ObservationFeatures:
        """Return a module with the same statistics for another set of plans; raise :class:`ValueError` if the features
        have a different meaning in the layout of those plans."""
        layout = as_plans(plans).layout
        if layout == self.layout:
            return self
        if self.kind not in TRANSFERS:
            kinds = " or ".join(map(repr, TRANSFERS))
            raise ValueError(f"features {self.kind!r} do not transfer to {layout.name!r}; use RoleFeatures or {kinds}")
        other = ObservationFeatures(**{**self.config, "layout": layout})
        other.mean, other.std = self.mean, self.std
        return in_mode_of(self, other)

    def _select(self, observation: Tensor) -> Tensor:
        check_observation(observation, self.layout)
        check_finite("observation", observation)
        return _KINDS[self.kind](observation, self.layout)

    @torch.no_grad()
    def fit(self, rows: TensorDictBase, weights: Tensor | None = None) -> None:
        """Compute the mean and standard deviation of the rows; a nearly constant feature is not rescaled."""
        (observation,) = read(rows, self.in_keys)
        features = self._select(observation.reshape(-1, self.layout.size))
        if not features.shape[-1]:
            return  # PyTorch warns about the standard deviation of an empty tensor
        if weights is None:
            mean, std = features.mean(0), features.std(0, unbiased=False)
        else:
            weights = weights.to(features)
            mean = weights @ features
            std = (weights @ (features - mean).square()).sqrt()
        self.mean.copy_(mean)
        self.std.copy_(torch.where(std > 1e-4, std, 1.0))

    def compute(self, tensordict: TensorDictBase) -> Tensor:
        (observation,) = read(tensordict, self.in_keys)
        return ((self._select(observation).to(self.mean.dtype) - self.mean) / self.std).clamp(-10.0, 10.0)


class Concat(TensorDictModuleBase):
    """A module that concatenates the features of several modules.

    Reads the input keys of all modules; writes ``features`` (B, F), in the order of the modules.

    Args:
        parts: :class:`Features`, or TensorDict modules that write a single key or a key named ``features``.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> lw.modules.Concat(lw.modules.ObservationFeatures(), lw.modules.FocusFeatures(plans)).width
        74

    Source: ``torchrl.envs.CatTensors``, as a module.
    """

    def __init__(self, *parts: TensorDictModuleBase, out_keys: Keys | None = None) -> None:
        super().__init__()
        if not parts or not all(isinstance(part, TensorDictModuleBase) for part in parts):
            raise TypeError(f"parts must be one or more TensorDict modules, got {parts!r:.200}")
        self.parts: Any = nn.ModuleList(parts)
        self.out_keys = as_keys("out_keys", out_keys, ("features",))

    @property
    def in_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys(key for part in self.parts for key in part.in_keys))

    @in_keys.setter
    def in_keys(self, keys: Keys) -> None:
        renamed = dict(zip(self.in_keys, as_keys("in_keys", keys, list(map(str, self.in_keys))), strict=True))
        for part in self.parts:
            part.in_keys = [renamed[key] for key in part.in_keys]

    @property
    def width(self) -> int:
        """F, the number of features."""
        return sum(part.width for part in self.parts)

    @property
    def config(self) -> dict[str, Any]:
        """The arguments that reconstruct this module."""
        return {"*parts": list(self.parts), "out_keys": self.out_keys_source}

    def with_plans(self, plans: AnyPlans) -> Concat:
        """Return the same features for another set of plans."""
        parts = [follow(part, plans) for part in self.parts]
        return in_mode_of(self, Concat(*parts, out_keys=self.out_keys_source))

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        features = [part(tensordict.copy()).get(written_key(part)) for part in self.parts]
        return write(tensordict, self, [torch.cat(features, -1)])


def as_features(features: nn.Module | None, layout: Layout, noise: float = 0.0) -> TensorDictModuleBase:
    """Return ``features`` as a TensorDict module. A plain module is wrapped to read ``observation``; None becomes
    :class:`ObservationFeatures` of kind "differences"."""
    if features is None:
        return ObservationFeatures(noise=noise, layout=layout)
    if isinstance(features, TensorDictModuleBase):
        return features
    module: Any = TensorDictModule(features, in_keys=["observation"], out_keys=["features"])
    module.width = probe(features, torch.zeros(1, layout.size, dtype=torch.float32)).shape[-1]
    return module


def check_observation(observation: Tensor, layout: Layout) -> None:
    """Raise a :class:`ValueError` unless observations are floats of shape (..., D), where D is the layout's size."""
    if observation.shape[-1:] != (layout.size,) or not observation.is_floating_point():
        got = f"{observation.dtype} of shape {tuple(observation.shape)}"
        raise ValueError(f"observation must be float32 of shape (..., {layout.size}), got {got}")


def relative(observation: Tensor, layout: Layout) -> Tensor:
    """Return the differences between the positions of hand, objects and goal, (..., 54) for Meta-World: in metres, and
    squashed by tanh at scales of 2 cm and 10 cm. Differences to an absent object are 0."""
    positions = [observation[..., place] for place in layout.positions]
    # An all-zero position marks an absent object; only objects after the first can be absent.
    absent = {n: (positions[n] == 0).all(-1, keepdim=True) for n in range(2, len(positions) - 1)}
    pairs = []
    for first, second in combinations(range(len(positions)), 2):
        difference = positions[second] - positions[first]
        for number in {first, second} & absent.keys():
            difference = torch.where(absent[number], 0.0, difference)
        pairs.append(difference)
    metres = torch.cat(pairs, -1)
    return torch.cat((metres, *squash(metres)), -1)


def differences(observation: Tensor, layout: Layout) -> Tensor:
    """Return :func:`relative` with the hand's height and the gripper's opening appended: (..., 39) gives (..., 56)."""
    height, opening = (observation[..., at : at + 1] for at in (layout.hand + 2, layout.opening))
    return torch.cat((relative(observation, layout), height, opening), -1)


def squash(difference: Tensor) -> tuple[Tensor, Tensor]:
    """Squash differences in metres with tanh at two scales: 2 cm for alignment and 10 cm for direction."""
    return torch.tanh(difference / _FINE), torch.tanh(difference / _COARSE)


_KINDS: dict[str, Callable[[Tensor, Layout], Tensor]] = {
    "raw": lambda observation, layout: observation,
    "differences": differences,
    "relative": relative,
    "opening": lambda observation, layout: observation[..., layout.opening : layout.opening + 1],
    "none": lambda observation, layout: observation[..., :0],
    "both": lambda observation, layout: torch.cat((observation, differences(observation, layout)), -1),
}
TRANSFERS = ("opening", "none")
"""The kinds of :class:`ObservationFeatures` that have the same meaning in every layout."""
