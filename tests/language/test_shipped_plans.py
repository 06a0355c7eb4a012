"""The shipped plans: their form, and whether their conditions cover the states of an expert."""

from importlib.resources import files
from pathlib import Path

import pytest

import lw_torchrl as lw
from lw_torchrl.evaluation.plan_use import expert_use
from lw_torchrl.language import text
from lw_torchrl.language.plan_files import parse_plan

EPISODES = 30


def plan_text(task, folder="plans"):
    return (files("lw_torchrl.language") / "data" / folder / f"{task}.plan").read_text("utf-8")


@pytest.fixture(scope="module")
def use():
    """How the 50 plans fare in the states that the experts visit, with a table."""
    use = expert_use(lw.load_plans("MT50"), episodes_per_task=EPISODES, seed=0)
    assert sum(seen.failed for seen in use.values()) < 0.05 * 50 * EPISODES
    return use


@pytest.mark.slow
@pytest.mark.parametrize("task", lw.MT50)
def test_a_condition_is_true_in_the_expert_s_states_and_every_step_is_used(use, task):
    assert use[task].covered >= 0.9
    assert use[task].num_true <= 2
    assert 0.01 <= min(use[task].true) <= max(use[task].true) <= 0.95, use[task].true


@pytest.mark.parametrize("task", lw.MT50)
def test_a_file_is_canonical_and_has_a_few_reasoned_steps_with_scripted_skills(task):
    assert str(parse_plan(plan_text(task), task)) == plan_text(task)
    steps = lw.load_plans("MT50")[task].steps
    assert 2 <= len(steps) <= 8
    assert all(step.reason for step in steps)
    assert len({step.condition for step in steps}) == len(steps)
    for step in steps:
        assert lw.load_skills()[step.skill].for_task(task)


def test_the_second_set_uses_only_skills_of_mt10():
    plans = lw.load_plans("MT50", skills="MT10")
    assert tuple(plans) == lw.MT50
    assert set(plans.skills) == set(lw.load_plans("MT10").skills)
    for task in lw.MT50:
        assert all(step.reason for step in plans[task].steps)
        if task in lw.MT10:
            assert plans[task] == lw.load_plans("MT10")[task]
        else:
            assert str(plans[task]) == plan_text(task, "plans_mt10_skills")


def test_every_text_comes_with_its_embedding(monkeypatch):
    monkeypatch.setattr(text, "sentence_encoder", lambda texts: pytest.fail(f"not shipped: {texts}"))
    texts = {skill for kind in ("own", "MT10") for skill in lw.load_plans("MT50", skills=kind).skills}
    text.encode_texts([*sorted(texts), *(task.description for task in lw.TASKS.values())])


def test_the_reworded_plans_differ_from_the_second_set_only_by_skills_of_mt10():
    shipped, words = lw.load_plans("MT50", skills="MT10"), set(lw.load_plans("MT10").skills)
    reworded = lw.load_plans(Path(__file__).parents[2] / "examples" / "reworded")
    assert len(reworded) == 10
    assert not {*reworded} & {*lw.MT10}
    for task, plan in reworded.items():
        assert [str(step.condition) for step in plan.steps] == [str(step.condition) for step in shipped[task].steps]
        assert {step.skill for step in plan.steps} <= words
        changed = {(old.skill, new.skill) for old, new in zip(shipped[task].steps, plan.steps, strict=True)}
        changed = {pair for pair in changed if pair[0] != pair[1]}
        assert changed <= {
            ("move the puck to the target location", "place the gripper above the button"),
            ("move the puck to the target location", "push the button down"),
            ("move the gripper toward the reach target", "place the gripper above the button"),
        }
        assert changed
