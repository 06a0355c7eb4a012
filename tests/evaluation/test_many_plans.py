"""Many plans in one simulation fare as each fares alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lw_torchrl.evaluation.many_plans import _PlanOfRow, evaluate_plans
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.tasks import task_id

PLANS = lw.load_plans("MT10")
SHORT = {"episodes": 3, "seed": 1_000, "max_steps": 60, "progress": False}


def without(plan, step):
    pairs = [(str(one.condition), one.skill) for number, one in enumerate(plan.steps) if number != step]
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


MANY = [PLANS["push"], without(PLANS["push"], 0), PLANS["reach"], without(PLANS["push"], 1), PLANS["drawer-open"]]


def test_each_plan_fares_as_evaluate_says():
    found = evaluate_plans(MANY, choose="first", num_envs=7, **SHORT)
    for plan, won in zip(MANY, found, strict=True):
        actor = lw.ScriptedSkillActor({plan.task: plan})
        options = {"episodes_per_task": 3, "seed": 1_000, "max_steps": 60, "noise_scale": 0.0, "progress": False}
        result = lw.evaluate(actor, tasks=plan.task, **options)
        assert won == tuple(episode.success for episode in result.episodes)
    assert found[0] != found[1] or found[0] != found[3]


def test_neither_rows_nor_other_plans_change_what_is_chosen_by_chance():
    told = {}
    found = evaluate_plans(MANY, num_envs=256, **SHORT)
    assert evaluate_plans([*MANY[::-1], MANY[0]], num_envs=6, on_plan=told.__setitem__, **SHORT) == [
        *found[::-1],
        found[0],
    ]
    assert told == dict(enumerate([*found[::-1], found[0]]))
    assert evaluate_plans(MANY[1:2], **SHORT) == found[1:2]


def test_noise_is_that_of_evaluate():
    plan = PLANS["reach"]
    options = {"seed": 1_000, "max_steps": 60, "noise_scale": 1.0, "progress": False}
    result = lw.evaluate(lw.ScriptedSkillActor({"reach": plan}), tasks="reach", episodes_per_task=8, **options)
    won = tuple(episode.success for episode in result.episodes)
    assert evaluate_plans([plan], episodes=8, choose="first", **options) == [won]


@pytest.mark.parametrize("seed", [0, 1])
def test_a_true_step_is_chosen_by_chance_in_equal_parts(seed):
    pairs = [
        ("the robot's gripper is open", "lower the gripper around the puck"),
        ("the robot's gripper is closed", "close the gripper around the puck"),
        ("the robot's gripper is open", "place the gripper above the puck"),
    ]
    plan = lw.ConditionalPlan.from_pairs("push", pairs)
    policy = _PlanOfRow({"push": [plan]}, 1_000, seed, "random", None)
    state = TensorDict(
        {
            "observation": torch.ones(1_000, 39),
            "task_id": torch.full((1_000,), task_id("push")),
            "place": torch.arange(1_000),
        },
        [1_000],
    )
    truth = policy.queries(state["observation"], state["task_id"])[:, [0, 1, 0]]
    assert truth[0].tolist() == [True, False, True]
    plans = torch.zeros(1_000, dtype=torch.int64)
    chosen = np.stack([policy._choose(truth, plans, state["place"]).numpy() for _ in range(20)])
    assert set(chosen.flatten()) == {0, 2}
    assert abs((chosen == 0).mean() - 0.5) < 0.02
    assert np.abs((chosen == 0).mean(0) - 0.5).max() < 0.5, "no row takes the same each time"


def test_what_is_refused():
    with pytest.raises(ValueError, match="plans must be one at least, got none"):
        evaluate_plans([], **SHORT)
    with pytest.raises(ValueError, match="choose must be one of 'random', 'first', got 'rand'"):
        evaluate_plans(MANY, choose="rand", **SHORT)
    dance = lw.ConditionalPlan.from_pairs("push", [("the robot's gripper is open", "dance")])
    with pytest.raises(ValueError, match="'dance'"):
        evaluate_plans([dance], **SHORT)
