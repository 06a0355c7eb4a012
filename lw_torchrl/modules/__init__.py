"""Policies as TensorDictModules: plan-conditioned ones, the baselines, and what they are made of."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.modules.actor_ensemble import ActorEnsemble
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor
from lw_torchrl.modules.observation_features import ObservationFeatures
from lw_torchrl.modules.plan_attention import PlanAttention
from lw_torchrl.modules.plan_conditioned_actor import PlanConditionedActor
from lw_torchrl.modules.plan_focus import PlanFocus
from lw_torchrl.modules.policy import METHODS, POLICIES, Method, Policy, make_policy
from lw_torchrl.modules.query_evaluator import EVALUATORS, QueryEvaluator
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor

__all__ = [
    "EVALUATORS",
    "METHODS",
    "POLICIES",
    "ActorEnsemble",
    "DescriptorConditionedActor",
    "Method",
    "ObservationFeatures",
    "PlanAttention",
    "PlanConditionedActor",
    "PlanFocus",
    "Policy",
    "QueryEvaluator",
    "ScriptedSkillActor",
    "make_policy",
]
