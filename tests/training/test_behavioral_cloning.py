"""Behavioral cloning learns, and refuses actors and buffers that do not fit."""

import math

import pytest
import torch
from small_training import CONFIG, PLANS, ScalarLog, assert_same, everything, make_actor, make_replay, make_trainer
from tensordict import TensorDict
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
    rates = []
    for _ in range(CONFIG.steps):
        rates.append(trainer.optimizer.param_groups[0]["lr"])
        trainer.step()
    cosine = [(1 + math.cos(math.pi * step / CONFIG.steps)) / 2 for step in range(CONFIG.steps)]
    assert rates == pytest.approx([CONFIG.learning_rate * factor for factor in cosine], rel=1e-4)
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(0, abs=1e-9)
    assert isinstance(trainer.optimizer, torch.optim.AdamW)
    assert trainer.optimizer.param_groups[0]["weight_decay"] == CONFIG.weight_decay


def test_only_the_networks_change(demos):
    trainer = make_trainer(demos)
    parameters = {name: value.clone() for name, value in trainer.actor.named_parameters()}
    buffers = {name: value.clone() for name, value in trainer.actor.named_buffers()}
    rows = make_replay(demos)[:]
    trainer.train()
    for name, value in trainer.actor.named_parameters():
        assert not torch.equal(value, parameters[name]), name
    for name, value in trainer.actor.named_buffers():
        assert torch.equal(value, buffers[name]), name
    assert (make_replay(demos)[:] == rows).all()


def test_the_normalization_is_fitted_to_the_demonstrations(demos):
    trainer = make_trainer(demos)
    expected = make_actor()
    expected.features.fit(make_replay(demos)[:])
    assert torch.equal(trainer.actor.features.mean, expected.features.mean)
    assert torch.equal(trainer.actor.features.std, expected.features.std)


def test_any_module_that_writes_an_action_can_be_trained(demos, tmp_path):
    torch.manual_seed(0)
    actor = TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])
    trainer = make_trainer(demos, tmp_path / "policy.safetensors", actor=actor)
    assert trainer.train() < 1.0
    rows = trainer.replay[:].select("observation")
    loaded = lw.load_actor(tmp_path / "policy.safetensors")
    assert torch.equal(loaded(rows.clone())["action"], trainer.actor(rows)["action"])


def test_a_logger_receives_loss_and_learning_rate(demos):
    logger = ScalarLog()
    config = BehavioralCloningConfig(steps=130, batch_size=8)
    final = make_trainer(demos, config=config, logger=logger).train()
    names = ["train/loss", "train/learning_rate"]
    assert [scalar[:2] for scalar in logger.scalars] == [(name, step) for step in (100, 130) for name in names]
    assert logger.scalars[2][2] == pytest.approx(final)


def test_evaluations_are_logged_and_do_not_change_the_training(demos, uninterrupted):
    logger, modes = ScalarLog(), []

    def evaluate():
        modes.append(trainer.actor.training)
        torch.rand(3)  # random numbers of an evaluation are not those of the training
        return {"success": 0.25 * len(modes)}

    trainer = make_trainer(demos, logger=logger, evaluate=evaluate, evaluate_every=5)
    trainer.train()
    rates = [scalar[1:] for scalar in logger.scalars if scalar[0] == "evaluation/success"]
    assert rates == [(5, 0.25), (10, 0.5), (12, 0.75)]
    assert modes == [False, False, False]
    assert_same(everything(trainer), uninterrupted)
    with pytest.raises(ValueError, match="evaluate_every"):
        make_trainer(demos, evaluate_every=5)


@pytest.mark.parametrize(("key", "message"), [("action", "loss is nan at step 0"), ("observation", "observation")])
def test_nan_in_the_demonstrations_is_an_error(demos, key, message):
    rows = make_replay(demos)[:].clone()
    rows[key][3, 1] = torch.nan
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=TaskBalancedSampler())
    replay.extend(rows)
    config = BehavioralCloningConfig(steps=5, batch_size=len(rows))
    with pytest.raises(ValueError, match=message):
        BehavioralCloningTrainer(make_actor(), replay, config, progress=False).train()


def test_nan_leaves_weights_and_checkpoint_as_they_were(demos, tmp_path):
    trainer = make_trainer(demos, tmp_path / "checkpoint.safetensors")
    before = {name: value.clone() for name, value in trainer.actor.state_dict().items()}
    sample = trainer.replay.sample
    trainer.replay.sample = lambda size: sample(size).apply(lambda x: x * torch.nan if x.is_floating_point() else x)
    with pytest.raises(ValueError, match=r"NaN|finite"):
        trainer.train()
    assert all(torch.equal(value, before[name]) for name, value in trainer.actor.state_dict().items())
    assert not (tmp_path / "checkpoint.safetensors").exists()


def test_a_row_needs_only_the_actors_keys_and_the_action(demos):
    rows = make_replay(demos)[:].select("observation", "task_id", "qaf", "action")
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=TaskBalancedSampler())
    replay.extend(TensorDict(rows.to_dict(), rows.batch_size))
    assert BehavioralCloningTrainer(make_actor(), replay, CONFIG, progress=False).train() > 0


def test_a_buffer_of_other_plans_of_the_same_length_is_refused(demos):
    """The answers have the right shape but belong to other conditions, so the mistake would pass unnoticed."""
    steps = [(str(step.condition), step.skill) for step in PLANS["reach"].steps]
    swapped = [(steps[-1][0], steps[0][1]), *steps[1:-1], (steps[0][0], steps[-1][1])]
    plans = lw.Plans({**PLANS, "reach": lw.ConditionalPlan.from_pairs("reach", swapped)})
    assert plans.num_steps == PLANS.num_steps
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(plans))
    with pytest.raises(ValueError, match=r"the actor's plans, but they differ for reach"):
        BehavioralCloningTrainer(make_actor(), replay, CONFIG)
