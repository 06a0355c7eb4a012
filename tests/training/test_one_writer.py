"""A checkpoint is written by one training at a time, whichever trainer it is, and says under which versions."""

from __future__ import annotations

import importlib.metadata
import json
import zipfile

import pytest
import torch
from small_training import PLANS, SMALL, collect_demos, make_actor, make_replay, make_trainer

import lw_torchrl as lw
from lw_torchrl._tensor_archive import TensorArchive
from lw_torchrl._versions import package_versions
from lw_torchrl.training.behavioral_cloning import bc_loss

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
of_all = pytest.mark.parametrize("make", TRAINERS.values(), ids=TRAINERS)


@of_all
def test_another_training_is_refused_while_one_is_at_work(demos, tmp_path, holding, make):
    path = tmp_path / "policy.zip"
    trainer = make(demos, path)
    release = holding(path)
    with pytest.raises(ValueError, match=f"checkpoint: another training is at work in '{path}'; let it finish"):
        trainer.train()
    assert not path.exists()
    release()
    trainer.train()
    assert [file.name for file in tmp_path.iterdir()] == ["policy.zip"]
    trainer.train()


@of_all
def test_what_another_training_wrote_meanwhile_is_not_lost(demos, tmp_path, make):
    path = tmp_path / "policy.zip"
    first, second = make(demos, path), make(demos, path)
    first.train()
    before = path.read_bytes()
    with pytest.raises(ValueError, match="was written by another training after this one had begun; begin anew"):
        second.train()
    assert path.read_bytes() == before
    make(demos, path).train()
    path.unlink()
    first.train()


@of_all
def test_a_training_goes_on_under_another_torch_with_a_warning(demos, tmp_path, monkeypatch, make):
    path = tmp_path / "policy.zip"
    make(demos, path).train()
    assert TensorArchive(path).description["versions"] == package_versions()
    real = importlib.metadata.version
    monkeypatch.setattr("lw_torchrl._versions.version", lambda name: "9.9.9" if name == "torch" else real(name))
    message = r"policy.zip' was written under other versions \(torch .*, now 9.9.9\): the training goes on, but its"
    with pytest.warns(UserWarning, match=message) as told:
        make(demos, path)
    assert len(told) == 1
    assert told[0].filename != lw.training.envelope.__file__


@of_all
def test_a_checkpoint_that_says_no_versions_is_gone_on_with(demos, tmp_path, make):
    path, older = tmp_path / "policy.zip", tmp_path / "older.zip"
    make(demos, path).train()
    with zipfile.ZipFile(path) as found, zipfile.ZipFile(older, "w") as written:
        for name in found.namelist():
            content = found.read(name)
            if name == "description.json":
                described = json.loads(content)
                del described["versions"]
                content = json.dumps(described).encode()
            written.writestr(name, content)
    make(demos, older)
    if make is make_trainer:
        lw.load_actor(older)


def test_a_policys_file_says_its_versions(tmp_path):
    lw.save_actor(lw.PlanConditionedActor(PLANS, **SMALL), tmp_path / "policy.zip")
    assert TensorArchive(tmp_path / "policy.zip").description["versions"] == package_versions()
    with pytest.raises(ValueError, match="about must not be named versions"):
        lw.save_actor(lw.PlanConditionedActor(PLANS, **SMALL), tmp_path / "policy.zip", versions={})
