"""What a user adds to the tables, typed, with three mistakes: mypy --strict finds them (test_packaging.py)."""

import torch
from torch import Tensor, nn

import lw_torchrl as lw
from lw_torchrl.language.relations import RELATIONS, Comparison
from lw_torchrl.modules import ENCODERS, EVALUATORS, METHODS, POLICIES, Encoder, Encoding, Method


class Blind(lw.Policy):
    def act(self, observation: Tensor) -> tuple[Tensor, ...]:
        return (observation[:, :4],)


class Flat(lw.QueryEvaluator):
    def logits(self, observation: Tensor, task_id: Tensor) -> Tensor:
        return torch.zeros(*task_id.shape, self.plans.num_steps)


class Numbers(Encoder):
    def encode(self, rows: Tensor, seen: Tensor) -> Encoding:
        return Encoding(latent=rows, features=seen)


class Words(Encoder):
    def encode(self, rows: Tensor, seen: Tensor) -> Tensor:  # planted
        return rows


POLICIES["Blind"] = Blind
EVALUATORS["Flat"] = Flat
ENCODERS["Numbers"] = "my_module:Numbers"
METHODS["mine"] = Method("Blind")
RELATIONS["far from"] = (Comparison("xyz", ">", 0.3),)
POLICIES["Linear"] = nn.Linear  # planted
RELATIONS["near to"] = Comparison("xyz", "<", 0.3)  # planted
plans = lw.load_plans("MT10")
actor = lw.PlanConditionedActor(plans, width=64, evaluator=Flat(plans))
