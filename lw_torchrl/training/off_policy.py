"""Learning from demonstrations and rows that came: TD3, of a policy or of a residual beside it, and SAC."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torchrl.data import TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.objectives.demonstrated import DemonstratedSACLoss, DemonstratedTD3Loss
from lw_torchrl.training.learner import Learner, encoder_like, make_optimizer, stochastic
from lw_torchrl.training.online_config import OnlineConfig


def _critic(policy: Policy, given: QValue | None) -> QValue:
    """The critic that is given, or one that sees what the policy sees."""
    if given is None:
        return QValue(encoder_like(policy))
    if not isinstance(given, QValue):
        raise TypeError(f"critic must be a QValue, which judges actions, got {type(given).__name__}")
    return given


class TD3Learner(Learner):
    """TD3 with as many demonstrations as rows that came, and imitation of the former."""

    loss: DemonstratedTD3Loss

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        super().__init__(start, replay, config)
        self.policy = self.make_policy(start)
        critic = _critic(self.policy, critic)
        self.loss = loss = DemonstratedTD3Loss(
            self.policy,
            critic.eval(),
            bounds=(-1.0, 1.0),
            bc_weight=config.bc_weight,
            policy_noise=config.policy_noise,
            noise_clip=config.noise_clip,
            loss_function=config.distance,
        )
        loss.make_value_estimator(gamma=config.gamma)
        self.targets = SoftUpdate(loss, eps=config.target_eps)
        actor, critics = loss.actor_network_params, loss.qvalue_network_params
        self.optimizers["actor"] = make_optimizer(actor.values(True, True), config.actor_learning_rate)
        self.optimizers["critic"] = make_optimizer(critics.values(True, True), config.critic_learning_rate)

    def make_policy(self, start: Policy) -> Policy:
        """What is trained, of the policy to begin with."""
        return start

    def observe(self, rows: TensorDictBase) -> None:
        self.replay.extend(rows)

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


class SACLearner(Learner):
    """SAC with as many demonstrations as rows that came, and imitation of the former by the distribution's mode."""

    noisy = False

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        super().__init__(start, replay, config)
        self.policy = stochastic(start, "tanh_normal", config.init_std)
        critic = _critic(self.policy, critic)
        options: dict[str, Any] = {
            "bc_weight": config.bc_weight,
            "loss_function": config.distance,
            "alpha_init": config.entropy,
        }
        self.loss = loss = DemonstratedSACLoss(self.policy, critic.eval(), **options)
        self.target_entropy = loss.target_entropy  # which makes a buffer of the loss
        loss.make_value_estimator(gamma=config.gamma)
        self.targets = SoftUpdate(loss, eps=config.target_eps)
        actor, critics = loss.actor_network_params, loss.qvalue_network_params
        self.optimizers["actor"] = make_optimizer(actor.values(True, True), config.actor_learning_rate)
        self.optimizers["critic"] = make_optimizer(critics.values(True, True), config.critic_learning_rate)
        self.optimizers["alpha"] = make_optimizer([loss.log_alpha], config.actor_learning_rate)

    def act(self, state: TensorDictBase) -> TensorDictBase:
        with set_exploration_type(ExplorationType.RANDOM):
            return self.policy(state)

    def observe(self, rows: TensorDictBase) -> None:
        self.replay.extend(rows)

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
