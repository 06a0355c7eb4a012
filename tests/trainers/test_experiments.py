"""The experiments' units: resumed anywhere they end with the same result."""

import json
from dataclasses import replace

import pytest

import lw_torchrl as lw
from lw_torchrl.trainers import experiments
from lw_torchrl.trainers.experiments import METHODS, PRESETS, SETTINGS, DataSetting, Unit, run_unit

PLANS = lw.load_plans("MT50")
TINY = DataSetting("tiny", "reach", 2)
PRESET = replace(
    PRESETS["strong"],
    actor={"features": "differences", "width": 32, "depth": 1},
    training=lw.BehavioralCloningConfig(steps=60, batch_size=20, checkpoint_every=20),
)


def unit(method="pcbc", seed=3):
    return Unit(TINY, method, seed, PRESET, episodes=2)


def rates(path):
    found = json.loads((path / "results.json").read_text())
    return found["episodes"], found["config"]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed")
    for method in METHODS:
        run_unit(unit(method), PLANS, out, tasks="reach", progress=False)
    return out


@pytest.mark.parametrize("method", METHODS)
def test_a_unit_leaves_its_result_and_is_not_done_twice(undisturbed, method, monkeypatch):
    one = unit(method)
    assert one.folder.as_posix() == f"tiny/strong/{method}/seed3"
    episodes, config = rates(undisturbed / one.folder)
    assert len(episodes) == 2
    assert (config["seed"], config["noise_scale"]) == (10_003, 0.1)
    monkeypatch.setattr(experiments, "evaluate", lambda *_, **__: pytest.fail("evaluated again"))
    again = run_unit(one, PLANS, undisturbed, tasks="reach", progress=False)
    assert len(again.episodes) == 2


def test_stopped_in_training_and_resumed_it_ends_the_same(undisturbed, tmp_path, monkeypatch):
    step = lw.BehavioralCloningTrainer.step

    def stops(self):
        if self.state.step == 45:
            raise KeyboardInterrupt
        return step(self)

    monkeypatch.setattr(lw.BehavioralCloningTrainer, "step", stops)
    with pytest.raises(KeyboardInterrupt):
        run_unit(unit(), PLANS, tmp_path, tasks="reach", progress=False)
    monkeypatch.setattr(lw.BehavioralCloningTrainer, "step", step)
    run_unit(unit(), PLANS, tmp_path, tasks="reach", progress=False)
    assert rates(tmp_path / unit().folder) == rates(undisturbed / unit().folder)


def test_methods_share_demonstrations_and_seeds_do_not(undisturbed):
    assert [path.name for path in (undisturbed / "demonstrations").iterdir()] == ["tiny-strong-seed3"]
    assert unit(seed=4).data != unit().data


def test_settings_are_the_papers():
    assert (SETTINGS["zero-shot"].base, SETTINGS["zero-shot"].episodes) == ("MT10", 100)
    assert (SETTINGS["few-shot"].base, SETTINGS["few-shot"].episodes) == ("MT50", 10)
    paper = PRESETS["paper"]
    assert (paper.training.optimizer, paper.training.learning_rate, paper.training.momentum) == ("sgd", 1e-5, 0.995)
    assert paper.actor["width"] == (128, 128, 128, 64, 32)
    assert (paper.actor["encoder_width"], paper.actor["encoder_depth"]) == (64, 3)
    assert paper.passes == 500
    with pytest.raises(ValueError, match=r"method must be one of 'pcbc', .*did you mean 'pcbc'"):
        Unit(TINY, "pbc", 0, PRESET)


def test_passes_count_rows(tmp_path, monkeypatch):
    steps = []
    monkeypatch.setattr(lw.BehavioralCloningTrainer, "train", lambda self: steps.append(self.config.steps))
    run_unit(replace(unit(), preset=replace(PRESET, passes=2)), PLANS, tmp_path, tasks="reach", progress=False)
    rows = len(lw.LanguageWorldExperienceReplay(tmp_path / unit().data, after_success=20))
    assert steps == [2 * rows // 20]
