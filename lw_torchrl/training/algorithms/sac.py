"""SAC from demonstrations and rows that came."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from lw_torchrl._checks import Scale
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss
from lw_torchrl.training.algorithms.learner import OffPolicyConfig, OffPolicyLearner, adamw, stochastic


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
        how: Any = {"bc_weight": config.bc_weight, "loss_function": config.distance, "alpha_init": config.entropy}
        loss = DemonstratedSACLoss(self.policy, self.q_value(critic), **how)
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
