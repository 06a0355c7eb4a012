"""TD3 from demonstrations and rows that came: of a policy, or of a residual beside it."""

from __future__ import annotations

from typing import Any

from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.objectives.demonstrated import DemonstratedTD3Loss
from lw_torchrl.training.algorithms.learner import OffPolicyLearner


class TD3Learner(OffPolicyLearner):
    """TD3 with as many demonstrations as rows that came, and imitation of the former."""

    def make(self, critic: Any) -> None:
        config = self.config
        self.policy = self.make_policy(self.policy)
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

    def make_policy(self, start: Policy) -> Policy:
        """What is trained, of the policy to begin with."""
        return start

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


class ResidualLearner(TD3Learner):
    """TD3 of a small network that corrects the start's actions, which stays as it is; of the start itself if it is such
    a :class:`~lw_torchrl.ResidualActor`."""

    def make_policy(self, start: Policy) -> Policy:
        made = start if isinstance(start, ResidualActor) else ResidualActor(start, scale=self.config.residual_scale)
        return made.eval()
