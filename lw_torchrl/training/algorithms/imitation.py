"""Learning by imitation, of what did better than others ("advantage") or succeeded ("expert-iteration")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import nn
from torchrl.objectives import SoftUpdate

from lw_torchrl._checks import Probability, Scale
from lw_torchrl.modules.critics import QValue, Value
from lw_torchrl.objectives.advantage_weighted import AdvantageWeightedLoss, ExpectileValueLoss, standardize_by_task
from lw_torchrl.training.algorithms.learner import CriticConfig, Learner, NoiseConfig, adamw, encoder_like
from lw_torchrl.training.behavioral_cloning import bc_loss


@dataclass(frozen=True, kw_only=True)
class AdvantageConfig(NoiseConfig, CriticConfig):
    """How "advantage" trains."""

    cloning_learning_rate: Scale = 3e-4  # of AdamW, of the actor
    expectile: Probability = 0.7  # of the value
    beta: Scale = 2.0  # how sharply advantages weigh


class AdvantageLearner(Learner):
    """A value by expectile regression, and imitation of demonstrations and of the policy's own steps, as much as each
    one's advantage says: nothing is done that was not tried, so a value that errs about the untried harms nothing."""

    config_type = AdvantageConfig
    config: AdvantageConfig

    def make(self, critic: Any) -> None:
        start, config = self.policy, self.config
        if isinstance(critic, QValue):
            raise TypeError("critic must be a Value, of states alone, for the method 'advantage'; got a QValue")
        value = Value(encoder_like(start), ensemble=2) if critic is None else critic
        self.value = ExpectileValueLoss(value.eval(), expectile=config.expectile)
        self.value.make_value_estimator(gamma=config.gamma)
        self.targets = SoftUpdate(self.value, eps=config.target_eps)
        self.actor = AdvantageWeightedLoss(start, beta=config.beta, loss_function=config.distance)
        self.loss = nn.ModuleDict({"value": self.value, "actor": self.actor})
        self.optimizers["critic"] = adamw(self.value.parameters(), config.critic_learning_rate)
        self.optimizers["actor"] = adamw(self.actor.parameters(), config.cloning_learning_rate)

    def observe(self, rows: TensorDictBase) -> None:
        self.replay.extend(rows)

    def learn(self, steps: int) -> None:
        for _ in range(steps):
            batch = self.replay.sample(self.config.batch_size)
            found = self.value(batch)
            self.optimize("critic", found["loss_value"])
            self.targets.step()
            self.tell(loss_value=found["loss_value"], value=found["value"])
            if self.made >= self.config.warm_up:
                advantage = self.value.advantage(batch)
                batch.set("advantage", standardize_by_task(advantage, batch["task_id"]))
                self.policy.train()
                found = self.actor(batch)
                self.policy.eval()
                self.optimize("actor", found["loss_actor"])
                self.tell(loss_actor=found["loss_actor"])
            self.made += 1


@dataclass(frozen=True, kw_only=True)
class ExpertIterationConfig(NoiseConfig):
    """How "expert-iteration" trains."""

    cloning_learning_rate: Scale = 3e-4  # of AdamW


class ExpertIterationLearner(Learner):
    """Behavioral cloning of demonstrations and of the policy's own successful episodes, half of each minibatch each;
    as many gradient steps at the end of each round as other methods make in it."""

    config_type = ExpertIterationConfig
    config: ExpertIterationConfig
    wants_round = True

    def make(self, critic: Any) -> None:
        if critic is not None:
            raise ValueError("critic: expert iteration has none; leave it out")
        self.loss = bc_loss(self.policy.train(), self.config.distance)  # its copy has the start's noise on features
        self.policy.eval()
        self.optimizers["actor"] = adamw(self.loss.parameters(), self.config.cloning_learning_rate)

    def end_round(self, rows: TensorDictBase | None, steps: int) -> None:
        assert rows is not None
        if (kept := successful(rows)) is not None:
            self.replay.extend(kept)
        if not self.replay.storage.num_grown:
            return
        for _ in range(steps):
            found = self.loss(self.replay.sample(self.config.batch_size))["loss_bc"]
            self.optimize("actor", found)
            self.tell(loss_actor=found)
            self.made += 1


def successful(rows: TensorDictBase) -> TensorDictBase | None:
    """The rows of a round (N, T), time last, that belong to episodes that ended in success: (R,); None for none."""
    ids = rows["collector", "traj_ids"]
    here = torch.isin(ids, ids[rows["next", "success"].squeeze(-1)])
    return rows[here] if here.any() else None
