"""Experiment runs with one task and sixty training steps."""

import json
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import lw_torchrl as lw
from benchmarks.paper import runs
from benchmarks.paper.imitation import ImitationRun
from benchmarks.paper.recipes import PRESETS, DataSetting, Execution, Member
from benchmarks.paper.stacked import StackedBehavioralCloning

PLANS = lw.load_plans("MT50")
TINY = DataSetting("tiny", "reach", 2)
TINY_ONE_SHOT = DataSetting("tiny-one-shot", "reach", 2, targets="push")
FOCUS = {"focus": True, "canonical": True, "swap_unmentioned": 0.5}
MEMBER = Member({"features": "differences", "width": 32, "depth": 1}, FOCUS)
PRESET = replace(
    PRESETS["strong"]["few-shot"],
    target=Execution("target", (0.0,)),
    members=(MEMBER,),
    training=lw.BehavioralCloningConfig(steps=60, batch_size=20, checkpoint_every=20),
)
ROLES = {"features": "opening", "roles": True, "jitter": 0.03, "any_yaw": True}
OTHER = Member({"features": "relative", "width": 16, "depth": 1, "yaw": 0.3}, ROLES)
ENSEMBLE = replace(PRESET, name="ensemble", members=(MEMBER, OTHER))
WATCHED = replace(PRESET, name="watched", evaluations=4)


def a_run(method="pcbc", seed=3, setting=TINY, preset=PRESET):
    return ImitationRun(setting, method, seed, preset, episodes=2)


def execute(run, out, tasks=None):
    """Execute a run with demonstrations of 100 steps and evaluation episodes of 40."""
    collect, evaluate = partial(lw.collect_demonstrations, max_steps=100), partial(runs.evaluate, max_steps=40)
    with patch.multiple(runs, collect_demonstrations=collect, evaluate=evaluate):
        tasks = tasks or run.setting.targets or "reach"
        return runs.execute_run(run, PLANS, out, tasks=tasks, progress=False)


def result_of(folder):
    """Return a result's episodes and configuration, without the time it took."""
    result = json.loads((folder / "results.json").read_text())
    assert result["config"].pop("seconds") > 0
    return result["episodes"], result["config"]


def stop_training(monkeypatch, setting, at):
    """Raise KeyboardInterrupt before the at-th training step; return a list with the number of steps so far."""
    trainer = lw.BehavioralCloningTrainer if setting is TINY else StackedBehavioralCloning
    step, count = trainer.step, [0]

    def stops(self):
        count[0] += 1
        if count[0] == at:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(trainer, "step", stops)
    return count
