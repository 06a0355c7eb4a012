"""The keyword arguments that policies and critics hand on, as type checkers see them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, TypedDict

from tensordict.utils import NestedKey

from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import DistributionName
from lw_torchrl.modules.observation_features import Features
from lw_torchrl.modules.plan_attention import Answers
from lw_torchrl.modules.query_evaluator import QueryEvaluator


class _OfEncoders(TypedDict, total=False):
    features: Features
    latent_size: int
    encoder_width: int
    encoder_depth: int
    text_encoder: TextEncoder | None
    in_keys: Sequence[NestedKey] | None


class _OfPlanEncoders(_OfEncoders, total=False):
    focus: bool
    roles: bool
    canonical: bool | None
    reserve: bool
    jitter: float
    swap_unmentioned: float
    hide_opening: float
    evaluator: QueryEvaluator | None
    answers: Answers
    answer_scale: float


class _OfActors(TypedDict, total=False):
    feature_noise: float | None
    width: int | tuple[int, ...]
    depth: int
    squash: bool
    distribution: DistributionName | None
    init_std: float
    decided_gripper: bool
    action_size: int | None
    out_keys: Sequence[NestedKey] | None


class PlanActorOptions(_OfPlanEncoders, _OfActors, total=False):
    """Of :class:`PlanConditionedActor`, but ``mix``."""


class DescriptorActorOptions(_OfEncoders, _OfActors, total=False):
    """Of :class:`DescriptorConditionedActor`."""

    condition: Literal["description", "one-hot"]


class CriticOptions(TypedDict, total=False):
    """Of :class:`Value`, but ``ensemble``."""

    width: int | Sequence[int]
    depth: int
    layer_norm: bool
    out_keys: Sequence[NestedKey] | None


class PlanValueOptions(_OfPlanEncoders, CriticOptions, total=False):
    """Of :class:`PlanConditionedValue`."""

    ensemble: int
    feature_noise: float


class PlanQValueOptions(PlanValueOptions, total=False):
    """Of :class:`PlanConditionedQValue`."""

    action_key: NestedKey
    quantiles: int
