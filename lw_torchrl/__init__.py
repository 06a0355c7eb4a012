"""Language-World and Plan Conditioned Behavioral Cloning as TorchRL components."""

# First, since where TorchRL loads MuJoCo it names a rendering library that is absent.
import lw_torchrl.envs  # noqa: F401
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
from lw_torchrl.envs import Engine, EngineStep, ExpertActor, LanguageWorldEnv, episode_seed
from lw_torchrl.evaluation import (
    EpisodeResult,
    Estimate,
    EvaluationResult,
    Summary,
    TaskSummary,
    count_solved,
    evaluate,
    interquartile_mean,
    mean_difference,
    mean_rate,
    plot_sorted_tasks,
    plot_success,
    probability_of_improvement,
    published,
    published_curves,
    published_plans,
    summarize,
    summarize_rates,
)
from lw_torchrl.language.plan_files import load_plans, save_plans
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans, PlanStep
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
    ActorEnsemble,
    DescriptorConditionedActor,
    ObservationFeatures,
    PlanAttention,
    PlanConditionedActor,
    ScriptedSkillActor,
)
from lw_torchrl.record import RerunLogger
from lw_torchrl.trainers import BehavioralCloningConfig, BehavioralCloningTrainer, StackedBehavioralCloning, load_actor
from lw_torchrl.transforms import EnvState, QAFTransform, RandomYaw

__version__ = "0.1.0"

__all__ = [
    "MT10",
    "MT50",
    "TASKS",
    "ActorEnsemble",
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
    "EnvState",
    "EpisodeResult",
    "Estimate",
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
    "RandomYaw",
    "RerunLogger",
    "ScriptedSkill",
    "ScriptedSkillActor",
    "SkillError",
    "SkillProgram",
    "StackedBehavioralCloning",
    "Summary",
    "Task",
    "TaskBalancedSampler",
    "TaskError",
    "TaskSummary",
    "TextEncoder",
    "collect_demonstrations",
    "count_solved",
    "encode_texts",
    "episode_seed",
    "evaluate",
    "interquartile_mean",
    "load_actor",
    "load_plans",
    "load_skills",
    "load_tasks",
    "mean_difference",
    "mean_rate",
    "nearest_query",
    "nearest_skill",
    "parse_query",
    "plot_sorted_tasks",
    "plot_success",
    "probability_of_improvement",
    "published",
    "published_curves",
    "published_plans",
    "resolve_tasks",
    "save_plans",
    "summarize",
    "summarize_rates",
    "supported_queries",
    "task_id",
]
