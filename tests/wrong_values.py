"""Wrong values of arguments, and a good call of each public name whose arguments need one another."""

import math
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import torch
from cases import read_cases

import lw_torchrl as lw

PLAN = lw.load_plans("MT10")["reach"]
CONSTANTS = read_cases("wrong_values.toml")
# Of these, the values that an argument's annotation does not allow must raise an error that names the argument.
OF_ANY_TYPE: list[Any] = [
    *(3, 0, -1, 1.5, -0.1, 1.1, math.nan, math.inf, True, None, "", "no such", "0.1", b"bytes", object()),
    *([], [3], ["no such"], [None], [0.5], [math.nan], (), ("no such",), (2,), (3, "no such")),
    *({}, {"one": 3}, {3: "one"}, {"reach": "a plan"}, torch.zeros(3), torch.zeros(1, 1, dtype=torch.bool)),
]
# Values that the annotation allows and the function must refuse, by the argument's name or the function's and its own.
OF_ONE_NAME: dict[str, list[Any]] = CONSTANTS["wrong"] | {
    "plans": [{}, {"push": PLAN}],
    "reference": [{}, {"push": PLAN}],
    "Plans.plans": [3, "reach", [], {}, [3], {"push": PLAN}, [PLAN, PLAN]],
    "worker": [(2, 1), (0, 0)],
}
# Public names that can be called with nothing but plans.
PLANS_ONLY = ("CorruptQAF", "PlanConditionedActor", "Plans", "QAFTransform", "QueryEvaluator", "ScriptedSkillActor")


def good_calls(folder: Any) -> dict[str, dict[str, Any]]:
    """Arguments with which a public name can be called; a wrong value takes the place of one."""
    plans = lw.Plans({"reach": PLAN})
    demos = lw.collect_demonstrations("reach", episodes_per_task=1, root=folder / "demos", max_steps=3, progress=False)
    root = demos.root
    replay = lw.LanguageWorldExperienceReplay(root, batch_size=2, transform=lw.QAFTransform(plans))
    own: dict[str, Any] = {"label": "executed", "terminate_on_success": True, "transform": lw.QAFTransform(plans)}
    executed = lw.LanguageWorldExperienceReplay(root, batch_size=2, **own)
    actor = lw.PlanConditionedActor(plans)
    expert = lw.ExpertActor("reach")
    evaluator = lw.modules.StateQueryEvaluator(plans, width=8)
    config = lw.training.QueryEvaluatorConfig(steps=1, batch_size=2, held_out_states=0.0, held_out_pairs=0.0)
    data = lw.training.LabelledQueries(replay, config)
    value = lw.PlanConditionedValue(plans, width=8)
    qvalue = lw.PlanConditionedQValue(plans, width=8)
    logger = lw.RerunLogger(folder / "pages.rrd")
    env = lw.LanguageWorldEnv("reach", max_steps=3)
    rollout = env.rollout(3, expert)[0]
    env.close()
    run = {"tasks": "reach", "episodes_per_task": 1, "seed": 1, "max_steps": 1, "progress": False}
    short = {"max_steps": 1, "progress": False}
    result = lw.evaluate(expert, **run)
    episodes: list[Any] = []
    keys = ["observation", "task_id", "qaf", "skill_weights"]
    lw.evaluate(actor, **run, also_record=keys, on_episode=episodes.append)
    lw.save_actor(actor, folder / "actor.safetensors")
    lw.training.save_evaluator(evaluator, folder / "asked.safetensors")
    wide = {"plans": plans, "width": 8}
    eyes = {"evaluator": lw.modules.ImageQueryEvaluator(**wide), "config": lw.training.ImageQueryEvaluatorConfig()}
    collected = {"tasks": "reach", "episodes_per_task": 1, "root": folder / "none"}
    names = ("ImageQueryEvaluator", "PlanConditionedQValue", "PlanConditionedValue", "StateQueryEvaluator")
    return {
        **{name: {"plans": plans} for name in PLANS_ONLY},
        **dict.fromkeys(names, wide),
        **CONSTANTS["good calls"],
        "ActorEnsemble": {"members": [actor]},
        "AdvantageWeightedLoss": {"actor_network": actor},
        "BehavioralCloningTrainer": {"actor": actor, "replay": replay, "progress": False},
        "ConditionalPlan": {"task": "reach", "steps": PLAN.steps},
        "DemonstratedSACLoss": {"actor_network": actor.stochastic(), "qvalue_network": qvalue},
        "DemonstratedTD3Loss": {"actor_network": actor, "qvalue_network": qvalue},
        "ExpectileValueLoss": {"value_network": value},
        "ImageQueryEvaluatorTrainer": {"data": data, **eyes},
        "JitterTarget": {"plans": lw.canonical_plans(plans), "std": 0.03},
        "LabelledQueries": {"replay": replay, "config": config},
        "LanguageWorldExperienceReplay": {"root": root, "label": "executed"},
        "OfflineTrainer": {"loss": lw.objectives.ExpectileValueLoss(value), "replay": executed, "progress": False},
        "QValue": {"trunk": actor.trunk, "width": 8},
        "Value": {"trunk": actor.trunk, "width": 8},
        "PlanStep": {"condition": PLAN.steps[0].condition, "skill": PLAN.steps[0].skill},
        "QueryEvaluatorTrainer": {"evaluator": evaluator, "data": data, "progress": False},
        "QueryProgram": {"queries": {"reach": ["the robot's gripper is open"]}},
        "RolloutRecorder": {"logger": logger},
        "SwapUnmentioned": {"plans": plans, "probability": 0.5},
        "Task": {"name": "stack", "description": "stack it", "objects": lw.TASKS["reach"].objects},
        "add_pictures": {"root": root},
        "attribute_failures": {"rollouts": episodes, "plans": plans, "actor": actor, "seed": 1, **short},
        "canonical_plan": {"plan": PLAN},
        "canonical_plans": {"plans": {"reach": PLAN}},
        "collect_demonstrations": {**collected, **short},
        "decode_plan": {"text": str(PLAN), "format": "chain_py", "task": "reach"},
        "encode_plan": {"plan": PLAN, "format": "chain_py"},
        "evaluate": {"actor": actor, **run},
        "export_dataset": {"root": root, "format": "lerobot", "out": folder / "none"},
        "import_dataset": {"source": theirs(folder / "theirs"), "out": folder / "none"},
        "from_pretrained": {"source": folder},
        "load_actor": {"path": folder / "actor.safetensors"},
        "load_evaluator": {"path": folder / "asked.safetensors", "plans": plans},
        "load_demonstrations": {"root": root},
        "load_pictures": {"replay": replay},
        "log_rollout": {"logger": logger, "rollout": rollout},
        "plot_success": {"result": result},
        "save_actor": {"actor": actor, "path": folder / "none.safetensors"},
        "save_evaluator": {"evaluator": evaluator, "path": folder / "none.safetensors"},
        "save_plans": {"plans": plans, "folder": folder / "none"},
        "standardize_by_task": {"advantage": torch.zeros(2, 1), "task_id": torch.zeros(2).long()},
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
