"""Terms on skills' latents in training: weight 0 changes nothing, others add to the loss."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest
import torch
from small_training import CONFIG, assert_same, collect_demos, everything, make_actor, make_replay, make_trainer

import lw_torchrl as lw
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.training.files import read_description

BEFORE = {
    *("steps", "batch_size", "learning_rate", "optimizer", "weight_decay", "momentum", "schedule", "normalize"),
    *("loss_function", "max_grad_norm", "seed", "checkpoint_every"),
}
"""What a checkpoint said of its training before there were these terms."""
ON = replace(CONFIG, latent_consistency=0.5, latent_contrast=0.25)


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("latents") / "demos")


def terms(actor, consistency=0.5, contrast=0.25):
    near, apart = (
        lw.objectives.SkillLatentLoss(actor, kind)()["loss_latents"] for kind in ("consistency", "contrastive")
    )
    return consistency * near + contrast * apart


@pytest.mark.parametrize("weights", [(0.5, 0.0), (0.0, 0.25), (0.5, 0.25)])
def test_a_step_is_of_the_sum(demos, weights):
    """By one step of plain descent, as far as its gradient says."""
    config = replace(CONFIG, optimizer="sgd", momentum=0.0, weight_decay=0.0, schedule="constant", max_grad_norm=1e9)
    plain = make_trainer(demos, config=config)
    changed = dict(zip(("latent_consistency", "latent_contrast"), weights, strict=True))
    trainer = make_trainer(demos, config=replace(config, **changed))
    before = {name: p.detach().clone() for name, p in plain.actor.named_parameters()}
    added = terms(trainer.actor, *weights)
    gradients = torch.autograd.grad(added, list(trainer.actor.encoder.texts.parameters()))
    found = trainer.step() - plain.step()
    torch.testing.assert_close(found, added.detach(), atol=1e-6, rtol=1e-5)
    own, other = dict(trainer.actor.named_parameters()), dict(plain.actor.named_parameters())
    for (name, _), gradient in zip(trainer.actor.encoder.texts.named_parameters(), gradients, strict=True):
        path = f"encoder.texts.{name}"
        assert not torch.equal(own[path], before[path])
        torch.testing.assert_close(other[path] - own[path], config.learning_rate * gradient, atol=1e-6, rtol=1e-4)
    assert all(torch.equal(own[name], other[name]) for name in own if not name.startswith("encoder.texts"))


def test_training_with_it_keeps_near_what_is_near(demos):
    found = []
    for config in (replace(CONFIG, steps=60), replace(CONFIG, steps=60, latent_consistency=10.0)):
        trainer = make_trainer(demos, config=config)
        trainer.train()
        found.append(terms(trainer.actor, 1.0, 0.0).item())
    assert found[1] < found[0] / 2


@pytest.mark.parametrize("stop", [5, 8])
def test_stopped_and_started_again_it_ends_with_the_same_bits(demos, tmp_path, stop):
    whole = make_trainer(demos, config=ON)
    whole.train()
    path = tmp_path / "checkpoint.zip"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, config=ON, stop_at=stop).train()
    resumed = make_trainer(demos, path, config=ON, actor=make_actor(99))
    assert resumed.steps == 5
    resumed.train()
    assert_same(everything(resumed), everything(whole))


def test_without_it_files_say_what_they_said_and_no_term_is_taken(demos, tmp_path, monkeypatch):
    """A file from before goes on, and so does one of now in the library of before."""
    path = tmp_path / "c.zip"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, stop_at=7).train()
    assert set(read_description(path)["training"]) == BEFORE
    assert set(asdict(CONFIG)) == {*BEFORE, "latent_consistency", "latent_contrast", "qaf_anchor"}
    monkeypatch.setattr("lw_torchrl.training.behavioral_cloning.latent_term", None)  # it is never asked
    never = make_trainer(demos)
    never.train()
    resumed = make_trainer(demos, path)
    resumed.train()
    assert_same(everything(resumed), everything(never))


def test_a_checkpoint_of_another_weight_is_refused(demos, tmp_path):
    for number, (one, other) in enumerate([(CONFIG, ON), (ON, CONFIG), (ON, replace(ON, latent_contrast=0.5))]):
        path = tmp_path / f"{number}.zip"
        make_trainer(demos, path, config=one).save()
        with pytest.raises(ValueError, match=r"of another configuration, its training differs in latent_con"):
            make_trainer(demos, path, config=other)


@pytest.mark.parametrize("option", ["latent_consistency", "latent_contrast"])
def test_what_is_refused(demos, option):
    for wrong in (-1.0, float("nan")):
        with pytest.raises(ValueError, match=f"{option} must be finite"):
            BehavioralCloningConfig(**{option: wrong})
    config = replace(CONFIG, **{option: 0.1})
    problem = f"{option} is for policies with plans, whose skills have latents; DescriptorConditionedActor has none"
    with pytest.raises(ValueError, match=problem):
        BehavioralCloningTrainer(lw.DescriptorConditionedActor("MT10"), make_replay(demos), config)
    BehavioralCloningTrainer(lw.DescriptorConditionedActor("MT10"), make_replay(demos), CONFIG)
