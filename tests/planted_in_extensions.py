"""What a user adds to the tables, typed, with three mistakes: mypy --strict finds them (test_packaging.py)."""

from typing import Any

import torch
from torch import Tensor, nn

import lw_torchrl as lw
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import METHODS, Features, SkillEncoder


def small(plans: lw.Plans) -> lw.PlanConditionedActor:
    return lw.PlanConditionedActor(plans, skill_encoder=SkillEncoder(64))


class Flat(lw.QueryEvaluator):
    def logits(self, observation: Tensor, task_id: Tensor) -> Tensor:
        return torch.zeros(*task_id.shape, self.plans.num_steps)


class Hand(Features):
    width = 3

    def compute(self, tensordict: Any) -> Tensor:
        hand: Tensor = tensordict["observation"][..., :3]
        return hand


class Texts(Features):
    def compute(self, tensordict: Any) -> list[str]:  # planted
        return ["near"]


METHODS["small"] = small
METHODS["words"] = "my_module:words"
METHODS["linear"] = 64  # planted
RELATIONS["far from"] = (Comparison("xyz", ">", 0.3),)
RELATIONS["near to"] = Comparison("xyz", "<", 0.3)  # planted
plans = lw.load_plans("MT10")
actor = lw.PlanConditionedActor(
    plans, skill_encoder=SkillEncoder(64), features=Hand(0.05, ["observation"]), decoder=nn.Identity()
)
evaluator = Flat(plans)
