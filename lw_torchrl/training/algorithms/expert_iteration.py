"""Expert iteration: what a policy achieved in a round becomes its demonstrations of the next one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase

from lw_torchrl._checks import Scale
from lw_torchrl.training.algorithms.learner import Learner, NoiseConfig, adamw
from lw_torchrl.training.behavioral_cloning import bc_loss


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
