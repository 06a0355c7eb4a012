"""Plans that run in one simulation succeed as often as each does alone."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from benchmarks.many_plans import _PlanOfRow, evaluate_plans
from lw_torchrl.language.tasks import task_id

PLANS = lw.load_plans("MT10")
SHORT = {"episodes": 3, "seed": 1_000, "max_steps": 60, "progress": False}


def without(plan, step):
    pairs = [(str(other.condition), other.skill) for number, other in enumerate(plan.steps) if number != step]
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


MANY = [PLANS["push"], without(PLANS["push"], 0), PLANS["reach"], without(PLANS["push"], 1), PLANS["drawer-open"]]


def test_success_of_each_plan_is_that_of_evaluate():
    successes = evaluate_plans(MANY, choose="first", noise_scale=0.3, num_envs=7, **SHORT)
    options = {"episodes_per_task": 3, "seed": 1_000, "max_steps": 60, "noise_scale": 0.3, "progress": False}
    for plan, success in zip(MANY, successes, strict=True):
        result = lw.evaluate(lw.ScriptedSkillActor({plan.task: plan}), tasks=plan.task, **options)
        assert success == tuple(episode.success for episode in result.episodes)


def test_random_choices_depend_neither_on_rows_nor_on_other_plans():
    reported = {}
    successes = evaluate_plans(MANY, num_envs=256, **SHORT)
    expected = [*successes[::-1], successes[0]]
    assert evaluate_plans([*MANY[::-1], MANY[0]], num_envs=6, on_plan=reported.__setitem__, **SHORT) == expected
    assert reported == dict(enumerate(expected))
    assert evaluate_plans(MANY[1:2], **SHORT) == successes[1:2]


@pytest.mark.parametrize("seed", [0, 1])
def test_true_steps_are_chosen_equally_often(seed):
    pairs = [
        ("the robot's gripper is open", "lower the gripper around the puck"),
        ("the robot's gripper is closed", "close the gripper around the puck"),
        ("the robot's gripper is open", "place the gripper above the puck"),
    ]
    policy = _PlanOfRow({"push": [lw.ConditionalPlan.from_pairs("push", pairs)]}, 1_000, seed, "random", None)
    columns = {"observation": torch.ones(1_000, 39), "task_id": torch.full((1_000,), task_id("push"))}
    state = TensorDict({**columns, "place": torch.arange(1_000)}, [1_000])
    truth = policy.queries(state["observation"], state["task_id"])[:, [0, 1, 0]]
    plans = torch.zeros(1_000, dtype=torch.int64)
    chosen = np.stack([policy._choose(truth, plans, state["place"]).numpy() for _ in range(20)])
    assert {*chosen.flatten()} == {0, 2}
    assert abs((chosen == 0).mean() - 0.5) < 0.02
    assert np.abs((chosen == 0).mean(0) - 0.5).max() < 0.5, "no row takes the same step each time"
