"""Policies as TensorDictModules: plan-conditioned ones, the baselines, and what they are made of."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.modules.composed_actors import ActorEnsemble, DemonstratedActor, TransferredActor
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.critics import PlanConditionedQValue, PlanConditionedValue, QValue, Value, plan_actor_value
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor, DescriptorEncoder
from lw_torchrl.modules.image_query_evaluator import IMAGE_ENCODERS, ImageQueryEvaluator
from lw_torchrl.modules.observation_features import ObservationFeatures
from lw_torchrl.modules.plan_attention import PlanAttention
from lw_torchrl.modules.plan_conditioned_actor import PlanConditionedActor
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.policy import Encoder, Encoding, Policy
from lw_torchrl.modules.query_evaluator import EVALUATORS, QueryEvaluator
from lw_torchrl.modules.registry import ENCODERS, METHODS, POLICIES, Method, make_policy
from lw_torchrl.modules.relative_positions import PlanFocus
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor
from lw_torchrl.modules.state_query_evaluator import StateQueryEvaluator

__all__ = [
    "ENCODERS", "EVALUATORS", "IMAGE_ENCODERS", "METHODS", "POLICIES", "ActorEnsemble", "ConditionedActor",
    "DemonstratedActor", "DescriptorConditionedActor", "DescriptorEncoder", "Encoder", "Encoding",
    "ImageQueryEvaluator", "Method", "ObservationFeatures", "PlanAttention", "PlanConditionedActor",
    "PlanConditionedQValue", "PlanConditionedValue", "PlanEncoder", "PlanFocus", "Policy", "QValue", "QueryEvaluator",
    "ScriptedSkillActor", "StateQueryEvaluator", "TransferredActor", "Value", "make_policy",
    "plan_actor_value",
]  # fmt: skip
