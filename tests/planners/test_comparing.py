"""compare_plans: every answer decoded and carried out, whatever it is, and none twice."""

from __future__ import annotations

import json

import pytest
from lw_torchrl.planners.comparing import compare_plans, no_plans, write_report

import lw_torchrl as lw
from lw_torchrl.planners import answer_path
from lw_torchrl.planners import comparing as module
from lw_torchrl.planners.answer_files import ignored_files

PLANS = lw.load_plans("MT10")
SHORT = {"episodes": 4, "max_steps": 60, "progress": False}


def write(folder, model, format, task, attempt, text):
    path = answer_path(folder, model, format, task, attempt)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, "utf-8")


@pytest.fixture
def answers(tmp_path):
    """One model whose plans are good in one format, and say nothing in another; and one that speaks of other things."""
    folder = tmp_path / "plans"
    for task in ("reach", "drawer-open"):
        write(folder, "good", "chain_py", task, 0, lw.encode_plan(PLANS[task], "chain_py"))
        write(folder, "good", "chain_py", task, 1, "I cannot do that.")
        write(folder, "good", "basic_md", task, 0, lw.encode_plan(PLANS[task], "basic_md"))
        write(folder, "other", "chain_py", task, 0, "def bake_a_cake(robot):\n    pass\n")
    return folder


def test_how_each_answer_fared(answers):
    found = compare_plans(answers, choose="first", **SHORT)
    assert found.groups == (("good", "basic_md"), ("good", "chain_py"), ("other", "chain_py"))
    actor = lw.ScriptedSkillActor({task: PLANS[task] for task in ("reach", "drawer-open")})
    options = {"episodes_per_task": 4, "seed": 1000, "max_steps": 60, "noise_scale": 0.0, "progress": False}
    rates = lw.evaluate(actor, tasks=["reach", "drawer-open"], **options).success_once
    assert found.rates("good", "basic_md") == {task: [rate] for task, rate in rates.items()}
    assert found.rates("good", "chain_py") == {task: [rate, 0.0] for task, rate in rates.items()}
    assert found.mean("good", "chain_py") == pytest.approx(sum(rates.values()) / 4)
    assert found.mean("other", "chain_py") == 0.0
    assert found.best_format("good") == "basic_md"
    (refusal,) = (one for one in found.answers if (one.format, one.task, one.attempt) == ("chain_py", "reach", 1))
    assert refusal.reason
    assert refusal.steps == 0
    assert "| good  | chain_py | 2     | 4       | 2 " in found.table()
    assert "| reach       | " in found.task_table()


def test_the_best_answer_is_chosen_and_counted_in_different_episodes():
    def answer(attempt, success):
        return module.ComparedAnswer("m", "chain_py", "reach", attempt, 1, 0, "", success)

    lucky = answer(0, (True, False, True, False))  # in all of those that choose, in none of the others
    sound = answer(1, (True, True, False, True))
    assert module.PlanComparison([lucky, sound], {}).best_of("m", "chain_py") == 0.0
    assert module.PlanComparison([sound], {}).best_of("m", "chain_py") == 1.0


def test_stopped_it_goes_on_with_the_plans_that_are_left(answers, tmp_path, monkeypatch):
    kept = tmp_path / "fared.json"
    whole = compare_plans(answers, **SHORT).to_json()
    monkeypatch.setattr(module, "_SAVE_SECONDS", 0.0)
    real = module.evaluate_plans
    asked = []

    def stopped(plans, *, on_plan, **options):
        asked.append(len(plans))

        def after_one(index, success):
            on_plan(index, success)
            raise KeyboardInterrupt

        return real(plans, on_plan=after_one if len(asked) == 1 else on_plan, **options)

    monkeypatch.setattr(module, "evaluate_plans", stopped)
    with pytest.raises(KeyboardInterrupt):
        compare_plans(answers, resume=kept, **SHORT)
    assert compare_plans(answers, resume=kept, **SHORT).to_json() == whole
    assert compare_plans(answers, resume=kept, **SHORT).to_json() == whole
    assert asked == [2, 1], "equal plans run once, and those that are done not again"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('{"settings": {}, "fared": {}}', r"of other settings: choose \(None, now 'random'\), episodes"),
        ('{"settings": ', "resume: the kept results 'fared.json' cannot be read"),
        ('{"settings": SETTINGS, "fared": {"a": "01"}}', "is damaged"),
        ('{"settings": SETTINGS, "fared": [1]}', "is damaged"),
        ('{"settings": SETTINGS, "fared": {"a": "0121"}}', "is damaged"),
    ],
)
def test_what_was_kept_is_checked(answers, tmp_path, monkeypatch, content, message):
    monkeypatch.chdir(tmp_path)
    settings = {"episodes": 4, "seed": 1000, "choose": "random", "noise_scale": 0.0, "max_steps": 60}
    (tmp_path / "fared.json").write_text(content.replace("SETTINGS", json.dumps(settings)))
    with pytest.raises(ValueError, match=message):
        compare_plans(answers, resume="fared.json", **SHORT)


