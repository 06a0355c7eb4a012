"""Behavioral cloning: it learns, and says what is wrong with what it is given."""

from __future__ import annotations

import math

import pytest
import torch
from small_training import CONFIG, assert_same, everything, make_actor, make_replay, make_trainer
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.record.loggers import Logger

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
def test_the_first_loss_is_the_named_distance_to_the_experts_action(demos, loss_function):
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
    expected = [
        CONFIG.learning_rate * (1 + math.cos(math.pi * step / CONFIG.steps)) / 2 for step in range(CONFIG.steps)
    ]
    assert rates == pytest.approx(expected, rel=1e-4)
    assert trainer.optimizer.param_groups[0]["lr"] == pytest.approx(0, abs=1e-9)
    assert isinstance(trainer.optimizer, torch.optim.AdamW)
    assert trainer.optimizer.param_groups[0]["weight_decay"] == CONFIG.weight_decay


def test_it_trains_the_networks_and_nothing_else(demos):
    trainer = make_trainer(demos)
    before = {name: value.clone() for name, value in trainer.actor.named_parameters()}
    buffers = {name: value.clone() for name, value in trainer.actor.named_buffers()}
    rows = make_replay(demos)[:]
    trainer.train()
    for name, value in trainer.actor.named_parameters():
        assert not torch.equal(value, before[name]), name
    for name, value in trainer.actor.named_buffers():
        assert torch.equal(value, buffers[name]), name
    assert (make_replay(demos)[:] == rows).all()


def test_the_normalisation_is_fitted_to_the_demonstrations(demos):
    trainer = make_trainer(demos)
    expected = make_actor()
    expected.features.fit(make_replay(demos)[:])
    assert torch.equal(trainer.actor.features.mean, expected.features.mean)
    assert torch.equal(trainer.actor.features.std, expected.features.std)


def test_any_module_that_writes_an_action_can_be_trained(demos, tmp_path):
    def make():
        torch.manual_seed(0)
        return TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])

    class Mine(nn.Linear):
        """A network without a config."""

    path = tmp_path / "policy.safetensors"
    trainer = make_trainer(demos, path, actor=make())
    assert trainer.train() < 1.0
    rows = trainer.replay[:].select("observation")
    assert torch.equal(lw.load_actor(path)(rows.clone())["action"], trainer.actor(rows)["action"])
    actor = TensorDictModule(Mine(39, 4), in_keys=["observation"], out_keys=["action"])
    with pytest.raises(TypeError, match=r"is a .*Mine, which cannot be saved: give it an attribute config"):
        make_trainer(demos, tmp_path / "other.safetensors", actor=actor)


class Kept(Logger):
    """Keeps what is logged."""

    def __init__(self):
        self.scalars = []
        super().__init__("kept", "")

    def _create_experiment(self):
        return None

    def log_scalar(self, name, value, step=None):
        self.scalars.append((name, step, value))

    def log_video(self, *args, **kwargs): ...

    def log_hparams(self, *args, **kwargs): ...

    def log_histogram(self, *args, **kwargs): ...

    def __repr__(self):
        return "Kept()"


def test_a_logger_gets_loss_and_learning_rate(demos):
    logger = Kept()
    config = BehavioralCloningConfig(steps=130, batch_size=8)
    final = make_trainer(demos, config=config, logger=logger).train()
    assert [(name, step) for name, step, _ in logger.scalars] == [
        ("train/loss", 100),
        ("train/learning_rate", 100),
        ("train/loss", 130),
        ("train/learning_rate", 130),
    ]
    assert logger.scalars[2][2] == pytest.approx(final)


def test_evaluations_are_logged_and_change_nothing(demos, undisturbed):
    logger, modes = Kept(), []

    def evaluate():
        modes.append(trainer.actor.training)
        torch.rand(3)  # draws of an evaluation are not those of the training
        return {"success": 0.25 * len(modes)}

    trainer = make_trainer(demos, logger=logger, evaluate=evaluate, evaluate_every=5)
    trainer.train()
    found = [row for row in logger.scalars if row[0] == "evaluation/success"]
    assert found == [("evaluation/success", 5, 0.25), ("evaluation/success", 10, 0.5), ("evaluation/success", 12, 0.75)]
    assert modes == [False, False, False]
    assert_same(everything(trainer), undisturbed)
    with pytest.raises(ValueError, match="evaluate and evaluate_every must be given together"):
        make_trainer(demos, evaluate_every=5)


def test_nan_in_the_demonstrations_is_reported(demos):
    rows = make_replay(demos)[:]

    def train(key, index):
        broken = rows.clone()
        broken[key][index] = torch.nan
        replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=TaskBalancedSampler())
        replay.extend(broken)
        config = BehavioralCloningConfig(steps=5, batch_size=len(rows))
        BehavioralCloningTrainer(make_actor(), replay, config, progress=False).train()

    with pytest.raises(ValueError, match="loss is nan at step 0: the demonstrations hold NaN"):
        train("action", (3, 1))
    with pytest.raises(ValueError, match="observation must hold finite numbers"):
        train("observation", (3, 1))


def test_nan_leaves_weights_and_checkpoint_as_they_were(demos, tmp_path):
    trainer = make_trainer(demos, tmp_path / "checkpoint.safetensors")
    before = {name: value.clone() for name, value in trainer.actor.state_dict().items()}
    real = trainer.replay.sample
    trainer.replay.sample = lambda size: real(size).apply(lambda x: x * torch.nan if x.is_floating_point() else x)
    with pytest.raises(ValueError, match=r"NaN|finite"):
        trainer.train()
    assert all(torch.equal(value, before[name]) for name, value in trainer.actor.state_dict().items())
    assert not (tmp_path / "checkpoint.safetensors").exists()


def test_a_batch_the_tasks_do_not_divide_is_refused(demos):
    config = BehavioralCloningConfig(steps=1, batch_size=7)
    trainer = make_trainer(demos, sampler=TaskBalancedSampler(exact=True), config=config)
    with pytest.raises(ValueError, match=r"batch_size must be a multiple of 2, the number of tasks, got 7.* 6 and 8"):
        trainer.train()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(steps=0), "steps must be at least 1, got 0"),
        (dict(batch_size=0), "batch_size must be at least 1"),
        (dict(checkpoint_every=0), "checkpoint_every must be at least 1"),
        (dict(learning_rate=-1.0), "learning_rate must be finite and at least 0"),
        (dict(learning_rate=float("nan")), "learning_rate"),
        (dict(weight_decay=-1.0), "weight_decay"),
        (dict(max_grad_norm=float("inf")), "max_grad_norm"),
        (dict(loss_function="l3"), "loss_function must be one of 'l1', 'l2', 'smooth_l1', got 'l3'"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        BehavioralCloningConfig(**options)


@pytest.mark.parametrize("options", [dict(steps=1.5), dict(seed="0"), dict(learning_rate="1e-3")])
def test_wrong_types_are_named(options):
    with pytest.raises(TypeError, match=next(iter(options))):
        BehavioralCloningConfig(**options)


def test_the_batch_reaches_the_loss_as_it_was_stored(demos):
    """No string, and nothing beside what the actor reads, is needed."""
    rows = make_replay(demos)[:].select("observation", "task_id", "qaf", "action")
    replay = TensorDictReplayBuffer(storage=LazyTensorStorage(len(rows)), sampler=TaskBalancedSampler())
    replay.extend(TensorDict(rows.to_dict(), rows.batch_size))
    assert BehavioralCloningTrainer(make_actor(), replay, CONFIG, progress=False).train() > 0
