"""Any loss over a buffer: a step by hand, stopped and resumed with the same bits, and what is refused."""

from __future__ import annotations

import math
import warnings
from dataclasses import replace

import pytest
import torch
from small_training import PLANS, assert_same, collect_demos, flat, make_parts
from torch.nn.utils import clip_grad_norm_
from torchrl.data import PrioritizedSampler, RandomSampler
from torchrl.envs import Transform
from torchrl.objectives import BCLoss, CQLLoss, IQLLoss, REDQLoss, SACLoss, SoftUpdate, TD3BCLoss
from torchrl.record.loggers import Logger

import lw_torchrl as lw
from lw_torchrl.modules import FocusFeatures, RoleFeatures
from lw_torchrl.training import OfflineConfig, OfflineTrainer, fit_normalization
from lw_torchrl.training.minibatches import check_minibatches

CONFIG = OfflineConfig(steps=12, batch_size=8, checkpoint_every=5)
CRITIC = dict(width=16, depth=1)
GAMMA = 0.95


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("offline") / "demos")


def make_replay(demos, plans=PLANS, sampler=None, n_steps=3, advantage=1.0, **options):
    replay = lw.LanguageWorldExperienceReplay(
        demos,
        label="executed",
        n_steps=n_steps,
        gamma=GAMMA if n_steps > 1 else None,
        sampler=sampler or lw.TaskBalancedSampler(),
        transform=lw.QAFTransform(plans),
        **options,
    )
    replay.add_column("advantage", torch.linspace(-1, advantage, len(replay)).unsqueeze(-1))
    return replay


class Networks:
    """Makes networks with a noise on their features, on a device."""

    def __init__(self, noise, device):
        self.noise, self.device = noise, device

    def actor(self, distribution=None):
        actor = lw.PlanConditionedActor(PLANS, **make_parts(noise=self.noise))
        return (actor if distribution is None else actor.stochastic(distribution)).to(self.device)

    def value(self, ensemble=1):
        features = lw.modules.ObservationFeatures(noise=self.noise)
        return lw.PlanConditionedValue(PLANS, ensemble=ensemble, features=features, **CRITIC).to(self.device)

    def qvalue(self):
        return lw.PlanConditionedQValue(PLANS, **CRITIC).to(self.device)


def bc(made):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*target_actor_network_params.*")
        return BCLoss(made.actor(), loss_function="l2")


LOSSES = {
    "bc": bc,
    "value": lambda made: lw.objectives.ExpectileValueLoss(made.value(ensemble=2)),
    "advantage": lambda made: lw.objectives.AdvantageWeightedLoss(made.actor()),
    "iql": lambda made: IQLLoss(made.actor(distribution="normal"), made.qvalue(), made.value()),
    "td3-bc": lambda made: TD3BCLoss(made.actor(), made.qvalue(), bounds=(-1.0, 1.0), delay_actor=True),
    "cql": lambda made: CQLLoss(made.actor(distribution="tanh_normal"), made.qvalue(), num_random=2),
    "sac": lambda made: SACLoss(made.actor(distribution="tanh_normal"), made.qvalue()),
    "redq": lambda made: REDQLoss(
        made.actor(distribution="tanh_normal"), made.qvalue(), num_qvalue_nets=2, sub_sample_len=2
    ),
}


def make_loss(name, seed=0, noise=0.05, device="cpu"):
    torch.manual_seed(seed)
    loss = LOSSES[name](Networks(noise, device))
    if name not in ("bc", "advantage"):
        loss.make_value_estimator(gamma=GAMMA)
    return loss


class Stopping(OfflineTrainer):
    stop_at = None

    def step(self):
        if self.steps == self.stop_at:
            raise KeyboardInterrupt
        return super().step()


