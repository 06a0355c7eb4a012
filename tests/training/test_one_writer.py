"""A checkpoint is written by one training at a time, whichever trainer it is, and says under which versions."""

from __future__ import annotations

import importlib.metadata

import pytest
import torch
from small_training import CONFIG, PLANS, collect_demos, make_actor, make_replay, make_trainer

import lw_torchrl as lw
from lw_torchrl.training.cloning import bc_loss

OFFLINE = lw.OfflineConfig(steps=12, batch_size=8, checkpoint_every=5)
EVALUATOR = lw.training.QueryEvaluatorConfig(steps=12, batch_size=8, held_out_pairs=0.0)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("writers") / "demos")


def offline(demos, path):
    return lw.OfflineTrainer(bc_loss(make_actor(), "l2"), make_replay(demos), OFFLINE, checkpoint=path, progress=False)


def evaluator(demos, path):
    data = lw.training.LabelledQueries(lw.LanguageWorldExperienceReplay(demos, label="executed"), EVALUATOR)
    torch.manual_seed(0)
    asked = lw.StateQueryEvaluator(PLANS, width=8, depth=1)
    return lw.training.QueryEvaluatorTrainer(asked, data, EVALUATOR, checkpoint=path, progress=False)


TRAINERS = {"cloning": make_trainer, "offline": offline, "evaluator": evaluator}
FILES = {"offline": ["policy.safetensors"]}
BOTH = ["policy.safetensors", "policy.training.safetensors"]


@pytest.mark.parametrize("name", TRAINERS)
def test_one_training_at_a_time_writes_a_checkpoint(demos, tmp_path, holding, monkeypatch, name):
    make, path = TRAINERS[name], tmp_path / "policy.safetensors"
    trainer = make(demos, path)
    release = holding(path)
    with pytest.raises(ValueError, match=f"checkpoint: another training is writing to '{path}'; let it finish"):
        trainer.train()
    assert not path.exists()
    release()
    trainer.train()
    assert sorted(file.name for file in tmp_path.iterdir()) == FILES.get(name, BOTH)
    assert make(demos, path).steps == CONFIG.steps
    real = importlib.metadata.version
    monkeypatch.setattr(
        "lw_torchrl._util.reproducibility.version", lambda name: "9.9.9" if name == "torch" else real(name)
    )
    with pytest.warns(UserWarning, match=r"under other versions \(torch .*, now 9.9.9\): training continues") as caught:
        make(demos, path)
    assert len(caught) == 1


def test_a_policy_without_a_training_state_is_not_overwritten(demos, tmp_path):
    path = tmp_path / "policy.safetensors"
    lw.save_actor(make_actor(), path)
    with pytest.raises(ValueError, match=r"exists, but not its training state '.*policy\.training\.safetensors'"):
        make_trainer(demos, path)


@pytest.mark.parametrize("name", TRAINERS)
def test_what_another_training_wrote_meanwhile_is_kept(demos, tmp_path, name):
    make, path = TRAINERS[name], tmp_path / "policy.safetensors"
    first, second = make(demos, path), make(demos, path)
    first.train()
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(ValueError, match="was written by another training after this one began"):
        second.train()
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    first.train()
    make(demos, path).train()
