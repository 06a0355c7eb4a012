"""OfflineTrainer: a step equals one by hand, training resumes bit for bit, and unsuitable losses are refused."""

import math
from dataclasses import replace
from functools import partial

import pytest
import torch
from small_training import PLANS, ScalarLog, StopAt, assert_same, flat, make_parts
from torch.nn.utils import clip_grad_norm_
from torchrl.data import RandomSampler
from torchrl.objectives import CQLLoss, IQLLoss, REDQLoss, SACLoss, SoftUpdate, TD3BCLoss

import lw_torchrl as lw
from lw_torchrl.modules import FocusFeatures, RoleFeatures
from lw_torchrl.training import OfflineConfig, OfflineTrainer, fit_normalization
from lw_torchrl.training.cloning import bc_loss

CONFIG = OfflineConfig(steps=12, batch_size=8, checkpoint_every=5)
CRITIC = dict(width=16, depth=1)
GAMMA = 0.95


def make_replay(demos, plans=PLANS, sampler=None, n_steps=3, advantage=1.0, **options):
    ahead = {"n_steps": n_steps, "gamma": GAMMA if n_steps > 1 else None}
    parts = {"sampler": sampler or lw.TaskBalancedSampler(), "transform": lw.QAFTransform(plans)}
    replay = lw.LanguageWorldExperienceReplay(demos, label="executed", **ahead, **parts, **options)
    replay.add_column("advantage", torch.linspace(-1, advantage, len(replay)).unsqueeze(-1))
    return replay


def make_actor(noise, distribution=None):
    actor = lw.PlanConditionedActor(PLANS, **make_parts(noise=noise))
    return actor if distribution is None else actor.stochastic(distribution)


def make_value(noise, ensemble=1):
    features = lw.modules.ObservationFeatures(noise=noise)
    return lw.PlanConditionedValue(PLANS, ensemble=ensemble, features=features, **CRITIC)


def make_sac(loss, noise, **options):
    return loss(make_actor(noise, "tanh_normal"), make_qvalue(), **options)


make_qvalue = partial(lw.PlanConditionedQValue, PLANS, **CRITIC)
LOSSES = {
    "bc": lambda noise: bc_loss(make_actor(noise), "l2"),
    "value": lambda noise: lw.objectives.ExpectileValueLoss(make_value(noise, ensemble=2)),
    "advantage": lambda noise: lw.objectives.AdvantageWeightedLoss(make_actor(noise)),
    "iql": lambda noise: IQLLoss(make_actor(noise, "normal"), make_qvalue(), make_value(noise)),
    "td3-bc": lambda noise: TD3BCLoss(make_actor(noise), make_qvalue(), bounds=(-1.0, 1.0), delay_actor=True),
    "cql": lambda noise: make_sac(CQLLoss, noise, num_random=2),
    "sac": lambda noise: make_sac(SACLoss, noise),
    "redq": lambda noise: make_sac(REDQLoss, noise, num_qvalue_nets=2, sub_sample_len=2),
}
NAMES = [name if name == "td3-bc" else pytest.param(name, marks=pytest.mark.slow) for name in LOSSES]


def make_loss(name, seed=0, noise=0.05):
    torch.manual_seed(seed)
    loss = LOSSES[name](noise)
    if name not in ("bc", "advantage"):
        loss.make_value_estimator(gamma=GAMMA)
    return loss


class Stopping(StopAt, OfflineTrainer):
    pass


def make_trainer(demos, name, checkpoint=None, *, seed=0, config=CONFIG, stop_at=None, **options):
    loss = make_loss(name, seed)
    trainer = Stopping(loss, make_replay(demos), config, checkpoint=checkpoint, progress=False, **options)
    trainer.stop_at = stop_at
    return trainer


def tensors_of(loss):
    return {**dict(loss.named_parameters()), **dict(loss.named_buffers())}


def everything(trainer):
    return flat([tensors_of(trainer.loss), trainer.optimizer.state_dict(), trainer.minibatches[0].state_dict()])


@pytest.mark.parametrize("name", NAMES)
def test_interrupted_training_resumes_bit_for_bit(demos, tmp_path, name):
    uninterrupted = make_trainer(demos, name)
    uninterrupted.train()
    path = tmp_path / "checkpoint.safetensors"
    for stop in (7, 11):
        with pytest.raises(KeyboardInterrupt):
            make_trainer(demos, name, path, stop_at=stop).train()
    resumed = make_trainer(demos, name, path, seed=99)
    assert resumed.steps == 10
    resumed.train()
    finished = make_trainer(demos, name, path, seed=99)
    for trainer in (resumed, finished):
        assert_same(everything(trainer), everything(uninterrupted))


