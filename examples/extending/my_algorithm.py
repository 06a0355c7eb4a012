"""An online algorithm of your own: imitate all that was done, and what earned more, more.

lw-torchrl online reach --start few-shot-mt50 --methods reward-weighted --frames 2000 --seeds 0 --import my_algorithm
"""

from dataclasses import dataclass

from lw_torchrl.training import LEARNERS
from lw_torchrl.training.algorithms import Learner, NoiseConfig, adamw


@dataclass(frozen=True, kw_only=True)
class RewardWeightedConfig(NoiseConfig):  # frames, rows, batch_size, exploration, ... and:
    beta: float = 1.0  # how sharply rewards weigh
    learning_rate: float = 3e-4


class RewardWeightedLearner(Learner):
    config_type = RewardWeightedConfig

    def make(self, critic):  # all that is trained, and its optimizers
        self.loss = self.policy
        self.optimizers["actor"] = adamw(self.policy.parameters(), self.config.learning_rate)

    def observe(self, rows):  # (N, T) rows that came
        self.replay.extend(rows)

    def learn(self, steps):  # so many gradient steps are due
        for _ in range(steps):
            batch = self.replay.sample(self.config.batch_size)
            wanted, reward = batch["action"].clone(), batch["next", "reward"].squeeze(-1)
            earned = (reward - reward.mean()) / reward.std().clamp(min=1e-6)
            weight = (self.config.beta * earned).softmax(0)
            loss = (weight * (self.policy(batch)["action"] - wanted).abs().mean(-1)).sum()
            self.optimize("actor", loss)
            self.tell(loss_actor=loss)  # what is logged
            self.made += 1


LEARNERS["reward-weighted"] = RewardWeightedLearner