def make_trainer(demos, name, checkpoint=None, *, seed=0, config=CONFIG, stop_at=None, **options):
    trainer = Stopping(
        make_loss(name, seed), make_replay(demos), config, checkpoint=checkpoint, progress=False, **options
    )
    trainer.stop_at = stop_at
    return trainer


def tensors_of(loss):
    return {**dict(loss.named_parameters()), **dict(loss.named_buffers())}


def everything(trainer):
    return flat(
        {
            "loss": tensors_of(trainer.loss),
            "optimizer": trainer.optimizer.state_dict(),
            "minibatches": trainer.minibatches[0].state_dict(),
        }
    )


@pytest.mark.parametrize(
    "name", [name if name == "td3-bc" else pytest.param(name, marks=pytest.mark.slow) for name in LOSSES]
)
def test_stopped_and_started_again_it_ends_with_the_same_bits(demos, tmp_path, name):
    undisturbed = make_trainer(demos, name)
    undisturbed.train()
    path = tmp_path / "checkpoint.safetensors"
    for stop in (7, 11):
        with pytest.raises(KeyboardInterrupt):
            make_trainer(demos, name, path, stop_at=stop).train()
    resumed = make_trainer(demos, name, path, seed=99)
    assert resumed.steps == 10
    resumed.train()
    assert_same(everything(resumed), everything(undisturbed))
    again = make_trainer(demos, name, path, seed=99)
    again.train()
    assert_same(everything(again), everything(undisturbed))


def test_a_step_is_the_one_written_by_hand(demos):
    trainer = make_trainer(demos, "td3-bc", config=replace(CONFIG, critic_learning_rate=3e-3, target_eps=0.9))
    trainer.train()
    loss, replay = make_loss("td3-bc"), make_replay(demos)
    targets = SoftUpdate(loss, eps=0.9)
    fit_normalization(loss, replay)
    loss.actor_network.train()
    named = dict(loss.named_parameters())
    groups = [[p for n, p in named.items() if n.startswith("actor") is first] for first in (True, False)]
    rates = CONFIG.learning_rate, 3e-3
    optimizer = torch.optim.AdamW(
        [{"params": group, "lr": rate} for group, rate in zip(groups, rates, strict=True)],
        weight_decay=1e-4,
        fused=True,
    )
    cosine = [0.5 * (1 + math.cos(math.pi * step / CONFIG.steps)) for step in range(CONFIG.steps + 1)]
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: cosine[step])
    with torch.random.fork_rng():
        for step in range(CONFIG.steps):
            torch.manual_seed(CONFIG.seed * 1_000_003 + step)
            found = loss(replay.sample(CONFIG.batch_size))
            optimizer.zero_grad()
            (found["loss_actor"] + found["loss_qvalue"]).backward()
            for group in groups:
                clip_grad_norm_(group, CONFIG.max_grad_norm)
            optimizer.step()
            schedule.step()
            targets.step()
    assert_same(flat(tensors_of(trainer.loss)), flat(tensors_of(loss)))


@pytest.mark.parametrize("name", ["value", "iql", "td3-bc", "cql", "sac", "redq"])
def test_what_lies_n_steps_ahead_is_discounted_as_often(demos, name):
    seen = []
    trainer = make_trainer(demos, name, config=replace(CONFIG, steps=1))
    estimator = trainer.loss.value_estimator
    estimate = type(estimator).value_estimate

    def note(rows, **options):
        zero, never = torch.zeros_like(rows["next", "reward"]), torch.zeros_like(rows["next", "terminated"])
        rows = rows.copy().set("next", rows["next"].copy().update({"reward": zero, "terminated": never}))
        seen.append(estimate(estimator, rows, **{**options, "next_value": torch.ones_like(zero)}).reshape(-1))
        return zero

    estimator.value_estimate = note
    steps = []
    trainer.replay.append_transform(_Note(steps))
    trainer.train()
    torch.testing.assert_close(seen[0], GAMMA ** steps[0].float())
    assert steps[0].max() == 3


