"""A QueryEvaluator under other plans: the same weights, not a copy of them."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
OTHER = lw.Plans([PLANS["push"]])


class Answers(lw.QueryEvaluator):
    """A table for the plans, a network, and a statistic."""

    def __init__(self, plans: lw.Plans, width: int = 5) -> None:
        super().__init__(plans)
        self.config = {"width": width}
        self.net = nn.Sequential(nn.Linear(39, width), nn.Linear(width, 1))
        self.register_buffer("seen", torch.zeros(()))
        self.register_buffer("table", torch.ones(len(plans), plans.num_steps), persistent=False)

    def logits(self, observation, task_id):
        return self.net(observation) + self.table[0] + self.seen


def state(plans):
    return TensorDict(observation=torch.rand(2, 39), task_id=torch.full((2,), lw.task_id("push"))).auto_batch_size_()


def test_with_plans_shares_its_weights_and_not_its_tables():
    actor = lw.PlanConditionedActor(PLANS, evaluator=Answers(PLANS), width=8).eval()
    other = actor.with_plans(OTHER)
    assert {id(one) for one in actor.parameters()} == {id(one) for one in other.parameters()}
    assert other.evaluator.seen is actor.evaluator.seen
    assert other.evaluator.table.shape == (1, OTHER.num_steps)
    assert not other.evaluator.training
    other(state(OTHER))["action"].sum().backward()
    assert actor.evaluator.net[0].weight.grad is not None


def test_weights_of_another_shape_are_refused():
    class Columns(Answers):
        def __init__(self, plans):
            super().__init__(plans)
            self.config = {}
            self.net = nn.Linear(39, plans.num_steps)

    actor = lw.PlanConditionedActor(PLANS, evaluator=Columns(PLANS), width=8)
    with pytest.raises(RuntimeError, match="size mismatch for net"):
        actor.with_plans(OTHER)
