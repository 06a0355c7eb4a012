"""Runs of the paper's experiments: done once, and resumed to the same result."""

import shutil

import pytest
from tiny_runs import (
    ENSEMBLE,
    PLANS,
    PRESET,
    TINY,
    TINY_ONE_SHOT,
    WATCHED,
    a_run,
    execute,
    result_of,
    stop_training,
)  # fmt: skip

import lw_torchrl as lw
from benchmarks.paper import runs
from benchmarks.paper.imitation import SCRIPTED, ImitationRun
from benchmarks.paper.recipes import PRESETS, SETTINGS
from lw_torchrl.modules import plans_of

RUNS = [
    *(a_run(method) for method in ("pcbc", "dc", "one-hot", SCRIPTED)),
    a_run(setting=TINY_ONE_SHOT),
    *(a_run(setting=setting, preset=ENSEMBLE) for setting in (TINY, TINY_ONE_SHOT)),
    a_run(preset=WATCHED),
]
by_name = pytest.mark.parametrize("run", RUNS, ids=lambda run: f"{run.setting.name} {run.preset.name} {run.method}")


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
