"""A Learner of one's own, and what OnlineTrainer tells of one that forgot something."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from small_online import CONFIG, PLANS, collect_demos, make_actor, make_online

import lw_torchrl as lw
from lw_torchrl.modules import QValue
from lw_torchrl.training import LEARNERS
from lw_torchrl.training.algorithms import Learner, OnlineConfig, adamw
from lw_torchrl.training.algorithms.learner import ReplayConfig


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    return collect_demos(tmp_path_factory.mktemp("online") / "demos")


def test_a_learner_may_bring_its_own_configuration(demos, monkeypatch):
    @dataclass(frozen=True, kw_only=True)
    class EagerConfig(ReplayConfig):
        eagerness: int = 3

    class Eager(Learner):
        config_type = EagerConfig

        def make(self, critic):
            self.loss, self.asked = torch.nn.Linear(1, 1), 0

        def learn(self, steps):
            self.asked += steps * self.config.eagerness

    monkeypatch.setitem(LEARNERS, "eager", Eager)
    trainer = make_online(demos, "eager")
    trainer.train()
    assert trainer.learner.asked == 3 * int((240 - 40) * 0.1)
    with pytest.raises(TypeError, match="of the method 'eager' must be of class EagerConfig, got TD3Config"):
        make_online(demos, "eager", config=CONFIG)


class Careless(Learner):
    """Samples, and never extends the buffer."""

    config_type = ReplayConfig

    def make(self, critic):
        self.loss = self.policy
        self.optimizers["actor"] = adamw(self.policy.parameters(), 1e-4)

    def learn(self, steps):
        for _ in range(steps):
            self.optimize("acter", self.policy(self.replay.sample(self.config.batch_size))["action"].mean())


class Extends(Careless):
    def observe(self, rows):
        self.replay.extend(rows)


class Lossless(Extends):
    def make(self, critic):
        pass


class NeverDue(Extends):
    config_type = OnlineConfig


@pytest.mark.parametrize(
    ("learner", "message"),
    [
        (Careless, r"nothing has come yet; extend .* a Learner in observe: self.replay.extend\(rows\)"),
        (Extends, "name of an optimizer must be one of 'actor', got 'acter'; did you mean 'actor'"),
        (Lossless, "make of Lossless must set self.loss, a module that holds all that is trained"),
        (NeverDue, "config_type of NeverDue must be derived from ReplayConfig or NoiseConfig, .* got OnlineConfig"),
    ],
)
def test_what_a_learner_forgot_is_told(demos, monkeypatch, learner, message):
    monkeypatch.setitem(LEARNERS, "careless", learner)
    with pytest.raises((TypeError, ValueError), match=message):
        make_online(demos, "careless").train()


def test_a_learner_gets_a_critic_like_its_policy(demos, monkeypatch):
    class Judging(Extends):
        def make(self, critic):
            super().make(critic)
            self.critic = self.q_value(critic)

    monkeypatch.setitem(LEARNERS, "judging", Judging)
    actor = make_actor()
    made = make_online(demos, "judging", actor=actor).learner.critic
    assert made.plans == actor.plans
    assert torch.equal(made.encoder.features.mean, actor.encoder.features.mean)
    given = QValue(lw.modules.PlanEncoder(PLANS))
    assert make_online(demos, "judging", critic=given).learner.critic is given
