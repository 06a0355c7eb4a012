"""Runs of experiments of one task and sixty steps, and doing them."""

import json
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import lw_torchrl as lw
from lw_torchrl.paper import runs
from lw_torchrl.paper.imitation import ImitationRun
from lw_torchrl.paper.recipes import PRESETS, DataSetting, Execution, Member

PLANS = lw.load_plans("MT50")
TINY = DataSetting("tiny", "reach", 2)
TINY_ONE_SHOT = DataSetting("tiny-one-shot", "reach", 2, targets="push")
ASTRAY = PRESETS["strong"]["few-shot"].base
FOCUS = {"focus": True, "canonical": True, "swap_unmentioned": 0.5}
MEMBER = Member({"features": "differences", "width": 32, "depth": 1}, FOCUS)
PRESET = replace(
    PRESETS["strong"]["few-shot"],
    target=Execution("target", (0.0,)),
    members=(MEMBER,),
    training=lw.BehavioralCloningConfig(steps=60, batch_size=20, checkpoint_every=20),
)
ROLES = {"features": "opening", "roles": True, "jitter": 0.03}
OTHER = Member({"features": "relative", "width": 16, "depth": 1}, ROLES, yaw=0.3, any_yaw=True)
ENSEMBLE = replace(PRESET, name="ensemble", members=(MEMBER, OTHER))


def a_run(method="pcbc", seed=3, setting=TINY, preset=PRESET):
    return ImitationRun(setting, method, seed, preset, episodes=2)


def task_of(one):
    return one.setting.targets or "reach"


def execute(one, out, preset=None):
    one = one if preset is None else replace(one, preset=preset)
    return execute_short(one, out, tasks=task_of(one))


def execute_short(one, out, plans=PLANS, **options):
    """Do a run with demonstrations of a hundred steps, and episodes of forty."""
    collect, evaluate = partial(lw.collect_demonstrations, max_steps=100), partial(runs.evaluate, max_steps=40)
    with patch.multiple(runs, collect_demonstrations=collect, evaluate=evaluate):
        return runs.execute_run(one, plans, out, progress=False, **options)


def rates(path):
    found = json.loads((path / "results.json").read_text())
    assert found["config"].pop("seconds") > 0
    return found["episodes"], found["config"]


def stop_training(monkeypatch, setting, at):
    """Ctrl-C before the at-th step that is made; returns a list of the number of steps that were asked for."""
    trainer = lw.BehavioralCloningTrainer if setting is TINY else lw.training.StackedBehavioralCloning
    step, count = trainer.step, [0]

    def stops(self):
        count[0] += 1
        if count[0] == at:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(trainer, "step", stops)
    return count
