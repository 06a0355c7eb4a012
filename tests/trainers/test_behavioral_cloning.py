"""Behavioral cloning: it learns, and stopped anywhere it ends with the same bits."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import textwrap

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, RandomSampler, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.record.loggers import Logger

from lw_torchrl.data import LanguageWorldExperienceReplay, TaskBalancedSampler, collect_demonstrations
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.modules import DescriptorConditionedActor, PlanConditionedActor
from lw_torchrl.trainers import BehavioralCloningConfig, BehavioralCloningTrainer
from lw_torchrl.transforms import QAFTransform, RandomYaw

SMALL = dict(latent_size=4, width=16, depth=1, encoder_width=8)
CONFIG = BehavioralCloningConfig(steps=12, batch_size=8, checkpoint_every=5, learning_rate=1e-2)
PLANS = load_plans("MT10")


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    root = tmp_path_factory.mktemp("trainer") / "demos"
    collect_demonstrations(
        ["push", "reach"], episodes_per_task=2, root=root, max_steps=15, noise_scale=0.2, progress=False
    )
    return root


def make_replay(root, sampler=None):
    return LanguageWorldExperienceReplay(root, sampler=sampler or TaskBalancedSampler(), transform=QAFTransform(PLANS))


def make_actor(seed=0, **options):
    torch.manual_seed(seed)
    return PlanConditionedActor(PLANS, **{**SMALL, **options})


class Stopping(BehavioralCloningTrainer):
    """Stops, as Ctrl-C does, when it gets to a step."""

    stop_at: int | None = None

    def step(self):
        if self.state.step == self.stop_at:
            raise KeyboardInterrupt
        return super().step()


def make_trainer(root, checkpoint=None, *, actor=None, config=CONFIG, sampler=None, stop_at=None, **options):
    actor = make_actor() if actor is None else actor
    trainer = Stopping(actor, make_replay(root, sampler), config, checkpoint=checkpoint, progress=False, **options)
    trainer.stop_at = stop_at
    return trainer


def flat(value, path=()):
    """Every tensor and number of a nested state."""
    if isinstance(value, dict):
        return {key: leaf for name in value for key, leaf in flat(value[name], (*path, str(name))).items()}
    if isinstance(value, (list, tuple)):
        return flat(dict(enumerate(value)), path)
    return {path: value.detach().clone() if isinstance(value, torch.Tensor) else value}


def everything(trainer):
    found = flat(
        {
            "actor": dict(trainer.actor.state_dict()),
            "optimizer": trainer.optimizer.state_dict(),
            "schedule": trainer.schedule.state_dict(),
            "state": trainer.state.state_dict(),
        }
    )
    return found | {("next batch",): trainer.replay.sample(8)["observation"]}


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for key, value in expected.items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(found[key], value), key
        elif isinstance(value, float) and isinstance(found[key], torch.Tensor):
            assert found[key].item() == value, key
        else:
            assert found[key] == value, key


@pytest.fixture(scope="module")
def undisturbed(demos):
    trainer = make_trainer(demos)
    trainer.train()
    return everything(trainer)


# ---- it learns


def test_the_loss_falls(demos):
    config = BehavioralCloningConfig(steps=300, batch_size=32, learning_rate=3e-3)
    trainer = make_trainer(demos, config=config)
    before = [trainer.step() for _ in range(5)]
    after = trainer.train()
    assert after < 0.5 * sum(before) / 5
    assert trainer.state.step == 300
    data = make_replay(demos)[:]
    error = (trainer.actor(data.exclude("action"))["action"] - data["action"]).square().mean().item()
    assert error < 0.5 * sum(before) / 5, "the actor itself has learned"
    assert not trainer.actor.training


@pytest.mark.parametrize("loss_function", ["l1", "l2", "smooth_l1"])
def test_the_first_loss_is_the_named_distance_to_the_experts_action(demos, loss_function):
    config = BehavioralCloningConfig(steps=1, batch_size=8, loss_function=loss_function)
    trainer = make_trainer(demos, config=config, actor=make_actor(feature_noise=0.0))
    replay = make_replay(demos)
    replay.set_rng(torch.Generator().manual_seed(0))
    batch = replay.sample(8)
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


def test_gradients_are_clipped(demos):
    one, other = (
        make_trainer(demos, config=BehavioralCloningConfig(steps=3, batch_size=8, max_grad_norm=norm))
        for norm in (1e-3, 1e9)
    )
    for trainer, clipped in ((one, True), (other, False)):
        trainer.step()
        norm = torch.cat([p.grad.flatten() for p in trainer.loss.parameters()]).norm()
        assert (norm <= 1.001e-3) == clipped


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
    expected.fit_normalization(make_replay(demos)[:]["observation"])
    assert torch.equal(trainer.actor.encoder.features.mean, expected.encoder.features.mean)
    assert torch.equal(trainer.actor.encoder.features.std, expected.encoder.features.std)


def test_the_baseline_trains_too(demos):
    torch.manual_seed(0)
    actor = DescriptorConditionedActor("MT10", **SMALL)
    config = BehavioralCloningConfig(steps=200, batch_size=32, learning_rate=3e-3)
    trainer = BehavioralCloningTrainer(actor, make_replay(demos), config, progress=False)
    before = trainer.step()
    assert trainer.train() < 0.6 * before


def test_any_module_that_writes_an_action_can_be_trained(demos, tmp_path):
    def make():
        torch.manual_seed(0)
        return TensorDictModule(nn.Linear(39, 4), in_keys=["observation"], out_keys=["action"])

    assert make_trainer(demos, None, actor=make()).train() < 1.0
    with pytest.raises(TypeError, match="actor must be a Policy to be kept in a file"):
        make_trainer(demos, tmp_path / "c.zip", actor=make())


def test_the_seed_fixes_the_training(demos, undisturbed):
    trainer = make_trainer(demos)
    trainer.train()
    assert_same(everything(trainer), undisturbed)
    other = make_trainer(demos, config=BehavioralCloningConfig(**{**vars(CONFIG), "seed": 1}))
    other.train()
    assert not torch.equal(everything(other)["next batch",], undisturbed["next batch",])


def test_a_logger_gets_loss_and_learning_rate(demos):
    class Kept(Logger):
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


# ---- stopped and started again


@pytest.mark.parametrize("stops", [[5], [7], [11], [6, 6], [3, 8, 11]])
def test_stopped_anywhere_and_started_again_it_ends_with_the_same_bits(demos, undisturbed, tmp_path, stops):
    path = tmp_path / "runs" / "checkpoint.zip"
    for stop in stops:
        with pytest.raises(KeyboardInterrupt):
            make_trainer(demos, path, stop_at=stop).train()
    resumed = make_trainer(demos, path, actor=make_actor(99))
    assert resumed.state.step == max(stops) // 5 * 5
    resumed.train()
    assert_same(everything(resumed), undisturbed)


def test_what_a_transform_draws_hangs_on_the_seed_and_resumes_too(demos, tmp_path):
    def trainer(noise, checkpoint=None, stop_at=None):
        made = make_trainer(demos, checkpoint, stop_at=stop_at)
        made.replay.append_transform(RandomYaw(0.5))
        torch.manual_seed(noise)  # what else draws in this process must not matter
        return made

    whole = trainer(1)
    whole.train()
    with pytest.raises(KeyboardInterrupt):
        trainer(2, tmp_path / "c.zip", stop_at=7).train()
    resumed = trainer(3, tmp_path / "c.zip")
    resumed.train()
    assert_same(flat(resumed.actor.state_dict()), flat(whole.actor.state_dict()))
    unturned = make_trainer(demos)
    unturned.train()
    assert not torch.equal(unturned.actor.head.network[0].weight, whole.actor.head.network[0].weight)


@pytest.mark.parametrize("sampler", [RandomSampler, SamplerWithoutReplacement])
def test_torchrls_samplers_resume_too(demos, tmp_path, sampler):
    whole = make_trainer(demos, sampler=sampler())
    whole.train()
    path = tmp_path / "checkpoint.zip"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, sampler=sampler(), stop_at=8).train()
    resumed = make_trainer(demos, path, actor=make_actor(99), sampler=sampler())
    assert resumed.state.step == 5
    resumed.train()
    assert_same(everything(resumed), everything(whole))


def test_a_finished_training_does_nothing_twice(demos, undisturbed, tmp_path):
    path = tmp_path / "checkpoint.zip"
    make_trainer(demos, path).train()
    content = path.read_bytes()
    again = make_trainer(demos, path, actor=make_actor(99), stop_at=CONFIG.steps)
    assert math.isnan(again.train())
    assert path.read_bytes() == content
    assert_same(everything(again), undisturbed)


def test_checkpoints_come_in_their_time_and_leave_one_file(demos, tmp_path, monkeypatch):
    saved = []
    save = BehavioralCloningTrainer.save
    monkeypatch.setattr(BehavioralCloningTrainer, "save", lambda self: (saved.append(self.state.step), save(self)))
    make_trainer(demos, tmp_path / "checkpoint.zip").train()
    assert saved == [5, 10, 12]
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint.zip"]


def test_without_a_checkpoint_nothing_is_written(demos, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_trainer(demos).train()
    assert not list(tmp_path.iterdir())


KILLER = """
    import os, random, signal, sys, time
    import torch
    import lw_torchrl as lw

    root, path = sys.argv[1:]
    plans = lw.load_plans("MT10")
    config = lw.BehavioralCloningConfig(steps=40, batch_size=8, checkpoint_every=1)

    def train(path, seed):
        torch.manual_seed(seed)
        actor = lw.PlanConditionedActor(plans, latent_size=4, width=16, depth=1, encoder_width=8)
        replay = lw.LanguageWorldExperienceReplay(
            root, sampler=lw.TaskBalancedSampler(), transform=lw.QAFTransform(plans)
        )
        trainer = lw.BehavioralCloningTrainer(actor, replay, config, checkpoint=path, progress=False)
        trainer.train()
        return {**actor.state_dict(), "batch": replay.sample(8)["observation"]}

    draw, kills, seed = random.Random(0), 0, 0
    for _ in range(12):
        child = os.fork()
        if child == 0:
            try:
                train(path, seed)
            except BaseException as error:
                print(repr(error), file=sys.stderr)
                os._exit(1)
            os._exit(0)
        time.sleep(draw.uniform(0.02, 0.3))
        os.kill(child, signal.SIGKILL)
        status = os.waitpid(child, 0)[1]
        assert not os.WIFEXITED(status) or os.WEXITSTATUS(status) == 0
        kills += os.WIFSIGNALED(status)
        if os.path.exists(path):
            lw.load_actor(path)
            seed = 99
    resumed, whole = train(path, seed), train(None, 0)
    assert all(torch.equal(resumed[key], whole[key]) for key in whole)
    print(kills)
