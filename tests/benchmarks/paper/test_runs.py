"""Runs of the paper's experiments: done once, and resumed to the same result."""

import shutil
from dataclasses import replace

import pytest
from tiny_runs import (
    ENSEMBLE,
    MEMBER,
    OTHER,
    PLANS,
    PRESET,
    ROLES,
    TINY,
    TINY_ONE_SHOT,
    WATCHED,
    a_run,
    execute,
    result_of,
    stop_training,
)  # fmt: skip

import lw_torchrl as lw
from benchmarks.paper import imitation, runs
from benchmarks.paper.imitation import SCRIPTED, ImitationRun
from benchmarks.paper.recipes import PRESETS, SETTINGS, Member
from benchmarks.paper.runs import load_result
from lw_torchrl.modules import plans_of
from lw_torchrl.training.checkpoint import demonstration_seeds

RUNS = [
    *(a_run(method) for method in ("pcbc", "dc", "one-hot", SCRIPTED)),
    a_run(setting=TINY_ONE_SHOT),
    *(a_run(setting=setting, preset=ENSEMBLE) for setting in (TINY, TINY_ONE_SHOT)),
    a_run(preset=WATCHED),
]
by_name = pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.setting.name} {run.preset.name} {run.method}")
by_setting = pytest.mark.parametrize(
    ("setting", "file"), [(TINY, "policy.safetensors"), (TINY_ONE_SHOT, "models/push.safetensors")]
)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    for run in RUNS:
        execute(run, out)
    return out


@pytest.fixture
def copied(undisturbed, tmp_path):
    return shutil.copytree(undisturbed, tmp_path / "copied")


