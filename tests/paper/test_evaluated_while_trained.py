"""Presets that evaluate a policy several times while it is trained, as the published figures did."""

import shutil
from dataclasses import replace

import pytest
from lw_torchrl.paper.recipes import PRESETS
from tiny_runs import ENSEMBLE, PRESET, TINY, TINY_ONE_SHOT, a_run, execute, rates, stop_training

import lw_torchrl as lw

WATCHED = replace(PRESET, evaluations=4)
AFTER = [53, 56, 58]  # of 60 steps
by_setting = pytest.mark.parametrize("setting", [TINY, TINY_ONE_SHOT], ids=["for all tasks", "for each task"])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    for setting in (TINY, TINY_ONE_SHOT):
        execute(a_run(setting=setting, preset=WATCHED), out)
    return out


@pytest.fixture
def unfinished(undisturbed, tmp_path):
    """A folder in which a run's policy is trained, and its last evaluation is lacking."""
    shutil.copytree(undisturbed, tmp_path, dirs_exist_ok=True)
    (tmp_path / a_run().folder / "results.json").unlink()
    return tmp_path


def load(folder):
    """Steps to what was measured after them."""
    found = {int(file.stem): lw.EvaluationResult.load(file) for file in (folder / "evaluations").iterdir()}
    return dict(sorted(found.items()))


@by_setting
@pytest.mark.slow
def test_what_is_learned_is_the_same(undisturbed, tmp_path, setting):
    one = a_run(setting=setting)
    plain, watched = execute(one, tmp_path), execute(one, undisturbed, WATCHED)
    assert plain.episodes == watched.episodes
    assert "best" not in plain.config
    found = load(undisturbed / one.folder)
    assert [*found] == AFTER
    task = setting.targets or "reach"
    rates = [result.success_once[task] for result in (*found.values(), watched)]
    assert watched.config["best"] == {"of": 4, "rates": {task: max(rates)}}
    asked = {name: value for name, value in watched.config.items() if name not in ("best", "seconds")}
    assert [result.config for result in found.values()] == [asked] * 3


@pytest.mark.parametrize(
    ("setting", "stop"),
    [
        pytest.param(TINY, 46, marks=pytest.mark.slow),
        (TINY, 57),
        pytest.param(TINY_ONE_SHOT, 46, marks=pytest.mark.slow),
        pytest.param(TINY_ONE_SHOT, 57, marks=pytest.mark.slow),
    ],
)
def test_stopped_and_resumed_it_ends_the_same(undisturbed, tmp_path, monkeypatch, setting, stop):
    one = a_run(setting=setting, preset=WATCHED)
    count = stop_training(monkeypatch, setting, stop)
    with pytest.raises(KeyboardInterrupt):
        execute(one, tmp_path)
    execute(one, tmp_path)
    assert count[0] == 60 + stop - max(saved for saved in (40, *AFTER) if saved < stop)
    assert rates(tmp_path / one.folder) == rates(undisturbed / one.folder)
    assert load(tmp_path / one.folder) == load(undisturbed / one.folder)


def test_an_evaluation_of_another_configuration_is_refused(unfinished):
    (unfinished / a_run().folder / "policy.zip").unlink()
    other = replace(WATCHED, training=replace(WATCHED.training, learning_rate=0.01))
    with pytest.raises(ValueError, match=r"53.json' is of another configuration, it differs in training.learning_rate"):
        execute(a_run(), unfinished, other)


def test_one_that_was_lost_is_not_counted(unfinished):
    (unfinished / a_run().folder / "evaluations" / "56.json").unlink()
    assert execute(a_run(), unfinished, WATCHED).config["best"]["of"] == 3


def test_of_an_ensemble_it_is_refused():
    with pytest.raises(ValueError, match="evaluations must be 1 of 2 members, got 4"):
        replace(ENSEMBLE, evaluations=4)


def test_the_published_recipe_is_evaluated_as_the_published_figures_were():
    """Every 20th of 500 passes, the last ten of which count, by their code and their files of results."""
    paper = PRESETS["paper"]
    steps = {name: preset.evaluated_before(500_000) for name, preset in paper.items()}
    assert {*map(tuple, steps.values())} == {tuple(range(320_000, 500_000, 20_000))}
    assert (paper["zero-shot"].training.batch_size, paper["few-shot"].training.batch_size) == (40, 200)
    assert paper["zero-shot"].evaluated_before(10) == [7, 8, 9]
    assert PRESET.evaluated_before(60) == []
