"""Policies as TensorDictModules: plan-conditioned, and the baseline on the task's description."""

import lw_torchrl._torchrl  # noqa: F401
from lw_torchrl.modules.actor_ensemble import ActorEnsemble
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor
from lw_torchrl.modules.observation_features import ObservationFeatures
from lw_torchrl.modules.plan_attention import PlanAttention
from lw_torchrl.modules.plan_conditioned_actor import PlanConditionedActor
from lw_torchrl.modules.plan_focus import PlanFocus
from lw_torchrl.modules.scripted_skill_actor import ScriptedSkillActor

__all__ = [
    "ActorEnsemble",
    "DescriptorConditionedActor",
    "ObservationFeatures",
    "PlanAttention",
    "PlanConditionedActor",
    "PlanFocus",
    "ScriptedSkillActor",
]