class _Note(Transform):
    def __init__(self, noted):
        super().__init__()
        self.noted = noted

    def forward(self, tensordict):
        self.noted.append(tensordict["steps_to_next_obs"].clone())
        return tensordict


def test_the_first_steps_of_cqls_actor_stand_for_its_loss_and_not_beside_it(demos):
    trainer = make_trainer(demos, "cql", config=replace(CONFIG, steps=1))
    batch = trainer.replay.sample(8)
    values = trainer.loss(batch)
    assert values["loss_actor_bc"] > 1
    assert {name for name in trainer.losses(batch) if name.startswith("loss")} == {
        "loss_actor", "loss_qvalue", "loss_cql", "loss_alpha",
    }  # fmt: skip


@pytest.mark.parametrize("name", ["value", "td3-bc"])
def test_statistics_of_the_rows_reach_networks_and_their_targets(demos, name):
    trainer = make_trainer(demos, name)
    tensors = tensors_of(trainer.loss)
    means = {key: tensor for key, tensor in tensors.items() if key.endswith("features.mean")}
    assert any(key.startswith("target_") for key in means)
    assert all(tensor.abs().sum() > 0 for tensor in means.values())
    untouched = make_trainer(demos, name, config=replace(CONFIG, normalize=False))
    assert all(
        tensor.abs().sum() == 0 for key, tensor in tensors_of(untouched.loss).items() if key.endswith("features.mean")
    )


def test_a_policy_that_was_trained_keeps_its_statistics(demos):
    actor = Networks(0.0, "cpu").actor()
    OfflineTrainer(lw.objectives.AdvantageWeightedLoss(actor), make_replay(demos), CONFIG, progress=False).train()
    before = {name: tensor.clone() for name, tensor in actor.state_dict().items()}
    OfflineTrainer(
        lw.objectives.AdvantageWeightedLoss(actor), make_replay(demos), CONFIG, progress=False
    )  # of the same rows
    others = make_replay(demos, episodes={"reach": 1}, sampler=RandomSampler())
    with pytest.raises(ValueError, match="has the statistics of other rows"):
        OfflineTrainer(lw.objectives.AdvantageWeightedLoss(actor), others, CONFIG, progress=False)
    OfflineTrainer(lw.objectives.AdvantageWeightedLoss(actor), others, replace(CONFIG, normalize=False), progress=False)
    assert_same(actor.state_dict(), before)


def test_networks_are_in_eval_mode_afterwards_and_in_train_mode_meanwhile(demos):
    trainer = make_trainer(demos, "td3-bc")
    seen = []
    step = trainer.step
    trainer.step = lambda: (seen.extend(network.training for network in trainer.networks), step())[1]
    trainer.train()
    assert seen
    assert all(seen)
    assert not any(network.training for network in trainer.networks)


def test_what_the_loss_gives_is_logged_as_means_of_a_hundred_steps(demos):
    class Note(Logger):
        def __init__(self):
            self.noted = {}

        def log_scalar(self, name, value, step=None):
            self.noted.setdefault(name, []).append((step, value))

    note = Note()
    trainer = make_trainer(demos, "value", logger=note, config=replace(CONFIG, steps=101))
    trainer.train()
    assert set(note.noted) == {"train/loss", "train/loss_value", "train/value", "train/learning_rate"}
    assert [step for step, _ in note.noted["train/value"]] == [100, 101]
    assert trainer.last["value"] == note.noted["train/value"][-1][1]


