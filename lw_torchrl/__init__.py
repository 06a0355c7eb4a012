"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components.

Names are imported when they are first used: ``import lw_torchrl`` loads neither torch nor MuJoCo.
What a first project needs is here. The rest is in the rooms: losses in ``lw.objectives``, for example.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the tables below, for type checkers and editors
    from lw_torchrl import data as data
    from lw_torchrl import envs as envs
    from lw_torchrl import evaluation as evaluation
    from lw_torchrl import language as language
    from lw_torchrl import modules as modules
    from lw_torchrl import objectives as objectives
    from lw_torchrl import paper as paper
    from lw_torchrl import planners as planners
    from lw_torchrl import record as record
    from lw_torchrl import training as training
    from lw_torchrl import transforms as transforms
    from lw_torchrl.data import CoLearningSampler as CoLearningSampler
    from lw_torchrl.data import EpisodeFilter as EpisodeFilter
    from lw_torchrl.data import LanguageWorldExperienceReplay as LanguageWorldExperienceReplay
    from lw_torchrl.data import TaskBalancedSampler as TaskBalancedSampler
    from lw_torchrl.data import collect_demonstrations as collect_demonstrations
    from lw_torchrl.envs import ExpertActor as ExpertActor
    from lw_torchrl.envs import LanguageWorldEnv as LanguageWorldEnv
    from lw_torchrl.evaluation import EvaluationResult as EvaluationResult
    from lw_torchrl.evaluation import attribute_failures as attribute_failures
    from lw_torchrl.evaluation import evaluate as evaluate
    from lw_torchrl.evaluation import plot_success as plot_success
    from lw_torchrl.language.decoding import decode_plan as decode_plan
    from lw_torchrl.language.formats import PLAN_FORMATS as PLAN_FORMATS
    from lw_torchrl.language.formats import encode_plan as encode_plan
    from lw_torchrl.language.plan_files import load_plans as load_plans
    from lw_torchrl.language.plan_files import save_plans as save_plans
    from lw_torchrl.language.plans import ConditionalPlan as ConditionalPlan
    from lw_torchrl.language.plans import PlanError as PlanError
    from lw_torchrl.language.plans import Plans as Plans
    from lw_torchrl.language.queries import QueryError as QueryError
    from lw_torchrl.language.queries import parse_query as parse_query
    from lw_torchrl.language.queries import supported_queries as supported_queries
    from lw_torchrl.language.query_program import QueryProgram as QueryProgram
    from lw_torchrl.language.skills import load_skills as load_skills
    from lw_torchrl.language.tasks import MT10 as MT10
    from lw_torchrl.language.tasks import MT50 as MT50
    from lw_torchrl.language.tasks import TASKS as TASKS
    from lw_torchrl.language.tasks import Task as Task
    from lw_torchrl.language.tasks import load_tasks as load_tasks
    from lw_torchrl.language.tasks import task_id as task_id
    from lw_torchrl.modules import DescriptorConditionedActor as DescriptorConditionedActor
    from lw_torchrl.modules import HeldEvaluator as HeldEvaluator
    from lw_torchrl.modules import PlanConditionedActor as PlanConditionedActor
    from lw_torchrl.modules import PlanConditionedQValue as PlanConditionedQValue
    from lw_torchrl.modules import PlanConditionedValue as PlanConditionedValue
    from lw_torchrl.modules import Policy as Policy
    from lw_torchrl.modules import QueryEvaluator as QueryEvaluator
    from lw_torchrl.modules import ResidualActor as ResidualActor
    from lw_torchrl.modules import ScriptedSkillActor as ScriptedSkillActor
    from lw_torchrl.modules import StateQueryEvaluator as StateQueryEvaluator
    from lw_torchrl.planners import FilePlanner as FilePlanner
    from lw_torchrl.planners import OpenAIPlanner as OpenAIPlanner
    from lw_torchrl.planners import plan_prompt as plan_prompt
    from lw_torchrl.record import RerunLogger as RerunLogger
    from lw_torchrl.record import log_rollout as log_rollout
    from lw_torchrl.training import BehavioralCloningConfig as BehavioralCloningConfig
    from lw_torchrl.training import BehavioralCloningTrainer as BehavioralCloningTrainer
    from lw_torchrl.training import OfflineConfig as OfflineConfig
    from lw_torchrl.training import OfflineTrainer as OfflineTrainer
    from lw_torchrl.training import OnlineConfig as OnlineConfig
    from lw_torchrl.training import OnlineTrainer as OnlineTrainer
    from lw_torchrl.training import load_actor as load_actor
    from lw_torchrl.training import save_actor as save_actor
    from lw_torchrl.transforms import CorruptQAF as CorruptQAF
    from lw_torchrl.transforms import QAFTransform as QAFTransform
    from lw_torchrl.transforms import RandomYaw as RandomYaw

__version__ = "0.2.0"

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
