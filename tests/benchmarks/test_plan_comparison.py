"""Comparisons of plans: every answer of a model, many plans in one simulation, and plans that read no text."""

import json

import pytest

import lw_torchrl as lw
from benchmarks.any_plans import DEVELOPMENT, TEST, report
from benchmarks.blind_plans import blind_plans
from benchmarks.many_plans import evaluate_plans
from benchmarks.plan_comparison import Arguments, compare_plans, main, no_plans
from lw_torchrl.planners import answer_path

PLANS = lw.load_plans("MT10")
SHORT = {"episodes": 4, "max_steps": 60, "progress": False}


def write(folder, model, format, task, attempt, text):
    path = answer_path(folder, model, format, task, attempt)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


@pytest.fixture
def answers(tmp_path):
    """A model with good plans and refusals, and a model that writes about other tasks."""
    folder = tmp_path / "plans"
    for task in ("reach", "drawer-open"):
        write(folder, "good", "chain_py", task, 0, lw.encode_plan(PLANS[task], "chain_py"))
        write(folder, "good", "chain_py", task, 1, "I cannot do that.")
        write(folder, "good", "basic_md", task, 0, lw.encode_plan(PLANS[task], "basic_md"))
        write(folder, "other", "chain_py", task, 0, "def bake_a_cake(robot):\n    pass\n")
    return folder


def test_every_answer_is_compared(answers):
    comparison = compare_plans(answers, choose="first", **SHORT)
    assert comparison.groups == (("good", "basic_md"), ("good", "chain_py"), ("other", "chain_py"))
    actor = lw.ScriptedSkillActor({task: PLANS[task] for task in ("reach", "drawer-open")})
    options = {"episodes_per_task": 4, "seed": 1000, "max_steps": 60, "noise_scale": 0.0, "progress": False}
    rates = lw.evaluate(actor, tasks=["reach", "drawer-open"], **options).success_once
    assert comparison.rates("good", "basic_md") == {task: [rate] for task, rate in rates.items()}
    assert comparison.rates("good", "chain_py") == {task: [rate, 0.0] for task, rate in rates.items()}
    assert (comparison.mean("other", "chain_py"), comparison.best_format("good")) == (0.0, "basic_md")
    assert "| good  | chain_py | 2     | 4       | 2 " in comparison.table()
    reason = "the text has no steps for the task or any other task"
    assert no_plans(comparison) == ["answers without a plan: 4", f"4: {reason}"]


def test_command_writes_a_report_and_the_best_plans(tmp_path, capsys):
    good = PLANS["drawer-open"]
    bad = lw.ConditionalPlan("drawer-open", good.steps[:1])  # it stays above the handle
    for attempt, plan in enumerate((bad, good, bad)):
        write(tmp_path / "plans", "m", "chain_py", "drawer-open", attempt, lw.encode_plan(plan, "chain_py"))
    write(tmp_path / "plans", "n", "chain_py", "push", 0, "nothing")
    stale = tmp_path / "out/best/m/chain_py/window-open.plan"
    stale.parent.mkdir(parents=True)
    stale.write_text("an earlier run")
    main(Arguments(tmp_path / "plans", episodes=2, max_steps=150, out=tmp_path / "out"))
    assert dict(lw.load_plans(stale.parent)) == {"drawer-open": good}
    assert "Plans of m, n" in (tmp_path / "out/summary.md").read_text("utf-8")
    assert len(json.loads((tmp_path / "out/results.json").read_text())["answers"]) == 4
    assert (tmp_path / "out/formats.png").is_file()
    assert not (tmp_path / "out/models.png").exists(), "the models have no task in common"
    assert "answers without a plan: 1" in capsys.readouterr().out


LONGER = {"episodes": 3, "seed": 1_000, "max_steps": 60, "progress": False}


def without(plan, step):
    pairs = [(str(other.condition), other.skill) for number, other in enumerate(plan.steps) if number != step]
    return lw.ConditionalPlan.from_pairs(plan.definition, pairs)


MANY = [PLANS["push"], without(PLANS["push"], 0), PLANS["reach"], without(PLANS["push"], 1), PLANS["drawer-open"]]


def test_success_of_each_plan_is_that_of_evaluate():
    successes = evaluate_plans(MANY, choose="first", noise_scale=0.3, num_envs=7, **LONGER)
    options = {"seed": 1_000, "max_steps": 60, "noise_scale": 0.3, "progress": False}
    for plan, success in zip(MANY, successes, strict=True):
        result = lw.evaluate(lw.ScriptedSkillActor({plan.task: plan}), episodes_per_task=3, **options)
        assert success == tuple(episode.success for episode in result.episodes)


def test_random_choices_depend_neither_on_rows_nor_on_other_plans():
    reported = {}
    successes = evaluate_plans(MANY, num_envs=256, **LONGER)
    expected = [*successes[::-1], successes[0]]
    assert evaluate_plans([*MANY[::-1], MANY[0]], num_envs=6, on_plan=reported.__setitem__, **LONGER) == expected
    assert (reported, evaluate_plans(MANY[1:2], **LONGER)) == (dict(enumerate(expected)), successes[1:2])


def test_chooser_picks_motions_from_geometry():
    """A puck behind a wall, a puck on the table, a drawer to push, one to pull, a button to press, no object at all."""
    tasks = ["push-wall", "push", "drawer-close", "drawer-open", "button-press-topdown", "reach"]
    plans = blind_plans("chooser", tasks)
    last = [[step.role for step in plans[task].steps if not step.role.fallback][-1] for task in tasks]
    expected = "carry grasp, move grasp, push push, move grasp, push press, hold reach"
    assert ", ".join(f"{role.verb} {role.manner}" for role in last) == expected


def test_plans_are_compared_with_the_best_blind_plan_of_each_split():
    rates = {"default": (0.2, 0.6), "carried": (0.5, 0.4), "natural": (0.9, 0.7)}
    successes = {row: dict.fromkeys(DEVELOPMENT, at[0]) | dict.fromkeys(TEST, at[1]) for row, at in rates.items()}
    rows = [{"row": row, "seed": seed, "success": success} for row, success in successes.items() for seed in (0, 1)]
    head, _, _, _, natural = report(rows, 20).splitlines()
    assert "minus carried" in head.split("20 test")[0]
    assert "minus default" in head.split("20 test")[1]
    assert natural.count("0.400 [0.400, 0.400]") == natural.count("0.100 [0.100, 0.100]") == 1
    assert "20, 0" in natural