def test_training_equals_steps_written_by_hand(demos):
    trainer = make_trainer(demos, "td3-bc", config=replace(CONFIG, critic_learning_rate=3e-3, target_eps=0.9))
    trainer.train()
    loss, replay = make_loss("td3-bc"), make_replay(demos)
    targets = SoftUpdate(loss, eps=0.9)
    fit_normalization(loss, replay)
    loss.actor_network.train()
    named = dict(loss.named_parameters())
    groups = [[p for n, p in named.items() if n.startswith("actor") is first] for first in (True, False)]
    rates = CONFIG.learning_rate, 3e-3
    parameters = [{"params": group, "lr": rate} for group, rate in zip(groups, rates, strict=True)]
    optimizer = torch.optim.AdamW(parameters, weight_decay=1e-4, fused=True)
    cosine = [0.5 * (1 + math.cos(math.pi * step / CONFIG.steps)) for step in range(CONFIG.steps + 1)]
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: cosine[step])
    with torch.random.fork_rng():
        for step in range(CONFIG.steps):
            torch.manual_seed(CONFIG.seed * 1_000_003 + step)
            values = loss(replay.sample(CONFIG.batch_size))
            optimizer.zero_grad()
            (values["loss_actor"] + values["loss_qvalue"]).backward()
            for group in groups:
                clip_grad_norm_(group, CONFIG.max_grad_norm)
            optimizer.step()
            schedule.step()
            targets.step()
    assert_same(flat(tensors_of(trainer.loss)), flat(tensors_of(loss)))
    assert not any(network.training for network in trainer.networks)


@pytest.mark.parametrize("name", ["value", "iql", "td3-bc", "cql", "sac", "redq"])
def test_the_value_n_steps_ahead_is_discounted_n_times(demos, name):
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
    sample, batches = trainer.replay.sample, []
    trainer.replay.sample = lambda size: batches.append(sample(size)) or batches[-1].clone()
    trainer.train()
    steps = batches[0]["steps_to_next_obs"]
    torch.testing.assert_close(seen[0], GAMMA ** steps.float())
    assert steps.max() == 3


def test_cqls_first_actor_loss_is_not_added_to_the_other_one(demos):
    trainer = make_trainer(demos, "cql", config=replace(CONFIG, steps=1))
    batch = trainer.replay.sample(8)
    values = trainer.loss(batch)
    assert values["loss_actor_bc"] > 1
    names = {name for name in trainer.losses(batch) if name.startswith("loss")}
    assert names == {"loss_actor", "loss_qvalue", "loss_cql", "loss_alpha"}


def test_a_trained_policy_keeps_its_statistics(demos):
    actor = make_actor(0.0)

    def trainer(replay, config=CONFIG):
        return OfflineTrainer(lw.objectives.AdvantageWeightedLoss(actor), replay, config, progress=False)

    trainer(make_replay(demos)).train()
    before = {name: tensor.clone() for name, tensor in actor.state_dict().items()}
    trainer(make_replay(demos))
    others = make_replay(demos, episodes={"reach": 1}, sampler=RandomSampler())
    with pytest.raises(ValueError, match="normalize"):
        trainer(others)
    trainer(others, replace(CONFIG, normalize=False))
    assert_same(actor.state_dict(), before)


def test_the_losss_entries_are_logged_as_means_of_100_steps(demos):
    log = ScalarLog()
    trainer = make_trainer(demos, "value", logger=log, config=replace(CONFIG, steps=101))
    trainer.train()
    names = {"train/loss", "train/loss_value", "train/value", "train/learning_rate"}
    assert {name for name, *_ in log.scalars} == names
    values = [logged for name, *logged in log.scalars if name == "train/value"]
    assert [step for step, _ in values] == [100, 101]
    assert trainer.last["value"] == values[-1][1]


def test_with_its_actor_the_checkpoint_is_a_policy_file(demos, tmp_path):
    path = tmp_path / "policy.safetensors"

    def trainer(seed):
        torch.manual_seed(seed)
        actor = make_actor(0.0, "tanh_normal")
        loss = CQLLoss(actor, make_qvalue(), num_random=2)
        loss.make_value_estimator(gamma=GAMMA)
        return OfflineTrainer(loss, make_replay(demos), CONFIG, actor=actor, checkpoint=path, progress=False)

    trainer(0).train(until=5)
    resumed = trainer(9)
    assert resumed.steps == 5
    resumed.train()
    assert sorted(file.name for file in tmp_path.iterdir()) == ["policy.safetensors", "policy.training.safetensors"]
    rows = make_replay(demos)[:].select("observation", "task_id", "qaf")
    assert torch.equal(lw.load_actor(path)(rows.clone())["action"], resumed.actor(rows)["action"])