def test_with_its_actor_the_checkpoint_is_the_policys_file(demos, tmp_path):
    path = tmp_path / "policy.safetensors"

    def trainer(seed=0, stop_at=None):
        torch.manual_seed(seed)
        actor = Networks(0.0, "cpu").actor(distribution="tanh_normal")
        loss = CQLLoss(actor, Networks(0.0, "cpu").qvalue(), num_random=2)
        loss.make_value_estimator(gamma=GAMMA)
        made = Stopping(loss, make_replay(demos), CONFIG, actor=actor, checkpoint=path, progress=False)
        made.stop_at = stop_at
        return made, actor

    with pytest.raises(KeyboardInterrupt):
        trainer(stop_at=7)[0].train()
    resumed, actor = trainer(seed=9)
    assert resumed.steps == 5
    resumed.train()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["policy.safetensors", "policy.training.safetensors"]
    rows = make_replay(demos)[:].select("observation", "task_id", "qaf")
    assert torch.equal(lw.load_actor(path)(rows.clone())["action"], actor(rows)["action"])


# ---- what is refused


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    make_trainer(demos, "value", path).train()
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (dict(config=replace(CONFIG, learning_rate=1e-2)), "its training differs in learning_rate"),
        (dict(name="advantage"), "its loss differs in class"),
        (dict(expectile=0.9), r"its loss differs in options.expectile \(0.7, now 0.9\)"),
        (dict(gamma=0.5, n_steps=1), "its loss differs in fixed"),
        (dict(width=8), "shapes.value_network_params.heads.0.0.bias"),
        (dict(sampler=RandomSampler()), "its replay differs in sampler"),
        (dict(episodes=1), "of another configuration"),
        (dict(reward="cost"), r"its replay differs in reward \('sparse', now 'cost'\)"),
        (dict(n_steps=2), r"its replay differs in n_steps \(3, now 2\)"),
        (dict(terminate_on_success=True), "its replay differs in .*terminate_on_success"),
        (dict(advantage=0.5), "its replay differs in columns.advantage"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused(demos, checkpoint, change, message):
    torch.manual_seed(0)
    loss = make_loss(change.get("name", "value"))
    if {"expectile", "gamma", "width"} & set(change):
        critic = {**CRITIC, "width": change.get("width", 16), "features": lw.modules.ObservationFeatures(noise=0.05)}
        value = lw.PlanConditionedValue(PLANS, ensemble=2, **critic)
        loss = lw.objectives.ExpectileValueLoss(value, expectile=change.get("expectile", 0.7))
        loss.make_value_estimator(gamma=change.get("gamma", GAMMA))
    shown = ("sampler", "episodes", "reward", "n_steps", "terminate_on_success", "advantage")
    options = {name: change[name] for name in shown if name in change}
    with pytest.raises(ValueError, match=message):
        OfflineTrainer(
            loss, make_replay(demos, **options), change.get("config", CONFIG), checkpoint=checkpoint, progress=False
        )


def test_a_buffer_of_other_plans_is_refused(demos):
    others = lw.Plans([lw.ConditionalPlan(plan.task, plan.steps[::-1]) for plan in PLANS.values()])
    loss = make_loss("value")
    with pytest.raises(ValueError, match="replay's QAFTransform must have the critic's plans"):
        OfflineTrainer(loss, make_replay(demos, others), CONFIG, progress=False)


@pytest.mark.parametrize("name", ["RandomYaw", "JitterTarget"])
def test_augmentations_that_features_would_not_see_are_refused(demos, name):
    plans = lw.canonical_plans(PLANS)
    augmented = {"RandomYaw": lw.RandomYaw(0.3), "JitterTarget": lw.transforms.JitterTarget(plans, 0.03)}[name]
    critics = [lw.PlanConditionedValue(plans, features=kind(plans), **CRITIC) for kind in (FocusFeatures, RoleFeatures)]
    actor = lw.PlanConditionedActor(plans, **make_parts()).stochastic("normal")
    for value in critics:
        replay = make_replay(demos, plans)
        replay.append_transform(augmented)
        iql = IQLLoss(actor, lw.PlanConditionedQValue(plans, **CRITIC), value)
        iql.make_value_estimator(gamma=GAMMA)
        with pytest.raises(ValueError, match=rf"Features would not see what {name} writes, because IQLLoss passes on"):
            OfflineTrainer(iql, replay, CONFIG, progress=False)
        loss = lw.objectives.ExpectileValueLoss(value).make_value_estimator(gamma=GAMMA)
        OfflineTrainer(loss, replay, replace(CONFIG, steps=1), progress=False).train()


@pytest.mark.parametrize("name", ["iql", "td3-bc", "sac", "value"])
def test_rows_without_rewards_and_next_observations_are_refused(demos, name):
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(PLANS))  # the label "expert"
    message = r"loss: \w+Loss needs rewards and next observations, .*; open the buffer with label='executed'"
    with pytest.raises(ValueError, match=message):
        OfflineTrainer(make_loss(name), replay, CONFIG, progress=False)


