"""Wrong values of arguments by annotation, and good calls of the public names whose arguments need one another."""

from __future__ import annotations

import math
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch

import lw_torchrl as lw

PLAN = lw.load_plans("MT10")["reach"]
PLANS = [3, "reach", [], {}, {"reach": "a plan"}, {"push": PLAN}, object()]
TASKS = [3, "reech", ["reech"], [], [3], ["reach", "reach"], True]
KEYS = ["observation", 3, [3], [None], ["one", "one"], [], {}]
DEVICE = [3, "gpu", "cuda:99", [], b"cpu"]
WIDTH = ["8", 1.5, -1, 0, (0,), ("8",), True, (8, -1)]
A_CLASS = [3, "one", [], object()]
FUNCTION = [3, "print", [], {}]
MAPPING = [3, "one", ["one"], {"one": 3}, {3: "one"}]
CAMERAS = ["corner9", ["corner", "nose"], 3, [], ["corner", "corner"], [3]]
WRONG: dict[str, list[Any]] = {
    "Plans | Mapping[str, ConditionalPlan]": PLANS,
    "AnyPlans": PLANS,
    "Plans": [3, "reach", [], {}, object()],
    "Mapping[str, ConditionalPlan] | Iterable[ConditionalPlan]": [
        3,
        "reach",
        [],
        {},
        [3],
        {"push": PLAN},
        [PLAN, PLAN],
    ],
    "ConditionalPlan": A_CLASS,
    "Sequence[ConditionalPlan]": [3, "reach", [], [3], object()],
    "str | int | Task": [3.5, b"reach", []],
    "Condition": ["no such", 3, None, []],
    "Callable[[], Mapping[str, float]]": FUNCTION,
    "Sampler | Callable[[], Sampler]": [3, "balanced", []],
    "Transform | Callable[[TensorDictBase], TensorDictBase]": [3, "qaf", []],
    "Literal['rollout'] | Iterable[NestedKey]": ["all"],
    "StepRole": A_CLASS,
    "str | Suite": [3, "mujoco", [], b"fetch"],
    "Callable[[Tensor], Tensor]": [3, "act", []],
    "str | Task": [3, "reech", b"reach", [], 1.5],
    "str | Task | Iterable[str | Task]": TASKS,
    "str | Iterable[str | Task]": TASKS,
    "str | Iterable[str]": TASKS,
    "Sequence[NestedKey]": KEYS,
    "NestedKey": [3, [], {}, 1.5],
    "TextEncoder": FUNCTION,
    "str | torch.device": DEVICE,
    "Features": ["no such", 3, None, []],
    "Answers": ["no such", 3, None, []],
    "DistributionName": ["no such", 3, []],
    "Reduction": ["no such", 3, []],
    "Label": ["no such", 3, None, []],
    "RewardName": ["no such", 3, None, []],
    "Kind": ["no such", 3, None, []],
    "int | tuple[int, ...]": WIDTH,
    "int | Sequence[int]": WIDTH,
    "Mapping[str, ScriptedSkill]": MAPPING,
    "Skills": MAPPING,
    "Skills | Iterable[str]": [3, {"one": 3}, ["no such skill"]],
    "Mapping[str, Task]": [3, "MT10", ["reach"], {"reach": 3}],
    "Tasks": [3, "MT10", ["reach"], {"reach": 3}],
    "Mapping[str, Sequence[int]]": [3, "one", ["one"], {"one": [0]}, {"reach": 0}, {"reach": ["0"]}, {"reach": [99]}],
    "Mapping[str | Task, Sequence[str | Query]]": [3, "one", ["one"], {}, {"reech": []}, {"reach": 3}, {"reach": [3]}],
    "Iterable[str | Query]": [3, [3], ["no query at all"]],
    "Iterable[Task]": [3, "reach", [3], ["reach"]],
    "EpisodeFilter": A_CLASS,
    "EpisodeChoice | Sequence[EpisodeChoice]": [
        "all",
        1.5,
        -1,
        99,
        {"push": 1},
        {"reach": "x"},
        {"reach": [9]},
        [1],
        {},
    ],
    "float | Iterable[float]": ["0.1", -1.0, math.nan, math.inf, [], ["0.1"], [math.nan], None],
    "Callable[[FinishedEpisode], object]": FUNCTION,
    "Callable[[TensorDictBase], Mapping[str, Tensor]]": FUNCTION,
    "Callable[[int, tuple[bool, ...]], object]": FUNCTION,
    "Literal['vectorized', 'metaworld'] | Callable[..., Engine]": [3, "mujoco", None, []],
    "tuple[int, int]": [3, (0,), (2, 1), ("0", 1), (0, 0), "01", (0.5, 2)],
    "tuple[()]": [3, (2,), "x"],
    "AnyPath | Iterable[AnyPath]": [3, None, [], [3], [None], 1.5],
    "str | Behaviour | TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase]": [3, None, "expart", [], {}],
    "str | Sequence[str]": CAMERAS,
    "Sequence[int]": [3, "0", [-1], ["0"], [0.5]],
    "Sequence[str]": ["gripper", 3, [3], ["no such"]],
    "tuple[str, ...]": ["one", 3, [3]],
    "int | tuple[str, ...]": ["one", 1.5, -1, True, [3]],
    "tuple[PlanStep, ...]": [3, [3], "one"],
    "tuple[NamedObject, ...]": [3, [3], "one"],
    "Iterable[FinishedEpisode | TensorDictBase]": [3, "one", [3]],
    "Failure | Sequence[Failure | None]": [3, "one", [3]],
    "str | Sequence[bool] | Tensor": [
        3,
        "reech",
        [],
        ["yes"],
        torch.zeros(3),
        torch.zeros(1, 1, dtype=torch.bool),
        None,
    ],
    "float | Fraction": ["half", -0.1, 1.5, math.nan, None, True],
    "Sequence[TensorDictModuleBase]": [3, "a", [], [3], ["a"]],
    "Sequence[type[nn.Module]]": [3],
    "Sequence[TensorDictReplayBuffer]": [3, "a", [], [3], ["a"]],
    "TensorDictModuleBase | Callable[[TensorDictBase], TensorDictBase]": [None, 3, "expert", []],
    "TensorDictModuleBase | list[TensorDictModuleBase]": [3, "a", [], [3], None],
    "Mapping[str, Any]": [3, "one", ["one"]],
    "ExportFormat": ["no such", 3, None, []],
    "ImportFormat": ["no such", 3, []],
    "str | Mapping[str, str]": [3, "reech", [], {"theirs": "reech"}, {"theirs": 3}],
}
for name in [
    "TensorDictModuleBase",
    "TensorDictModule",
    "TensorDictReplayBuffer",
    "LanguageWorldExperienceReplay",
    "BehavioralCloningConfig",
    "OfflineConfig",
    "QueryEvaluatorConfig",
    "Logger",
    "Sampler",
    "Transform",
    "QueryEvaluator",
    "ClauseEvaluator",
    "LabelledQueries",
    "LossModule",
    "nn.Module",
    "TensorDictSequential",
    "QValue",
    "RerunLogger",
    "TensorDictBase",
    "EvaluationResult",
    "Query",
    "Layout",
    "Suite",
    "Task",
    "Tensor",
]:
    WRONG[name] = A_CLASS
