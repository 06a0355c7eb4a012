"""Behavioral cloning learns, and refuses actors and buffers that do not fit."""

import math

import pytest
import torch
from small_training import CONFIG, PLANS, ScalarLog, assert_same, everything, make_actor, make_replay, make_trainer
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import lw_torchrl as lw
from lw_torchrl.data import TaskBalancedSampler
from lw_torchrl.training import BehavioralCloningConfig, BehavioralCloningTrainer


def test_the_loss_falls(demos):
    config = BehavioralCloningConfig(steps=300, batch_size=32, learning_rate=3e-3)
    trainer = make_trainer(demos, config=config)
    before = [trainer.step() for _ in range(5)]
    after = trainer.train()
    assert after < 0.5 * sum(before) / 5
    assert trainer.steps == 300
    data = make_replay(demos)[:]
    error = (trainer.actor(data.exclude("action"))["action"] - data["action"]).square().mean().item()
    assert error < 0.5 * sum(before) / 5, "the actor itself has learned"
    assert not trainer.actor.training


@pytest.mark.parametrize("loss_function", ["l1", "l2", "smooth_l1"])
def test_the_first_loss_is_the_distance_to_the_experts_action(demos, loss_function):
    config = BehavioralCloningConfig(steps=1, batch_size=8, loss_function=loss_function)
    trainer = make_trainer(demos, config=config, actor=make_actor(noise=0.0))
    with torch.random.fork_rng():
        torch.manual_seed(0)  # step 0 of seed 0
        batch = make_replay(demos).sample(8)
    with torch.no_grad():
        action = trainer.actor(batch.exclude("action"))["action"]
    expected = getattr(nn.functional, {"l1": "l1_loss", "l2": "mse_loss"}.get(loss_function, "smooth_l1_loss"))
    assert trainer.train() == pytest.approx(expected(action, batch["action"]).item(), rel=1e-5)


def test_the_learning_rate_is_a_cosine_to_zero(demos):
    trainer = make_trainer(demos)
    [group] = trainer.optimizer.param_groups
    rates = [group["lr"]]
    for _ in range(CONFIG.steps):
        trainer.step()
        rates.append(group["lr"])
    cosine = [(1 + math.cos(math.pi * step / CONFIG.steps)) / 2 for step in range(CONFIG.steps + 1)]
    assert rates == pytest.approx([CONFIG.learning_rate * factor for factor in cosine], rel=1e-4, abs=1e-9)
    assert (type(trainer.optimizer), group["weight_decay"]) == (torch.optim.AdamW, CONFIG.weight_decay)


def test_only_parameters_change_after_the_normalization_is_fitted(demos):
    trainer, expected = make_trainer(demos), make_actor()
    expected.features.fit(make_replay(demos)[:])
    before = {name: value.clone() for name, value in trainer.actor.named_parameters()}
    trainer.train()
    assert_same(dict(trainer.actor.named_buffers()), dict(expected.named_buffers()))
    assert not any(torch.equal(value, before[name]) for name, value in trainer.actor.named_parameters())


def test_any_module_that_writes_an_action_can_be_trained(demos, tmp_path):
    torch.manual_seed(0)
    actor = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    trainer = make_trainer(demos, tmp_path / "policy.safetensors", actor=actor)
    assert trainer.train() < 1.0
    rows = trainer.replay[:].select("observation")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    assert torch.equal(loaded(rows.clone())["action"], trainer.actor(rows)["action"])


def test_evaluations_are_logged_and_do_not_change_the_training(demos, uninterrupted):
    logger, modes = ScalarLog(), []

    def evaluate():
        modes.append(trainer.actor.training)
        torch.rand(3)  # random numbers of an evaluation are not those of the training
        return {"success": 0.25 * len(modes)}

    trainer = make_trainer(demos, logger=logger, evaluate=evaluate, evaluate_every=5)
    trainer.train()
    rates = [scalar[1:] for scalar in logger.scalars if scalar[0] == "evaluation/success"]
    assert (rates, modes) == ([(5, 0.25), (10, 0.5), (12, 0.75)], [False, False, False])
    assert_same(everything(trainer), uninterrupted)
    with pytest.raises(ValueError, match="evaluate_every"):
        make_trainer(demos, evaluate_every=5)


@pytest.mark.parametrize(("key", "message"), [("action", "loss is nan at step 0"), ("observation", "observation")])
def test_nan_in_the_demonstrations_is_an_error_that_changes_no_weights(demos, tmp_path, key, message):
    rows, actor, path = make_replay(demos)[:].clone(), make_actor(), tmp_path / "checkpoint.safetensors"
    before = {name: value.clone() for name, value in actor.named_parameters()}
    rows[key][3, 1] = torch.nan
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=TaskBalancedSampler())
    replay.extend(rows)
    config = BehavioralCloningConfig(steps=5, batch_size=len(rows))
    with pytest.raises(ValueError, match=message):
        BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False).train()
    assert_same(dict(actor.named_parameters()), before)
    assert not path.exists()


def test_a_buffer_of_other_plans_of_the_same_length_is_refused(demos):
    """The answers have the right shape but belong to other conditions, so the mistake would pass unnoticed."""
    plans = lw.Plans({**PLANS, "reach": lw.ConditionalPlan("reach", PLANS["reach"].steps[::-1])})
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(plans))
    with pytest.raises(ValueError, match=r"PlanConditionedActor's plans; they differ in reach"):
        BehavioralCloningTrainer(make_actor(), replay, CONFIG)
