"""Runs of the paper's experiments: done once, and resumed to the same result; many actors trained at once."""

import json
from dataclasses import replace
from functools import partial
from unittest.mock import patch

import pytest
import torch
from speed import first_fast
from torchrl.envs import Compose

import lw_torchrl as lw
from benchmarks.paper import runs
from benchmarks.paper.imitation import SCRIPTED, ImitationRun
from benchmarks.paper.recipes import PRESETS, SETTINGS, DataSetting, Execution, Member
from benchmarks.paper.stacked import StackedBehavioralCloning
from lw_torchrl.modules import Concat, FocusFeatures, MLPDecoder, ObservationFeatures, plans_of
from lw_torchrl.transforms import SwapUnmentioned

MT10 = lw.load_plans("MT10")
TASKS = ("push", "reach", "window-open")
PLANS = lw.Plans([MT10[task] for task in TASKS])
TINY = DataSetting("tiny", "reach", 2)
TINY_ONE_SHOT = DataSetting("tiny-one-shot", "reach", 2, targets="push")
FOCUS = {"focus": True, "canonical": True, "swap_unmentioned": 0.5}
MEMBER = Member({"features": "differences", "width": 32, "depth": 1}, FOCUS)
TRAINING = lw.BehavioralCloningConfig(steps=30, batch_size=20, checkpoint_every=10)
PARTS = {"target": Execution("target", (0.0,)), "members": (MEMBER,), "training": TRAINING}
PRESET = replace(PRESETS["strong"]["few-shot"], **PARTS)
ROLES = {"features": "opening", "roles": True, "jitter": 0.03, "any_yaw": True}
OTHER = Member({"features": "relative", "width": 16, "depth": 1, "yaw": 0.3}, ROLES)
ENSEMBLE = replace(PRESET, name="ensemble", members=(MEMBER, OTHER))
WATCHED = replace(PRESET, name="watched", evaluations=4)


def a_run(method="pcbc", setting=TINY, preset=PRESET):
    return ImitationRun(setting, method, 3, preset, episodes=2)


def execute(run, out):
    """Execute a run with demonstrations of 100 steps and evaluation episodes of 40."""
    collect, evaluate = partial(lw.collect_demonstrations, max_steps=100), partial(runs.evaluate, max_steps=40)
    with patch.multiple(runs, collect_demonstrations=collect, evaluate=evaluate):
        return runs.execute_run(run, PLANS, out, tasks=run.setting.targets or "reach", progress=False)


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


RUNS = [*map(a_run, ("pcbc", "dc", "one-hot", SCRIPTED)), a_run(setting=TINY_ONE_SHOT), a_run(preset=WATCHED)]
RUNS += [a_run(setting=setting, preset=ENSEMBLE) for setting in (TINY, TINY_ONE_SHOT)]
by_name = pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.setting.name} {run.preset.name} {run.method}")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    for run in RUNS:
        execute(run, out)
    return out


@by_name
def test_finished_run_is_not_repeated(undisturbed, run, monkeypatch):
    episodes, config = result_of(undisturbed / run.folder)
    assert [episode["task"] for episode in episodes] == [run.setting.targets or "reach"] * 2
    assert (config["seed"], config["noise_scale"], config["run"]["method"]) == (10_003, 0.1, run.method)
    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    assert len(execute(run, undisturbed).episodes) == 2
    assert not list((undisturbed / run.folder).glob("checkpoint*"))


STOPS = [(TINY_ONE_SHOT, PRESET, 23, 33), (TINY, ENSEMBLE, 53, 63), (TINY, WATCHED, 29, 31)]
STOPS += [pytest.param(TINY_ONE_SHOT, ENSEMBLE, 53, 63, marks=pytest.mark.slow)]


@pytest.mark.parametrize(("setting", "preset", "stop", "steps"), STOPS)
def test_stopped_run_resumes_to_the_same_result(undisturbed, tmp_path, monkeypatch, setting, preset, stop, steps):
    run = a_run(setting=setting, preset=preset)
    count = stop_training(monkeypatch, setting, stop)
    with pytest.raises(KeyboardInterrupt):
        execute(run, tmp_path)
    execute(run, tmp_path)
    assert count[0] == steps, "it resumes from the last checkpoint"
    assert result_of(tmp_path / run.folder) == result_of(undisturbed / run.folder)


@pytest.mark.parametrize("name", PRESETS)
def test_every_recipe_loads_and_makes_its_policies(name):
    for setting, preset in PRESETS[name].items():
        assert SETTINGS[setting].targets is None or preset.target is not None
        for member in (*preset.members, *preset.demonstrated):
            for method in ("pcbc", "dc"):
                parts = member.of(method)
                actor = parts.actor(method, parts.seen(PLANS))
                assert (plans_of(actor) is None) == (method == "dc")
                assert parts.transform(actor) is not None
        assert ImitationRun(SETTINGS[setting], "pcbc", 0, preset).describe(PLANS)["training"]


HUNDRED = lw.BehavioralCloningConfig(steps=100, batch_size=30, seed=5)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("stacked") / "demos"
    lw.collect_demonstrations(TASKS, episodes_per_task=2, root=root, max_steps=100, progress=False)
    return root


def replay(demos, kind):
    swapped = [SwapUnmentioned(MT10, 0.5)] if kind == "focused plan" else []
    turned = Compose(lw.QAFTransform(MT10), lw.RandomYaw(0.3), *swapped)
    return lw.LanguageWorldExperienceReplay(demos, sampler=lw.TaskBalancedSampler(), transform=turned, after_success=20)


def make(kind, seed):
    """An actor without noise, whose draws one call for all actors does not make alike."""
    torch.manual_seed(seed)
    features, decoder = ObservationFeatures(), MLPDecoder(width=32)
    if kind in ("description", "one-hot"):
        return lw.modules.DescriptorConditionedActor(TASKS, condition=kind, features=features, decoder=decoder)
    if kind == "focused plan":
        features = Concat(features, FocusFeatures(MT10))
    return lw.PlanConditionedActor(MT10, features=features, decoder=decoder)


@pytest.mark.parametrize("kind", first_fast(["plan", "focused plan", "description", "one-hot"]))
def test_losses_are_those_of_separate_trainings(demos, kind):
    actors, replays = [make(kind, seed) for seed in range(3)], [replay(demos, kind) for _ in range(3)]
    together = StackedBehavioralCloning(actors, replays, HUNDRED, progress=False)
    losses = torch.stack([together.step() for _ in range(HUNDRED.steps)])
    assert losses[-10:].mean() < losses[:10].mean() / 2
    for number in range(3):
        config = lw.BehavioralCloningConfig(**{**vars(HUNDRED), "seed": HUNDRED.seed + number})
        alone = lw.BehavioralCloningTrainer(make(kind, number), replay(demos, kind), config, progress=False)
        assert (losses[:, number] - torch.tensor([alone.step() for _ in range(HUNDRED.steps)])).abs().max() < 1e-5