@by_name
def test_finished_run_is_not_repeated(undisturbed, run, monkeypatch):
    episodes, config = result_of(undisturbed / run.folder)
    assert [episode["task"] for episode in episodes] == [run.setting.targets or "reach"] * 2
    assert (config["seed"], config["noise_scale"], config["run"]["method"]) == (10_003, 0.1, run.method)
    monkeypatch.setattr(runs, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    assert len(execute(run, undisturbed).episodes) == 2
    assert not list((undisturbed / run.folder).glob("checkpoint*"))


def test_folders_are_named_after_the_options_of_a_run(undisturbed):
    assert a_run().folder.as_posix() == "tiny/strong/pcbc/seed3"
    assert a_run(SCRIPTED, setting=TINY_ONE_SHOT).folder.as_posix() == "scripted/seed3"
    assert replace(a_run(), plans_name="palm").folder.as_posix() == "tiny/strong-palm/pcbc/seed3"
    folders = {path.name for path in (undisturbed / "demonstrations").iterdir() if path.name[0] != "."}
    assert folders == {"reachx2-astray-seed3", "pushx1-target-seed3"}


def test_result_of_another_configuration_raises(copied):
    longer = replace(PRESET, training=replace(PRESET.training, steps=61))
    with pytest.raises(ValueError, match=r"of another configuration, it differs in training.steps \(60, now 61\)"):
        execute(a_run("dc", preset=longer), copied)
    with pytest.raises(ValueError, match="differs in plans;"):
        load_result(a_run(), lw.load_plans("MT50", skills="MT10"), copied)
    with pytest.raises(ValueError, match=r"differs in tasks \(\['reach'\], now \['push'\]\)"):
        execute(a_run(), copied, tasks="push")
    # The description of a task is not part of the plans' fingerprint.
    reach = replace(lw.TASKS["reach"], description="Go there.")
    described = lw.Plans({**PLANS, "reach": lw.ConditionalPlan("reach", PLANS["reach"].steps, reach)})
    with pytest.raises(ValueError, match="differs in own_tasks"):
        load_result(a_run("dc"), described, copied)
    (copied / a_run("dc").folder / "results.json").unlink()
    with pytest.raises(ValueError, match="has a different configuration: its run differs in training"):
        execute(a_run("dc", preset=longer), copied)


@pytest.mark.parametrize(
    ("setting", "preset", "stop", "steps"),
    [
        (TINY_ONE_SHOT, PRESET, 46, 66),
        (TINY, ENSEMBLE, 106, 126),
        (TINY, WATCHED, 57, 61),
        pytest.param(TINY_ONE_SHOT, ENSEMBLE, 106, 126, marks=pytest.mark.slow),
    ],
)
def test_stopped_run_resumes_to_the_same_result(undisturbed, tmp_path, monkeypatch, setting, preset, stop, steps):
    run = a_run(setting=setting, preset=preset)
    count = stop_training(monkeypatch, setting, stop)
    with pytest.raises(KeyboardInterrupt):
        execute(run, tmp_path)
    execute(run, tmp_path)
    assert count[0] == steps, "it resumes from the last checkpoint"
    assert result_of(tmp_path / run.folder) == result_of(undisturbed / run.folder)


def test_several_evaluations_leave_the_policy_unchanged_and_are_counted(undisturbed, copied):
    watched, plain = (undisturbed / a_run(preset=preset).folder for preset in (WATCHED, PRESET))
    assert result_of(watched)[0] == result_of(plain)[0]
    files = sorted((watched / "evaluations").iterdir())
    assert [file.stem for file in files] == ["53", "56", "58"]
    rates = [lw.EvaluationResult.load(file).success_once["reach"] for file in (*files, watched / "results.json")]
    assert result_of(watched)[1]["best"] == {"of": 4, "rates": {"reach": max(rates)}}
    assert PRESETS["paper"]["few-shot"].evaluated_before(500_000) == [*range(320_000, 500_000, 20_000)]


@by_setting
def test_trained_policies_are_kept_and_not_trained_again(copied, setting, file, monkeypatch):
    run = a_run(setting=setting, preset=ENSEMBLE)
    policy = lw.load_actor(copied / run.folder / file)
    assert [actor.decoder.network.config["width"] for actor in policy.members] == [32, 16]
    assert demonstration_seeds(copied / run.folder / file) == {3}
    before = result_of(copied / run.folder)
    (copied / run.folder / "results.json").unlink()
    monkeypatch.setattr(imitation.Parts, "actor", lambda *_, **__: pytest.fail("trained again"))
    execute(run, copied)
    assert result_of(copied / run.folder) == before


def test_actors_of_descriptions_act_in_demonstrated_tasks(tmp_path):
    turned = replace(OTHER, plan_parts={**ROLES, "any_yaw": False, "yaw": 10.0, "tilt": 0.5})
    run = a_run(preset=replace(PRESET, name="seen", members=(turned, turned), demonstrated=(MEMBER,)))
    execute(run, tmp_path)
    policy = lw.load_actor(tmp_path / run.folder / "policy.safetensors")
    assert isinstance(policy, lw.modules.DemonstratedActor)
    assert isinstance(policy.others, lw.modules.ActorEnsemble)
    assert (policy.demonstrated.tasks, len(policy.tasks)) == (("reach",), 50)


def test_preset_can_add_an_evaluator_to_the_policy(tmp_path):
    member = Member({"width": 32, "depth": 1}, {"evaluator": {"width": 16, "depth": 1}})
    training = replace(PRESET.training, steps=2, qaf_anchor=1.0)
    run = a_run(preset=replace(PRESET, name="evaluator", members=(member,), training=training))
    execute(run, tmp_path)
    policy = lw.load_actor(tmp_path / run.folder / "policy.safetensors")
    assert policy[0].config["width"] == 16
    assert "qaf" not in policy.in_keys


@pytest.mark.parametrize("name", PRESETS)
def test_every_recipe_loads_and_makes_its_policies(name):
    for setting, preset in PRESETS[name].items():
        assert SETTINGS[setting].targets is None or preset.target is not None
        for member in (*preset.members, *preset.demonstrated):
            for method in ("pcbc", "dc"):
                parts = member.of(method)
                plans = parts.seen(lw.load_plans("MT10"))
                actor = parts.actor(method, plans)
                assert (plans_of(actor) is None) == (method == "dc")
                assert parts.transform(actor) is not None
        assert ImitationRun(SETTINGS[setting], "pcbc", 0, preset).describe(PLANS)["training"]


def test_settings_are_the_papers():
    assert (SETTINGS["zero-shot"].base, SETTINGS["zero-shot"].episodes) == ("MT10", 100)
    assert (SETTINGS["few-shot"].base, SETTINGS["few-shot"].episodes) == ("MT50", 10)
    assert (SETTINGS["one-shot"].base, SETTINGS["one-shot"].targets) == ("MT10", "MT50")
    paper = PRESETS["paper"]["few-shot"]
    assert (paper.training.optimizer, paper.training.learning_rate, paper.training.momentum) == ("sgd", 1e-5, 0.995)
    assert paper.members[0].of("dc").width == (128, 128, 128, 64, 32)
    assert (paper.passes, paper.base.noise_scale) == (500, (0.0,))
    assert {preset["one-shot"].training.batch_size % 180 for preset in PRESETS.values() if "one-shot" in preset} == {0}


def test_passes_count_rows(undisturbed, tmp_path, monkeypatch):
    (tmp_path / "demonstrations").symlink_to(undisturbed / "demonstrations")
    steps = []

    def see(actor, replay, config, **_):
        steps.append(config.steps)
        raise KeyboardInterrupt

    monkeypatch.setattr(imitation, "BehavioralCloningTrainer", see)
    with pytest.raises(KeyboardInterrupt):
        execute(a_run(preset=replace(PRESET, passes=2)), tmp_path)
    rows = len(lw.LanguageWorldExperienceReplay(tmp_path / a_run().datasets[0].folder, after_success=20))
    assert steps == [2 * rows // 20]
