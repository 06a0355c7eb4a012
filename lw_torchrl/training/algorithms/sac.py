"""SAC from demonstrations and rows that came."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type

from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.policy import Policy
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss
from lw_torchrl.training.algorithms.learner import OffPolicyLearner, OnlineConfig, adamw, stochastic


class SACLearner(OffPolicyLearner):
    """SAC with as many demonstrations as rows that came, and imitation of the former by the distribution's mode."""

    noisy = False

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        super().__init__(start, replay, config)
        self.policy = stochastic(start, "tanh_normal", config.init_std)
        loss = DemonstratedSACLoss(
            self.policy,
            self.critic(critic),
            bc_weight=config.bc_weight,
            loss_function=config.distance,
            alpha_init=config.entropy,
        )
        self.target_entropy = loss.target_entropy  # which makes a buffer of the loss
        self.set_loss(loss)
        self.optimizers["alpha"] = adamw([loss.log_alpha], config.actor_learning_rate)

    def act(self, state: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.RANDOM):
            return self.policy(state)

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
