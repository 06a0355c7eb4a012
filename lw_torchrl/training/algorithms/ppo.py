"""Learning from the rows of a round alone: PPO, of an actor and a value on one encoder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch.nn.utils import clip_grad_norm_
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from lw_torchrl._checks import Count, Probability, Scale
from lw_torchrl.data.rewards import REWARDS
from lw_torchrl.modules.critics import Value
from lw_torchrl.training.algorithms.learner import Learner, OnlineConfig, adamw, stochastic


@dataclass(frozen=True, kw_only=True)
class PPOConfig(OnlineConfig):
    """How "ppo" trains."""

    actor_learning_rate: Scale = 1e-4  # of AdamW, of the actor and the value
    init_std: Scale = 0.15  # the distribution's standard deviation at first
    entropy: Scale = 1e-3  # weight of the entropy
    gae_lambda: Probability = 0.95  # of the advantages
    epochs: Count = 10  # passes over a round's rows
    clip: Scale = 0.2  # how far the ratio of probabilities may be from 1


class PPOLearner(Learner):
    """PPO: several passes over each round's rows. It sees no demonstrations but in its start."""

    config_type = PPOConfig
    config: PPOConfig
    wants_round = True

    def make(self, critic: Any) -> None:
        if critic is not None:
            raise ValueError("critic: PPO's is the value of a state on the actor's own encoder; leave it out")
        config = self.config
        self.policy = actor = stochastic(self.policy, "normal", config.init_std)
        value = Value(actor.encoder)
        self.loss = ClipPPOLoss(actor, value, clip_epsilon=config.clip, entropy_coeff=config.entropy)
        how = {"gamma": config.gamma, "lmbda": config.gae_lambda, "average_gae": True, "deactivate_vmap": True}
        self.advantage = GAE(value_network=value, **how)
        self.optimizers["all"] = adamw(self.loss.parameters(), config.actor_learning_rate)

    def end_round(self, rows: TensorDictBase | None, steps: int) -> None:
        assert rows is not None
        following = rows["next"]
        reward = REWARDS[self.replay.reward].of(following["reward"].reshape(-1, 1), following["success"].reshape(-1, 1))
        rows.set(("next", "reward"), reward.view_as(following["reward"]))
        with torch.no_grad():
            rows = self.advantage(rows).reshape(-1)
        for _ in range(self.config.epochs):
            for index in torch.randperm(len(rows)).split(self.config.batch_size):
                found = self.loss(rows[index])
                total = found["loss_objective"] + found["loss_critic"] + found["loss_entropy"]
                self.optimizers["all"].zero_grad()
                total.backward()
                clip_grad_norm_(self.loss.parameters(), 1.0)
                self.optimizers["all"].step()
                self.tell(loss_actor=found["loss_objective"], loss_value=found["loss_critic"])
                self.made += 1
