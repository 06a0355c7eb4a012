"""TD3 from demonstrations and rows that came: of a policy, or of a residual beside it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lw_torchrl._checks import Count, Scale
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.objectives.demonstrated import DemonstratedTD3Loss
from lw_torchrl.training.algorithms.learner import NoiseConfig, OffPolicyConfig, OffPolicyLearner


@dataclass(frozen=True, kw_only=True)
class TD3Config(NoiseConfig, OffPolicyConfig):
    """How "td3" trains; what other methods read too is in ``learner.py``."""

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
    """TD3 of a small network that corrects the start's actions, or of a start that is a :class:`ResidualActor`."""

    config_type = ResidualConfig
    config: ResidualConfig

    def make(self, critic: Any) -> None:
        if not isinstance(self.policy, ResidualActor):
            self.policy = ResidualActor(self.policy, scale=self.config.residual_scale).eval()
        super().make(critic)