def test_a_value_estimator_in_the_place_of_a_loss_is_explained(demos):
    loss = LOSSES["iql"](Networks(0.0, "cpu")).make_value_estimator(gamma=GAMMA)
    with pytest.raises(TypeError, match=r"got NoneType; make_value_estimator .* on a line of its own"):
        OfflineTrainer(loss, make_replay(demos), CONFIG, progress=False)


@pytest.mark.parametrize("made", [True, False])
def test_a_value_of_another_discount_than_the_rows_is_refused(demos, made):
    loss = LOSSES["value"](Networks(0.0, "cpu"))
    if made:
        loss.make_value_estimator(gamma=0.9)
    with pytest.raises(ValueError, match=rf"the replay buffer's n steps, 0.95, got 0.9{'' if made else '9'};"):
        OfflineTrainer(loss, make_replay(demos), CONFIG, progress=False)


def test_losses_that_cannot_be_summed_are_refused(demos):
    made = Networks(0.0, "cpu")
    actor, critic = made.actor(distribution="tanh_normal"), made.qvalue()
    unreduced = SACLoss(actor, critic, reduction="none", scalar_output_mode="exclude")
    with pytest.raises(ValueError, match="got reduction='none'"):
        OfflineTrainer(unreduced, make_replay(demos), CONFIG, progress=False)
    with pytest.raises(ValueError, match="with_lagrange=False"):
        OfflineTrainer(CQLLoss(actor, critic, with_lagrange=True), make_replay(demos), CONFIG, progress=False)
    with pytest.raises(TypeError, match=r"loss must be a LossModule, got Sequential"):
        OfflineTrainer(torch.nn.Sequential(make_loss("td3-bc")), make_replay(demos), CONFIG, progress=False)


def test_a_loss_without_entries_to_minimise_is_refused(demos):
    trainer = make_trainer(demos, "bc")
    trainer.loss.forward = lambda batch: {"loss": torch.zeros(())}
    with pytest.raises(ValueError, match="entries that begin with 'loss_', it gives loss"):
        trainer.step()


def test_priorities_that_nothing_would_change_are_refused(demos):
    replay = make_replay(demos)
    replay._sampler = PrioritizedSampler.__new__(PrioritizedSampler)  # made as users do, it needs compiled code
    with pytest.raises(ValueError, match="a PrioritizedSampler draws uniformly"):
        check_minibatches([], replay, 8)


def test_a_loss_that_is_no_number_stops_the_training(demos, tmp_path):
    path = tmp_path / "checkpoint.safetensors"
    trainer = make_trainer(demos, "value", path)
    with torch.no_grad():
        next(trainer.loss.parameters()).fill_(float("inf"))
    with pytest.raises(ValueError, match="the loss is nan at step 0"):
        trainer.train()
    assert not path.exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (dict(steps=0), "steps must be at least 1, got 0"),
        (dict(target_eps=1.5), "target_eps must be from 0 to 1"),
        (dict(schedule="cosin"), "schedule must be one of 'cosine', 'constant', got 'cosin'; did you mean 'cosine'"),
        (dict(learning_rate=-1.0), "learning_rate must be finite and at least 0"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        OfflineConfig(**options)
