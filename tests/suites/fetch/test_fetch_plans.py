"""The Fetch suite's tasks, skills and plans, and the success of the plans."""

import pytest

pytest.importorskip("gymnasium_robotics")
from fetch_runs import IDS, scripted

import lw_torchrl as lw
from lw_torchrl.language.canonical import explain_canonical
from lw_torchrl.language.skills import skills_for
from lw_torchrl.suites.fetch import TASKS, load_plans, load_skills


def test_every_step_has_a_scripted_skill_and_is_understood():
    plans, skills = load_plans(), load_skills()
    assert list(plans) == list(TASKS) == sorted(IDS)
    for plan in plans.values():
        allowed = skills_for(plan.definition, skills)
        assert {step.skill for step in plan.steps} <= set(allowed)
        canonical = explain_canonical(plan)
        assert canonical.left_out == ()
        assert canonical.source == "plan"


def test_plans_and_tasks_can_be_saved(tmp_path):
    plans = load_plans()
    lw.save_plans(plans, tmp_path)
    assert lw.load_plans(tmp_path, tasks={**lw.TASKS, **TASKS}).fingerprint == plans.fingerprint
    assert lw.Plans.from_json(plans.to_json()).fingerprint == plans.fingerprint
    assert all(lw.Task.from_json(name, task.to_json()) == task for name, task in TASKS.items())
    assert len({lw.task_id(name) for name in TASKS}) == len(TASKS)


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_plans_survive_every_format(format):
    for name, plan in load_plans().items():
        text = lw.encode_plan(plan, format)
        assert lw.decode_plan(text, TASKS[name], format, skills=load_skills()).plan == plan


def test_plan_succeeds():
    _, success, _ = scripted("fetch/pick-and-place", range(4), 30)
    assert success.any(0).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("task", "least"),
    [("fetch/reach", 0.98), ("fetch/push", 0.95), ("fetch/pick-and-place", 0.95), ("fetch/slide", 0.35)],
)
def test_plans_succeed_within_fetchs_fifty_steps(task, least):
    _, success, true = scripted(task, range(50), 50)
    assert success.any(0).mean() >= least
    assert (true == 1).all(), "exactly one condition holds at each moment"
