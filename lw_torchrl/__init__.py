"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components."""

from lw_torchrl.data import (
    CoLearningSampler,
    CollectConfig,
    DatasetError,
    Demonstrations,
    JoinedDemonstrations,
    JoinedStorage,
    LanguageWorldExperienceReplay,
    TaskBalancedSampler,
    collect_demonstrations,
)
from lw_torchrl.envs import Engine, EngineStep, ExpertActor, LanguageWorldEnv, QAFTransform, episode_seed
from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, evaluate, plot_success
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans, PlanStep, load_plans, save_plans
from lw_torchrl.language.queries import Clause, Query, QueryError, parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.query_search import QueryMatch, nearest_query
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill, SkillError, load_skills, nearest_skill
from lw_torchrl.language.tasks import (
    MT10,
    MT50,
    TASKS,
    NamedObject,
    Task,
    TaskError,
    load_tasks,
    resolve_tasks,
    task_id,
)
from lw_torchrl.language.text import TextEncoder, encode_texts
from lw_torchrl.modules import (
    DescriptorConditionedActor,
    ObservationFeatures,
    PlanAttention,
    PlanConditionedActor,
    ScriptedSkillActor,
)
from lw_torchrl.record import RerunLogger
from lw_torchrl.trainers import BehavioralCloningConfig, BehavioralCloningTrainer, StackedBehavioralCloning, load_actor

__version__ = "0.1.0"

__all__ = [
    "MT10",
    "MT50",
    "TASKS",
    "BehavioralCloningConfig",
    "BehavioralCloningTrainer",
    "Clause",
    "CoLearningSampler",
    "CollectConfig",
    "ConditionalPlan",
    "DatasetError",
    "Demonstrations",
    "DescriptorConditionedActor",
    "Engine",
    "EngineStep",
    "EpisodeResult",
    "EvaluationResult",
    "ExpertActor",
    "JoinedDemonstrations",
    "JoinedStorage",
    "LanguageWorldEnv",
    "LanguageWorldExperienceReplay",
    "NamedObject",
    "ObservationFeatures",
    "PlanAttention",
    "PlanConditionedActor",
    "PlanError",
    "PlanStep",
    "Plans",
    "QAFTransform",
    "Query",
    "QueryError",
    "QueryMatch",
    "QueryProgram",
    "RerunLogger",
    "ScriptedSkill",
    "ScriptedSkillActor",
    "SkillError",
    "SkillProgram",
    "StackedBehavioralCloning",
    "Task",
    "TaskBalancedSampler",
    "TaskError",
    "TextEncoder",
    "collect_demonstrations",
    "encode_texts",
    "episode_seed",
    "evaluate",
    "load_actor",
    "load_plans",
    "load_skills",
    "load_tasks",
    "nearest_query",
    "nearest_skill",
    "parse_query",
    "plot_success",
    "resolve_tasks",
    "save_plans",
    "supported_queries",
    "task_id",
]
