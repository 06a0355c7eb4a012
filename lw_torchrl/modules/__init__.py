"""Policies as TensorDict modules, and their reusable parts: attention, mixers, features, decoders and critics."""

import lw_torchrl._util.keys  # noqa: F401
from lw_torchrl.modules.attention import PlanAttention, attend
from lw_torchrl.modules.critics import PlanConditionedQValue, PlanConditionedValue, QValue, Value
from lw_torchrl.modules.decoder import Decode, GaussianDecoder, MLPDecoder
from lw_torchrl.modules.describe import describe, from_description
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor, TaskLatent, descriptor_trunk
from lw_torchrl.modules.features import Concat, Features, ObservationFeatures
from lw_torchrl.modules.image_query_evaluator import IMAGE_ENCODERS, ImageQueryEvaluator
from lw_torchrl.modules.mixer import SkillEncoder, SkillMixer
from lw_torchrl.modules.plan_conditioned_actor import (
    ConditionedActor,
    PlanConditionedActor,
    StochasticActor,
    plan_trunk,
)
from lw_torchrl.modules.policy import METHODS, layout_of, make_policy, plans_of, tasks_of, transform_of, with_plans
from lw_torchrl.modules.query_evaluator import QueryEvaluator, StateQueryEvaluator
from lw_torchrl.modules.relative_features import FocusFeatures, RoleFeatures
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.modules.wrappers import ActorEnsemble, DecidedGripper, DemonstratedActor, TransferredActor

__all__ = [
    "IMAGE_ENCODERS", "METHODS", "ActorEnsemble", "Concat", "ConditionedActor", "DecidedGripper",
    "Decode", "DemonstratedActor", "DescriptorConditionedActor", "Features", "FocusFeatures", "GaussianDecoder",
    "ImageQueryEvaluator", "MLPDecoder", "ObservationFeatures", "PlanAttention", "PlanConditionedActor",
    "PlanConditionedQValue", "PlanConditionedValue", "QValue", "QueryEvaluator", "RoleFeatures", "ScriptedSkillActor",
    "SkillEncoder", "SkillMixer", "StateQueryEvaluator", "StochasticActor", "TaskLatent", "TransferredActor", "Value",
    "attend", "describe", "descriptor_trunk", "from_description", "layout_of", "make_policy", "plan_trunk", "plans_of",
    "tasks_of", "transform_of", "with_plans",
]  # fmt: skip