"""


def test_killed_at_any_moment_the_checkpoint_is_whole_and_training_the_same(demos, tmp_path):
    path = tmp_path / "checkpoint.zip"
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(KILLER), str(demos), str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) >= 3


@pytest.mark.parametrize("failing", ["zipfile.ZipFile.writestr", "os.replace"])
def test_a_disk_that_fills_while_saving_leaves_the_old_checkpoint(demos, tmp_path, monkeypatch, failing):
    path = tmp_path / "checkpoint.zip"
    with pytest.raises(KeyboardInterrupt):
        make_trainer(demos, path, stop_at=6).train()
    content = path.read_bytes()

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    resumed = make_trainer(demos, path)
    monkeypatch.setattr(failing, full)
    with pytest.raises(OSError, match="No space left"):
        resumed.save()
    monkeypatch.undo()
    assert path.read_bytes() == content
    assert [found.name for found in tmp_path.iterdir()] == ["checkpoint.zip"]
    assert make_trainer(demos, path).state.step == 5


# ---- what does not fit


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.zip"
    make_trainer(demos, path).train()
    return path


def refused(path, message, make):
    content = path.read_bytes()
    with pytest.raises(ValueError, match=message) as caught:
        make()
    assert path.read_bytes() == content
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("options", "differs"),
    [
        (dict(width=32), "options"),
        (dict(depth=2), "options"),
        (dict(latent_size=5), "options"),
        (dict(mix="actions"), "options"),
        (dict(features="raw"), "options"),
    ],
)
def test_a_checkpoint_of_another_architecture_is_refused(demos, checkpoint, options, differs):
    actor = make_actor(1, **options)
    before = {name: value.clone() for name, value in actor.state_dict().items()}
    refused(
        checkpoint,
        f"of another architecture, its actor differs in {differs}; choose another file, or delete it",
        lambda: make_trainer(demos, checkpoint, actor=actor),
    )
    assert all(torch.equal(value, before[name]) for name, value in actor.state_dict().items())


def test_a_checkpoint_of_other_plans_or_another_kind_is_refused(demos, checkpoint):
    plans = {task: plan for task, plan in PLANS.items() if task in ("push", "reach")}
    refused(
        checkpoint,
        "of another architecture, its actor differs in plans;",
        lambda: make_trainer(demos, checkpoint, actor=PlanConditionedActor(plans, **SMALL)),
    )
    refused(
        checkpoint,
        "of another architecture, its actor differs in kind",
        lambda: make_trainer(demos, checkpoint, actor=DescriptorConditionedActor("MT10", **SMALL)),
    )


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("steps", 13),
        ("batch_size", 6),
        ("learning_rate", 1e-3),
        ("loss_function", "l1"),
        ("seed", 1),
        ("weight_decay", 0.0),
    ],
)
def test_a_checkpoint_of_another_configuration_is_refused(demos, checkpoint, name, value):
    config = BehavioralCloningConfig(**{**vars(CONFIG), name: value})
    refused(
        checkpoint,
        f"of another configuration, its training differs in {name};",
        lambda: make_trainer(demos, checkpoint, config=config),
    )


def test_a_checkpoint_of_other_demonstrations_is_refused(checkpoint, tmp_path):
    root = tmp_path / "demos"
    collect_demonstrations(["push", "reach"], episodes_per_task=1, root=root, max_steps=15, seed=8, progress=False)
    refused(
        checkpoint,
        "its data differs in episodes_per_task, noise_scale, seed;",
        lambda: make_trainer(root, checkpoint),
    )


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 not quite", b"years of work\n", json.dumps({"a": 1}).encode()])
def test_a_foreign_file_is_refused(demos, tmp_path, content):
    path = tmp_path / "thesis.tex"
    path.write_bytes(content)
    refused(path, "checkpoint: .* is damaged or none of ours", lambda: make_trainer(demos, path))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_checkpoint_is_refused(demos, checkpoint, tmp_path, share):
    path = tmp_path / "checkpoint.zip"
    content = checkpoint.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    refused(path, "damaged or none of ours", lambda: make_trainer(demos, path))


# ---- bad input


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
    trainer = make_trainer(demos, tmp_path / "checkpoint.zip")
    before = {name: value.clone() for name, value in trainer.actor.state_dict().items()}
    real = trainer.replay.sample
    trainer.replay.sample = lambda size: real(size).apply(lambda x: x * torch.nan if x.is_floating_point() else x)
    with pytest.raises(ValueError, match=r"NaN|finite"):
        trainer.train()
    assert all(torch.equal(value, before[name]) for name, value in trainer.actor.state_dict().items())
    assert not (tmp_path / "checkpoint.zip").exists()


def test_a_batch_the_tasks_do_not_divide_is_refused(demos):
    with pytest.raises(ValueError, match=r"batch_size must be divisible by the number of tasks, 2, got 7.* 6 and 8"):
        make_trainer(demos, config=BehavioralCloningConfig(steps=1, batch_size=7)).train()


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
