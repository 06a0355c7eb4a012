"""Plans that run in one simulation succeed as often as each does alone."""

import lw_torchrl as lw
from benchmarks.many_plans import evaluate_plans

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