def test_a_folder_without_answers_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds no answers"):
        compare_plans(tmp_path, **SHORT)


def test_why_answers_have_no_plan(answers):
    write(answers, "other", "chain_py", "push", 0, "I cannot do that.")
    (answers / "good/chain_py/push_2.py").write_text("?")
    (answers / "good/chain_py/push-3.txt").write_text("?")
    (answers / "good/chain_py/push-3.json").write_text("?")
    found = no_plans(compare_plans(answers, **SHORT))
    assert found == ["5 answers have no plan:", "5: it has no steps, neither for the task nor for another task"]
    assert [path.name for path in ignored_files(answers)] == ["push-3.txt", "push_2.py"]
    assert no_plans(module.PlanComparison([], {})) == []


def test_the_report(answers, tmp_path):
    found = compare_plans(answers, **SHORT)
    written = write_report(found, tmp_path / "out")
    assert [file.name for file in written] == ["results.json", "summary.md", "models.png", "formats.png", "best"]
    assert json.loads(written[0].read_text()) == found.to_json()
    assert "Plans of good, other" in written[1].read_text("utf-8")


def test_models_without_a_task_in_common_have_no_figure(tmp_path):
    for model, task in (("a", "reach"), ("b", "push")):
        write(tmp_path / "plans", model, "chain_py", task, 0, "nothing")
    written = write_report(compare_plans(tmp_path / "plans", **SHORT), tmp_path / "out")
    assert [file.name for file in written] == ["results.json", "summary.md", "formats.png", "best"]
    assert not list(written[-1].glob("*/*"))


def test_the_best_plan_of_each_task_is_kept_for_other_commands(tmp_path):
    good = PLANS["drawer-open"]
    bad = lw.ConditionalPlan("drawer-open", good.steps[:1])  # it stays above the handle
    for attempt, plan in enumerate((bad, good, good, bad)):
        write(tmp_path / "plans", "m", "chain_py", "drawer-open", attempt, lw.encode_plan(plan, "chain_py"))
    write(tmp_path / "plans", "m", "chain_py", "push", 0, "nothing")
    stale = tmp_path / "out/best/m/chain_py/window-open.plan"
    stale.parent.mkdir(parents=True)
    stale.write_text("of an earlier run")
    write_report(compare_plans(tmp_path / "plans", **SHORT | {"max_steps": 150}), tmp_path / "out")
    assert dict(lw.load_plans(stale.parent)) == {"drawer-open": good}


def test_best_forgets_a_model_that_is_gone_and_nothing_else(tmp_path):
    for model in ("old", "mine"):
        write(tmp_path / "plans", model, "chain_py", "reach", 0, lw.encode_plan(PLANS["reach"], "chain_py"))
    write_report(compare_plans(tmp_path / "plans", **SHORT), tmp_path / "out")
    best = tmp_path / "out/best"
    (best / "mine/notes.plan").write_text("mine")
    (best / "old/chain_py/notes.txt").write_text("mine")
    (tmp_path / "plans/old").rename(tmp_path / "plans/new")
    write_report(compare_plans(tmp_path / "plans", **SHORT), tmp_path / "out")
    files = {str(path.relative_to(best)) for path in best.rglob("*") if path.is_file()}
    plans = {"mine/chain_py/reach.plan", "new/chain_py/reach.plan"}
    assert files == plans | {"mine/notes.plan", "old/chain_py/notes.txt"}
    (best / "old/chain_py/notes.txt").unlink()
    (tmp_path / "plans/mine").rename(tmp_path / "plans/old")
    write_report(compare_plans(tmp_path / "plans", **SHORT), tmp_path / "out")
    (tmp_path / "plans/old").rename(tmp_path / "plans/mine")
    write_report(compare_plans(tmp_path / "plans", **SHORT), tmp_path / "out")
    assert not (best / "old").exists()
