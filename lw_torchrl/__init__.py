"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components.

Names are imported when they are first used: ``import lw_torchrl`` loads neither torch nor MuJoCo.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the table below, for type checkers and editors
    from lw_torchrl.data import Behaviour as Behaviour
    from lw_torchrl.data import CoLearningSampler as CoLearningSampler
    from lw_torchrl.data import EpisodeFilter as EpisodeFilter
    from lw_torchrl.data import LanguageWorldExperienceReplay as LanguageWorldExperienceReplay
    from lw_torchrl.data import TaskBalancedSampler as TaskBalancedSampler
    from lw_torchrl.data import add_pictures as add_pictures
    from lw_torchrl.data import collect_demonstrations as collect_demonstrations
    from lw_torchrl.data import load_pictures as load_pictures
    from lw_torchrl.envs import ExpertActor as ExpertActor
    from lw_torchrl.envs import LanguageWorldEnv as LanguageWorldEnv
    from lw_torchrl.evaluation import EvaluationResult as EvaluationResult
    from lw_torchrl.evaluation import attribute_failures as attribute_failures
    from lw_torchrl.evaluation import evaluate as evaluate
    from lw_torchrl.evaluation import evaluate_plans as evaluate_plans
    from lw_torchrl.evaluation import plot_success as plot_success
    from lw_torchrl.language.decoding import DecodedPlan as DecodedPlan
    from lw_torchrl.language.decoding import DecodedStep as DecodedStep
    from lw_torchrl.language.decoding import decode_plan as decode_plan
    from lw_torchrl.language.formats import PLAN_FORMATS as PLAN_FORMATS
    from lw_torchrl.language.formats import encode_plan as encode_plan
    from lw_torchrl.language.nearest import nearest_query as nearest_query
    from lw_torchrl.language.nearest import nearest_skill as nearest_skill
    from lw_torchrl.language.plan_files import load_plans as load_plans
    from lw_torchrl.language.plan_files import save_plans as save_plans
    from lw_torchrl.language.plans import ConditionalPlan as ConditionalPlan
    from lw_torchrl.language.plans import PlanError as PlanError
    from lw_torchrl.language.plans import Plans as Plans
    from lw_torchrl.language.plans import PlanStep as PlanStep
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
    from lw_torchrl.language.tasks import resolve_tasks as resolve_tasks
    from lw_torchrl.language.tasks import task_id as task_id
    from lw_torchrl.modules import ActorEnsemble as ActorEnsemble
    from lw_torchrl.modules import DescriptorConditionedActor as DescriptorConditionedActor
    from lw_torchrl.modules import HeldEvaluator as HeldEvaluator
    from lw_torchrl.modules import ImageQueryEvaluator as ImageQueryEvaluator
    from lw_torchrl.modules import PlanConditionedActor as PlanConditionedActor
    from lw_torchrl.modules import PlanConditionedQValue as PlanConditionedQValue
    from lw_torchrl.modules import PlanConditionedValue as PlanConditionedValue
    from lw_torchrl.modules import Policy as Policy
    from lw_torchrl.modules import QueryEvaluator as QueryEvaluator
    from lw_torchrl.modules import ResidualActor as ResidualActor
    from lw_torchrl.modules import ScriptedSkillActor as ScriptedSkillActor
    from lw_torchrl.modules import StateQueryEvaluator as StateQueryEvaluator
    from lw_torchrl.modules import plan_actor_value as plan_actor_value
    from lw_torchrl.objectives import AdvantageWeightedLoss as AdvantageWeightedLoss
    from lw_torchrl.objectives import DemonstratedSACLoss as DemonstratedSACLoss
    from lw_torchrl.objectives import DemonstratedTD3Loss as DemonstratedTD3Loss
    from lw_torchrl.objectives import ExpectileValueLoss as ExpectileValueLoss
    from lw_torchrl.objectives import SkillLatentLoss as SkillLatentLoss
    from lw_torchrl.objectives import standardize_by_task as standardize_by_task
    from lw_torchrl.planners import FilePlanner as FilePlanner
    from lw_torchrl.planners import OpenAIPlanner as OpenAIPlanner
    from lw_torchrl.planners import Planner as Planner
    from lw_torchrl.planners import PlannerError as PlannerError
    from lw_torchrl.planners import plan_prompt as plan_prompt
    from lw_torchrl.record import RerunLogger as RerunLogger
    from lw_torchrl.record import RolloutRecorder as RolloutRecorder
    from lw_torchrl.record import log_rollout as log_rollout
    from lw_torchrl.training import BehavioralCloningConfig as BehavioralCloningConfig
    from lw_torchrl.training import BehavioralCloningTrainer as BehavioralCloningTrainer
    from lw_torchrl.training import ImageQueryEvaluatorConfig as ImageQueryEvaluatorConfig
    from lw_torchrl.training import ImageQueryEvaluatorTrainer as ImageQueryEvaluatorTrainer
    from lw_torchrl.training import LabelledQueries as LabelledQueries
    from lw_torchrl.training import OfflineConfig as OfflineConfig
    from lw_torchrl.training import OfflineTrainer as OfflineTrainer
    from lw_torchrl.training import OnlineConfig as OnlineConfig
    from lw_torchrl.training import OnlineTrainer as OnlineTrainer
    from lw_torchrl.training import QueryEvaluatorConfig as QueryEvaluatorConfig
    from lw_torchrl.training import QueryEvaluatorTrainer as QueryEvaluatorTrainer
    from lw_torchrl.training import StackedBehavioralCloning as StackedBehavioralCloning
    from lw_torchrl.training import load_actor as load_actor
    from lw_torchrl.training import load_evaluator as load_evaluator
    from lw_torchrl.training import save_actor as save_actor
    from lw_torchrl.training import save_evaluator as save_evaluator
    from lw_torchrl.transforms import CameraTransform as CameraTransform
    from lw_torchrl.transforms import CorruptQAF as CorruptQAF
    from lw_torchrl.transforms import EnvState as EnvState
    from lw_torchrl.transforms import QAFTransform as QAFTransform
    from lw_torchrl.transforms import RandomYaw as RandomYaw

