"""TD3 and SAC from demonstrations and rows that came: of a policy, or, by TD3, of a residual beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torchrl.objectives import LossModule, SoftUpdate

from lw_torchrl._checks import Count, Scale
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss
from lw_torchrl.training.algorithms.learner import CriticConfig, Learner, NoiseConfig, adamw, encoder_like, stochastic


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(CriticConfig):
    """Of methods whose actor follows critics that judge actions."""

    actor_learning_rate: Scale = 1e-4  # of AdamW
    bc_weight: Scale = 2.0  # of the imitation of demonstrations


class OffPolicyLearner(Learner):
    """Learns from demonstrations and rows that came, half of a minibatch each, with critics and their targets."""

    config: OffPolicyConfig
    loss: Any
    targets: SoftUpdate

    def set_loss(self, loss: LossModule) -> None:
        """What is trained: a loss with ``actor_network`` and ``qvalue_network``."""
        self.loss = loss
        loss.make_value_estimator(gamma=self.config.gamma)
        self.targets = SoftUpdate(loss, eps=self.config.target_eps)
        actor, critics = loss.actor_network_params, loss.qvalue_network_params
        self.optimizers["actor"] = adamw(actor.values(True, True), self.config.actor_learning_rate)
        self.optimizers["critic"] = adamw(critics.values(True, True), self.config.critic_learning_rate)

    def q_value(self, given: Any) -> QValue:
        """The critic that is given, or one that sees what the policy sees, in eval mode."""
        if given is None:
            return QValue(encoder_like(self.policy)).eval()
        if not isinstance(given, QValue):
            raise TypeError(f"critic must be a QValue, which judges actions, got {type(given).__name__}")
        return given.eval()

    def observe(self, rows: TensorDictBase) -> None:
        self.replay.extend(rows)


@dataclass(frozen=True, kw_only=True)
class TD3Config(NoiseConfig, OffPolicyConfig):
    """How "td3" trains."""

    policy_delay: Count = 2  # gradient steps of the critics for one of the actor
    policy_noise: Scale = 0.1  # standard deviation of the noise on the targets' actions
    noise_clip: Scale = 0.3  # the most of it


class TD3Learner(OffPolicyLearner):
    """TD3 with as many demonstrations as rows that came, and imitation of the former."""

    config_type = TD3Config
    config: TD3Config

    def make(self, critic: Any) -> None:
        config = self.config
        loss = DemonstratedTD3Loss(
            self.policy,
            self.q_value(critic),
            bounds=(-1.0, 1.0),
            bc_weight=config.bc_weight,
            policy_noise=config.policy_noise,
            noise_clip=config.noise_clip,
            loss_function=config.distance,
        )
        self.set_loss(loss)

    def learn(self, steps: int) -> None:
        for _ in range(steps):
            batch = self.replay.sample(self.config.batch_size)
            found, of_critic = self.loss.qvalue_loss(batch)
            self.optimize("critic", found)
            self.tell(loss_qvalue=found, value=of_critic["pred_value"].mean())
            if self.made >= self.config.warm_up and self.made % self.config.policy_delay == 0:
                found, of_actor = self.loss.actor_loss(batch)
                self.optimize("actor", found)
                self.tell(loss_actor=found, loss_imitation=of_actor["bc_loss"])
            self.targets.step()
            self.made += 1


@dataclass(frozen=True, kw_only=True)
class ResidualConfig(TD3Config):
    """How "residual" trains."""

    residual_scale: Scale = 0.3  # how far the action can be corrected; not read if the start is a residual


class ResidualLearner(TD3Learner):
    """TD3 of a small network that corrects the start's actions, which stays as it is; of the start itself if it is such
    a :class:`~lw_torchrl.ResidualActor`."""

    config_type = ResidualConfig
    config: ResidualConfig

    def make(self, critic: Any) -> None:
        if not isinstance(self.policy, ResidualActor):
            self.policy = ResidualActor(self.policy, scale=self.config.residual_scale).eval()
        super().make(critic)


@dataclass(frozen=True, kw_only=True)
class SACConfig(OffPolicyConfig):
    """How "sac" trains."""

    init_std: Scale = 0.15  # the distribution's standard deviation at first
    entropy: Scale = 1e-3  # where the weight of the entropy begins


class SACLearner(OffPolicyLearner):
    """SAC with as many demonstrations as rows that came, and imitation of the former by the distribution's mode."""

    config_type = SACConfig
    config: SACConfig

    def make(self, critic: Any) -> None:
        config = self.config
        self.policy = stochastic(self.policy, "tanh_normal", config.init_std)
        loss = DemonstratedSACLoss(
            self.policy,
            self.q_value(critic),
            bc_weight=config.bc_weight,
            loss_function=config.distance,
            alpha_init=config.entropy,
        )
        self.target_entropy = loss.target_entropy  # which makes a buffer of the loss
        self.set_loss(loss)
        self.optimizers["alpha"] = adamw([loss.log_alpha], config.actor_learning_rate)

    def learn(self, steps: int) -> None:
        for _ in range(steps):
            found = self.loss(self.replay.sample(self.config.batch_size))
            if self.made >= self.config.warm_up:  # before the critics move: the actor's gradient goes through them
                self.optimize("actor", found["loss_actor"])
                self.optimize("alpha", found["loss_alpha"])
                self.tell(loss_actor=found["loss_actor"])
            self.optimize("critic", found["loss_qvalue"])
            self.tell(loss_qvalue=found["loss_qvalue"], entropy=found["entropy"])
            self.targets.step()
            self.made += 1
