"""One step tuned alone: which is chosen, and that a change elsewhere would be found out."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from lw_torchrl.paper import online
from lw_torchrl.paper.online import Elsewhere, OnlineRun, tune_step

import lw_torchrl as lw
from lw_torchrl.evaluation import PlanUse, weakest_step

PLANS = lw.load_plans("MT10")


def make_start():
    torch.manual_seed(0)
    return lw.PlanConditionedActor(PLANS, width=16, depth=1)


def test_the_weakest_step_is_that_of_its_episodes(monkeypatch):
    monkeypatch.setattr(online, "evaluate", partial(lw.evaluate, max_steps=60))
    start = make_start()
    actor, told = tune_step(start, "reach", "weakest", scale=0.7, seed=3, progress=False)
    use = PlanUse(PLANS)
    lw.evaluate(
        start,
        tasks="reach",
        episodes_per_task=20,
        seed=3,
        stop_at_success=True,
        max_steps=60,
        progress=False,
        also_record=["qaf", "skill_weights"],
        on_episode=use,
    )
    weakest = weakest_step(use, "reach")
    assert actor.steps == {"reach": [weakest.step]}
    assert actor.config["scale"] == 0.7
    assert (told["step"], told["skill"], told["condition"]) == (weakest.step, weakest.skill, weakest.condition)
    assert [one["furthest"] for one in told["stuck"]] == use.tasks()["reach"].furthest


def test_a_step_by_its_number():
    actor, told = tune_step(make_start(), "push", 2, scale=0.3, seed=0, progress=False)
    assert actor.steps == {"push": [2]}
    assert told["skill"] == "close the gripper around the puck"
    assert "stuck" not in told
    with pytest.raises(ValueError, match="steps of 'push' must be from 0 to 3, got 4"):
        tune_step(make_start(), "push", 4, scale=0.3, seed=0)
    with pytest.raises(ValueError, match="step must be one of 'weakest', got 'weekest'; did you mean 'weakest'"):
        tune_step(make_start(), "push", "weekest", scale=0.3, seed=0)


@pytest.mark.parametrize("tampered", [False, True])
def test_a_change_elsewhere_is_counted(tampered):
    start = make_start()
    actor = lw.ResidualActor(make_start(), steps={"push": [0]}, width=16, depth=1)
    torch.nn.init.normal_(actor.network[-1].weight)
    if tampered:
        actor.base.head.network[-1].bias.data += 1e-4
    watch = Elsewhere(start, actor)
    lw.evaluate(
        actor,
        tasks=["push", "reach"],
        episodes_per_task=1,
        seed=0,
        max_steps=70,
        progress=False,
        also_record=actor.in_keys,
        on_episode=watch,
    )
    found = watch.to_json()
    assert found["states"] == 140
    assert 70 <= found["outside"] < 140, "all of reach, and what push was not in its first step"
    assert (found["changed"] > 60) == tampered
    assert tampered or found["changed"] == 0


@pytest.mark.parametrize(
    ("options", "kind", "message"),
    [
        ({"step": 1, "method": "td3"}, ValueError, "step is of the method 'residual', got it with 'td3'"),
        ({"step": "first"}, ValueError, "step must be one of 'weakest', got 'first'"),
        ({"step": -1}, ValueError, "step must be at least 0, got -1"),
        ({"step": True}, TypeError, "step must be an integer, got True"),
        ({"step": 1.0}, TypeError, "step must be an integer, got 1.0"),
    ],
)
def test_a_run_of_a_wrong_step_is_refused(options, kind, message):
    with pytest.raises(kind, match=message):
        OnlineRun(**{"task": "push", "method": "residual", "seed": 0, **options})


def test_a_run_is_named_by_its_step_and_begins_as_others_do():
    one, weakest, plain = (OnlineRun("push", "residual", 0, step=step) for step in (1, "weakest", None))
    assert [run.folder.parts[-2] for run in (one, weakest, plain)] == [
        "residual-step2",
        "residual-weakest",
        "residual",
    ]
    assert one.begin == weakest.begin == plain.begin
    assert "step" not in plain.describe(PLANS)
    described, alone = plain.describe(PLANS), one.describe(PLANS)
    assert (described["recipe"]["config"].pop("residual_scale"), alone["recipe"]["config"].pop("residual_scale")) == (
        0.3,
        1.0,
    )
    assert alone == {**described, "step": 1}