__version__ = "0.2.0"

_NAMES = {
    "lw_torchrl.data": "Behaviour CoLearningSampler EpisodeFilter LanguageWorldExperienceReplay TaskBalancedSampler "
    "add_pictures collect_demonstrations load_pictures",
    "lw_torchrl.envs": "ExpertActor LanguageWorldEnv",
    "lw_torchrl.evaluation": "EvaluationResult attribute_failures evaluate evaluate_plans plot_success",
    "lw_torchrl.language.decoding": "DecodedPlan DecodedStep decode_plan",
    "lw_torchrl.language.formats": "PLAN_FORMATS encode_plan",
    "lw_torchrl.language.nearest": "nearest_query nearest_skill",
    "lw_torchrl.language.plan_files": "load_plans save_plans",
    "lw_torchrl.language.plans": "ConditionalPlan PlanError Plans PlanStep",
    "lw_torchrl.language.queries": "QueryError parse_query supported_queries",
    "lw_torchrl.language.query_program": "QueryProgram",
    "lw_torchrl.language.skills": "load_skills",
    "lw_torchrl.language.tasks": "MT10 MT50 TASKS Task load_tasks resolve_tasks task_id",
    "lw_torchrl.modules": "ActorEnsemble DescriptorConditionedActor HeldEvaluator ImageQueryEvaluator "
    "PlanConditionedActor PlanConditionedQValue PlanConditionedValue Policy QueryEvaluator ResidualActor "
    "ScriptedSkillActor StateQueryEvaluator plan_actor_value",
    "lw_torchrl.objectives": "AdvantageWeightedLoss DemonstratedSACLoss DemonstratedTD3Loss ExpectileValueLoss "
    "SkillLatentLoss standardize_by_task",
    "lw_torchrl.planners": "FilePlanner OpenAIPlanner Planner PlannerError plan_prompt",
    "lw_torchrl.record": "RerunLogger RolloutRecorder log_rollout",
    "lw_torchrl.training": "BehavioralCloningConfig BehavioralCloningTrainer ImageQueryEvaluatorConfig "
    "ImageQueryEvaluatorTrainer LabelledQueries OfflineConfig OfflineTrainer OnlineConfig OnlineTrainer "
    "QueryEvaluatorConfig QueryEvaluatorTrainer StackedBehavioralCloning load_actor load_evaluator "
    "save_actor save_evaluator",
    "lw_torchrl.transforms": "CameraTransform CorruptQAF EnvState QAFTransform RandomYaw",
}
_ROOM = {name: room for room, names in _NAMES.items() for name in names.split()}
_PACKAGES = (
    "data",
    "envs",
    "evaluation",
    "paper",
    "language",
    "modules",
    "objectives",
    "planners",
    "record",
    "training",
    "transforms",
)

__all__ = sorted(_ROOM)


def __getattr__(name: str) -> object:
    if name in _PACKAGES:
        return import_module(f"lw_torchrl.{name}")
    if name not in _ROOM:
        raise AttributeError(f"module 'lw_torchrl' has no attribute {name!r}")
    found = globals()[name] = getattr(import_module(_ROOM[name]), name)
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, *_PACKAGES})
