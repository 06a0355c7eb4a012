"""python -m benchmarks.plan_comparison decodes and runs every answer."""

import json

import pytest

import lw_torchrl as lw
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
    assert comparison.mean("other", "chain_py") == 0.0
    assert comparison.best_format("good") == "basic_md"
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