# ---- refused


@pytest.fixture(scope="module")
def checkpoint(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("checkpoint") / "checkpoint.safetensors"
    make_trainer(demos, "value", path).train()
    return path


@pytest.mark.parametrize(
    ("change", "difference"),
    [
        (dict(config=replace(CONFIG, learning_rate=1e-2)), "training differs in learning_rate"),
        (dict(name="advantage"), "loss differs in class"),
        (dict(expectile=0.9), r"loss differs in options.expectile \(0.7, now 0.9\)"),
        (dict(gamma=0.5, n_steps=1), "loss differs in fixed"),
        (dict(width=8), "shapes.value_network_params.heads.0.0.bias"),
        (dict(episodes=1), "a different configuration"),
        (dict(reward="cost"), r"replay differs in reward \('sparse', now 'cost'\)"),
        (dict(n_steps=2), r"replay differs in n_steps \(3, now 2\)"),
        (dict(terminate_on_success=True), "replay differs in .*terminate_on_success"),
        (dict(advantage=0.5), "replay differs in columns.advantage"),
    ],
)
def test_a_checkpoint_of_another_training_is_refused(demos, checkpoint, change, difference):
    def trainer(name="value", config=CONFIG, width=16, expectile=0.7, gamma=GAMMA, **options):
        loss = make_loss(name)
        if name == "value":
            value = lw.PlanConditionedValue(PLANS, ensemble=2, width=width, depth=1)
            loss = lw.objectives.ExpectileValueLoss(value, expectile=expectile).make_value_estimator(gamma=gamma)
        return OfflineTrainer(loss, make_replay(demos, **options), config, checkpoint=checkpoint, progress=False)

    with pytest.raises(ValueError, match=difference):
        trainer(**change)


def assert_refused(loss, replay, message):
    with pytest.raises(ValueError, match=message):
        OfflineTrainer(loss, replay, CONFIG, progress=False)


def test_a_buffer_of_other_plans_is_refused(demos):
    others = lw.Plans([lw.ConditionalPlan(plan.task, plan.steps[::-1]) for plan in PLANS.values()])
    assert_refused(make_loss("value"), make_replay(demos, others), "s plans; they differ in")


@pytest.mark.parametrize("name", ["RandomYaw", "JitterTarget"])
def test_augmentations_that_features_would_not_see_are_refused(demos, name):
    plans = lw.canonical_plans(PLANS)
    augmented = {"RandomYaw": lw.RandomYaw(0.3), "JitterTarget": lw.transforms.JitterTarget(plans, 0.03)}[name]
    actor = lw.PlanConditionedActor(plans, **make_parts()).stochastic("normal")
    for kind in (FocusFeatures, RoleFeatures):
        value, replay = lw.PlanConditionedValue(plans, features=kind(plans), **CRITIC), make_replay(demos, plans)
        replay.append_transform(augmented)
        iql = IQLLoss(actor, lw.PlanConditionedQValue(plans, **CRITIC), value)
        iql.make_value_estimator(gamma=GAMMA)
        assert_refused(iql, replay, f"Features cannot read the key that {name} writes")
        loss = lw.objectives.ExpectileValueLoss(value).make_value_estimator(gamma=GAMMA)
        OfflineTrainer(loss, replay, replace(CONFIG, steps=1), progress=False).train()


@pytest.mark.parametrize("name", ["iql", "td3-bc", "sac", "value"])
def test_rows_without_rewards_and_next_observations_are_refused(demos, name):
    replay = lw.LanguageWorldExperienceReplay(demos, transform=lw.QAFTransform(PLANS))  # the label "expert"
    assert_refused(make_loss(name), replay, "label='executed'")


def test_unsuitable_losses_are_refused(demos):
    replay, value = make_replay(demos), LOSSES["value"](0.0)
    assert_refused(value, replay, r"loss: .* 0\.95, got 0\.99")  # TorchRL's default estimator
    value.make_value_estimator(gamma=0.9)
    assert_refused(value, replay, r"loss: .* 0\.95, got 0\.9;")
    unreduced = make_sac(SACLoss, 0.0, reduction="none", scalar_output_mode="exclude")
    assert_refused(unreduced, replay, "loss .*reduction='none'")
    assert_refused(make_sac(CQLLoss, 0.0, with_lagrange=True), replay, "loss: with_lagrange")