OF_ONE_NAME: dict[str, list[Any]] = {
    "ImageQueryEvaluator.names": ["gripper", 3, [3]],  # those that a plan speaks of must be there
    "resolve_tasks.tasks": [3, "MT10", ["reach"]],
    "OfflineTrainer.loss": A_CLASS,
    "evaluate.engine": [3, "mujoco", []],
    "attribute_failures.engine": [3, "mujoco", []],
    "evaluate.evaluator": FUNCTION,
    "attribute_failures.evaluator": FUNCTION,
    "attribute_failures.actor": FUNCTION,
    "evaluate.also_record": ["observation", 3, [3], [None]],
    "QueryEvaluatorConfig.held_out_tasks": ["one", 1.5, -1, True, [3]],
}


def good_calls(folder: Any) -> dict[str, dict[str, Any]]:
    """Arguments with which a public name can be called; a wrong value takes the place of one."""
    plans = lw.Plans({"reach": PLAN})
    demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=folder / "demos", max_steps=3, progress=False)
    root = demos.root
    replay = lw.LanguageWorldExperienceReplay(root, batch_size=2, transform=lw.QAFTransform(plans))
    executed = lw.LanguageWorldExperienceReplay(
        root,
        batch_size=2,
        label="executed",
        terminate_on_success=True,
        transform=lw.QAFTransform(plans),
    )
    actor = lw.PlanConditionedActor(plans)
    expert = lw.ExpertActor("reach")
    evaluator = lw.StateQueryEvaluator(plans, width=8)
    config = lw.training.QueryEvaluatorConfig(steps=1, batch_size=2, held_out_states=0.0, held_out_pairs=0.0)
    data = lw.training.LabelledQueries(replay, config)
    value = lw.PlanConditionedValue(plans, width=8)
    qvalue = lw.PlanConditionedQValue(plans, width=8)
    gaussian = actor.stochastic()
    logger = lw.RerunLogger(folder / "pages.rrd")
    env = lw.LanguageWorldEnv("reach", max_steps=3)
    rollout = env.rollout(3, expert)[0]
    env.close()
    result = lw.evaluate(expert, tasks="reach", episodes_per_task=1, seed=1, max_steps=1, progress=False)
    run = {"tasks": "reach", "episodes_per_task": 1, "seed": 1, "max_steps": 1, "progress": False}
    episodes: list[Any] = []
    keys = ["observation", "task_id", "qaf", "skill_weights"]
    lw.evaluate(actor, **run, also_record=keys, on_episode=episodes.append)
    return {
        "ActorEnsemble": {"members": [actor]},
        "AdvantageWeightedLoss": {"actor_network": actor},
        "BehavioralCloningTrainer": {"actor": actor, "replay": replay, "progress": False},
        "CameraTransform": {},
        "CoLearningSampler": {"target": "reach"},
        "ConditionalPlan": {"task": "reach", "steps": PLAN.steps},
        "CorruptQAF": {"plans": plans},
        "DemonstratedSACLoss": {"actor_network": gaussian, "qvalue_network": qvalue},
        "DemonstratedTD3Loss": {"actor_network": actor, "qvalue_network": qvalue},
        "DescriptorConditionedActor": {"tasks": "reach"},
        "EpisodeFilter": {},
        "ExpectileValueLoss": {"value_network": value},
        "ExpertActor": {"tasks": "reach"},
        "HideOpening": {"probability": 0.5},
        "ImageQueryEvaluator": {"plans": plans, "width": 8},
        "ImageQueryEvaluatorConfig": {},
        "JitterTarget": {"plans": lw.canonical_plans(plans), "std": 0.03},
        "LabelledQueries": {"replay": replay, "config": config},
        "LanguageWorldEnv": {"tasks": "reach"},
        "LanguageWorldExperienceReplay": {"root": root, "label": "executed"},
        "OfflineTrainer": {"loss": lw.objectives.ExpectileValueLoss(value), "replay": executed, "progress": False},
        "OpenAIPlanner": {"model": "none", "base_url": "http://localhost:1"},
        "PlanConditionedActor": {"plans": plans},
        "PlanConditionedQValue": {"plans": plans, "width": 8},
        "PlanConditionedValue": {"plans": plans, "width": 8},
        "QValue": {"trunk": actor.trunk, "width": 8},
        "Value": {"trunk": actor.trunk, "width": 8},
        "PlanStep": {"condition": PLAN.steps[0].condition, "skill": PLAN.steps[0].skill},
        "Plans": {"plans": plans},
        "QAFTransform": {"plans": plans},
        "QueryEvaluator": {"plans": plans},
        "QueryEvaluatorConfig": {},
        "QueryEvaluatorTrainer": {"evaluator": evaluator, "data": data, "progress": False},
        "QueryProgram": {"queries": {"reach": ["the robot's gripper is open"]}},
        "RandomYaw": {"scale": 0.1},
        "RolloutRecorder": {"logger": logger},
        "ScriptedSkillActor": {"plans": plans},
        "StateQueryEvaluator": {"plans": plans, "width": 8},
        "SwapUnmentioned": {"plans": plans, "probability": 0.5},
        "Task": {"name": "stack", "description": "stack it", "objects": lw.TASKS["reach"].objects},
        "TaskBalancedSampler": {},
        "add_pictures": {"root": root},
        "attribute_failures": {
            "rollouts": episodes,
            "plans": plans,
            "actor": actor,
            "seed": 1,
            "max_steps": 1,
            "progress": False,
        },
        "canonical_plan": {"plan": PLAN},
        "canonical_plans": {"plans": {"reach": PLAN}},
        "collect_demonstrations": {
            "tasks": "reach",
            "episodes_per_task": 1,
            "root": folder / "none",
            "max_steps": 1,
            "progress": False,
        },
        "decode_plan": {"text": str(PLAN), "format": "chain_py", "task": "reach"},
        "encode_plan": {"plan": PLAN, "format": "chain_py"},
        "evaluate": {"actor": actor, **run},
        "export_dataset": {"root": root, "format": "lerobot", "out": folder / "none"},
        "import_dataset": {"source": theirs(folder / "theirs"), "out": folder / "none"},
        "from_pretrained": {"source": folder},
        "load_actor": {"path": lw_saved(lw.save_actor, actor, folder / "actor.safetensors")},
        "load_evaluator": {
            "path": lw_saved(lw.training.save_evaluator, evaluator, folder / "asked.safetensors"),
            "plans": plans,
        },
        "load_demonstrations": {"root": root},
        "load_pictures": {"replay": replay},
        "load_plans": {"source": "MT10"},
        "load_skills": {},
        "log_rollout": {"logger": logger, "rollout": rollout},
        "nearest_query": {"text": "the gripper is open", "task": "reach"},
        "nearest_skill": {"text": "reach"},
        "parse_query": {"text": "the robot's gripper is open", "task": "reach"},
        "plan_prompt": {"task": "reach", "format": "basic_py"},
        "plot_success": {"result": result},
        "resolve_tasks": {"names": "reach"},
        "save_actor": {"actor": actor, "path": folder / "none.safetensors"},
        "save_evaluator": {"evaluator": evaluator, "path": folder / "none.safetensors"},
        "save_plans": {"plans": plans, "folder": folder / "none"},
        "standardize_by_task": {"advantage": torch.zeros(2, 1), "task_id": torch.zeros(2).long()},
        "supported_queries": {"task": "reach"},
    }


def theirs(path: Any) -> Any:
    """A LeRobot dataset of somebody else's rows of a task in their own words."""
    rows = {"observation.state": [[0.0] * 39], "action": [[0.0] * 4], "episode_index": [0], "task_index": [0]}
    for folder in ("meta", "data"):
        (path / folder).mkdir(parents=True)
    pq.write_table(pa.table(rows), path / "data" / "file.parquet")
    (path / "meta" / "info.json").write_text('{"codebase_version": "v2.1", "total_frames": 1}')
    (path / "meta" / "tasks.jsonl").write_text('{"task_index": 0, "task": "theirs"}')
    return path


def lw_saved(save: Any, what: Any, path: Any) -> Any:
    save(what, path)
    return path
