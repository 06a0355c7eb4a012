"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components.

Names are imported when they are first used: ``import lw_torchrl`` loads neither torch nor MuJoCo.
What a first project needs is here. The rest is in the rooms: losses in ``lw.objectives``, for example.
"""

from __future__ import annotations

from importlib import import_module

__version__ = "0.2.0"

# for type checkers and editors, __init__.pyi has the same names
_ROOMS = "data envs evaluation language modules objectives paper planners record training transforms"
_NAMES = {
    "lw_torchrl.data": "CoLearningSampler EpisodeFilter LanguageWorldExperienceReplay TaskBalancedSampler "
    "collect_demonstrations",
    "lw_torchrl.envs": "ExpertActor LanguageWorldEnv",
    "lw_torchrl.evaluation": "EvaluationResult attribute_failures evaluate plot_success",
    "lw_torchrl.language.decoding": "decode_plan",
    "lw_torchrl.language.formats": "PLAN_FORMATS encode_plan",
    "lw_torchrl.language.plan_files": "load_plans save_plans",
    "lw_torchrl.language.plans": "ConditionalPlan PlanError Plans",
    "lw_torchrl.language.queries": "QueryError parse_query supported_queries",
    "lw_torchrl.language.query_program": "QueryProgram",
    "lw_torchrl.language.skills": "load_skills",
    "lw_torchrl.language.tasks": "MT10 MT50 TASKS Task load_tasks task_id",
    "lw_torchrl.modules": "DescriptorConditionedActor HeldEvaluator PlanConditionedActor PlanConditionedQValue "
    "PlanConditionedValue Policy QueryEvaluator ResidualActor ScriptedSkillActor StateQueryEvaluator",
    "lw_torchrl.planners": "FilePlanner OpenAIPlanner plan_prompt",
    "lw_torchrl.record": "RerunLogger log_rollout",
    "lw_torchrl.training": "BehavioralCloningConfig BehavioralCloningTrainer OfflineConfig OfflineTrainer "
    "OnlineConfig OnlineTrainer load_actor save_actor",
    "lw_torchrl.transforms": "CorruptQAF QAFTransform RandomYaw",
}
_MOVED = {  # names that were here in 0.2.0
    "lw_torchrl.data": "Behaviour add_pictures load_pictures",
    "lw_torchrl.evaluation": "evaluate_plans",
    "lw_torchrl.language.decoding": "DecodedPlan DecodedStep",
    "lw_torchrl.language.plans": "PlanStep",
    "lw_torchrl.language.nearest": "nearest_query nearest_skill",
    "lw_torchrl.language.tasks": "resolve_tasks",
    "lw_torchrl.modules": "ActorEnsemble ImageQueryEvaluator plan_actor_value",
    "lw_torchrl.objectives": "AdvantageWeightedLoss DemonstratedSACLoss DemonstratedTD3Loss ExpectileValueLoss "
    "SkillLatentLoss standardize_by_task",
    "lw_torchrl.planners": "Planner PlannerError",
    "lw_torchrl.record": "RolloutRecorder",
    "lw_torchrl.training": "ImageQueryEvaluatorConfig ImageQueryEvaluatorTrainer LabelledQueries QueryEvaluatorConfig "
    "QueryEvaluatorTrainer StackedBehavioralCloning load_evaluator save_evaluator",
    "lw_torchrl.transforms": "CameraTransform EnvState",
}
_ROOM_OF = {name: room for room, names in _NAMES.items() for name in names.split()}

__all__ = sorted(_ROOM_OF)


def __getattr__(name: str) -> object:
    if name in _ROOMS.split():
        return import_module(f"lw_torchrl.{name}")
    if name in _ROOM_OF:
        found = globals()[name] = getattr(import_module(_ROOM_OF[name]), name)
        return found
    for room, names in _MOVED.items():
        if name in names.split():
            place = room.replace("lw_torchrl", "lw", 1)
            raise AttributeError(f"lw.{name} is now {place}.{name} (from {room} import {name})")
    raise AttributeError(f"module 'lw_torchrl' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_ROOMS.split()})
