"""Build the actors of the recipes from the library's parts, and the transforms of the buffers that train them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from inspect import Parameter, signature
from typing import Any

import torch
from tensordict.nn import TensorDictModuleBase, TensorDictSequential
from torch import nn
from torchrl.envs import Compose, Transform

import lw_torchrl as lw
from lw_torchrl.language.plans import Plans
from lw_torchrl.modules import (
    METHODS,
    ActorEnsemble,
    Concat,
    DecidedGripper,
    FocusFeatures,
    MLPDecoder,
    ObservationFeatures,
    RoleFeatures,
    SkillEncoder,
    plans_of,
    transform_of,
)
from lw_torchrl.modules.features import Kind
from lw_torchrl.transforms import JitterTarget, RandomYaw, SwapUnmentioned


@dataclass(frozen=True)
class Parts:
    """The parts of an actor and the augmentations of its buffer, with the names of the keys in recipes.toml."""

    features: Kind = "differences"  # kind of ObservationFeatures
    feature_noise: float = 0.05
    focus: bool = False  # add FocusFeatures
    roles: bool = False  # add RoleFeatures, which implies canonical plans
    canonical: bool = False  # use canonical plans even without RoleFeatures
    fallback: bool = False  # canonical plans end with the steps of the fallback plan
    evaluator: Mapping[str, Any] | None = None  # options of a StateQueryEvaluator before the actor
    encoder_width: int = 128
    encoder_depth: int = 1
    width: int | tuple[int, ...] = 256  # width of the decoder
    depth: int = 3
    squash: bool = True
    decided_gripper: bool = False
    yaw: float = 0.0  # scale of RandomYaw, in radians
    any_yaw: bool = False  # rotate rows by any angle if no active step has a direction
    tilt: float = 0.0  # tilt probability of RandomYaw
    swap_unmentioned: float = 0.0  # probability of SwapUnmentioned
    jitter: float = 0.0  # standard deviation of JitterTarget, in metres

    def describe(self) -> dict[str, Any]:
        """Return the values that differ from the defaults."""
        return {one.name: value for one in fields(self) if (value := getattr(self, one.name)) != one.default}

    def seen(self, plans: Plans) -> Plans:
        """Return the plans that the actor follows."""
        canonical = self.roles or self.canonical or self.fallback
        return lw.canonical_plans(plans, fallback=self.fallback) if canonical else plans

    def actor(self, method: str, plans: Plans) -> TensorDictModuleBase:
        """Return an actor for a method, a name in :data:`METHODS`, and for plans returned by :meth:`seen`."""
        encoder = SkillEncoder(width=self.encoder_width, depth=self.encoder_depth)
        options = {"skill_encoder" if reads_plans(method) else "task_encoder": encoder}
        options["features"] = self._features(plans)
        options["decoder"] = MLPDecoder(width=self.width, depth=self.depth, squash=self.squash)
        actor = METHODS[method](plans, **{name: part for name, part in options.items() if _accepts(method, name)})
        if self.decided_gripper:
            actor = DecidedGripper(actor)
        return actor if self.evaluator is None else TensorDictSequential(self._evaluator(plans), actor)

    def _features(self, plans: Plans) -> nn.Module:
        parts: list[Any] = []
        if self.features != "none":
            parts.append(ObservationFeatures(self.features, self.feature_noise))
        if self.focus:
            parts.append(FocusFeatures(plans, self.feature_noise))
        if self.roles:
            parts.append(RoleFeatures(plans, self.feature_noise))
        return parts[0] if len(parts) == 1 else Concat(*parts)

    def _evaluator(self, plans: Plans) -> TensorDictModuleBase:
        return lw.modules.StateQueryEvaluator(plans, **(self.evaluator or {}))

    def transform(self, actor: TensorDictModuleBase) -> Compose:
        """Return the transforms of the actor's buffer, which answer the conditions and then augment the rows."""
        plans, answers = plans_of(actor), transform_of(actor)
        parts: list[Transform] = [] if answers is None else [answers]
        if self.yaw:
            parts.append(RandomYaw(self.yaw, plans=plans if self.any_yaw or self.tilt else None, tilt=self.tilt))
        if self.swap_unmentioned:
            parts.append(SwapUnmentioned(plans, self.swap_unmentioned))
        if self.jitter:
            parts.append(JitterTarget(plans, self.jitter))
        return Compose(*parts)


@cache
def reads_plans(method: str) -> bool:
    """Return whether a method's actors follow plans."""
    with torch.random.fork_rng(devices=[]):
        return plans_of(METHODS[method](lw.Plans([lw.load_plans("MT10")["reach"]]))) is not None


def _accepts(method: str, option: str) -> bool:
    known = signature(METHODS[method]).parameters
    return option in known or any(one.kind is Parameter.VAR_KEYWORD for one in known.values())


def ensemble(actors: Sequence[TensorDictModuleBase]) -> TensorDictModuleBase | None:
    """Combine actors into one policy; return None for no actors. If members have a binary gripper, the majority decides
    whether it closes."""
    if len(actors) <= 1:
        return actors[0] if actors else None
    policy = ActorEnsemble(actors)
    return DecidedGripper(policy, 0.0) if any(isinstance(one, DecidedGripper) for one in actors) else policy
