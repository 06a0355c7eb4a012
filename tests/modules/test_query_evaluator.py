"""QueryEvaluator: checks of its logits, and the same weights under other plans."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
OTHER = lw.Plans([PLANS["push"]])
S = PLANS.num_steps


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
    actor = TensorDictSequential(Answers(PLANS), lw.PlanConditionedActor(PLANS)).eval()
    other = lw.modules.with_plans(actor, OTHER)
    assert {id(one) for one in actor.parameters()} == {id(one) for one in other.parameters()}
    assert other[0].seen is actor[0].seen
    assert other[0].table.shape == (1, OTHER.num_steps)
    assert not other[0].training
    other(state(OTHER))["action"].sum().backward()
    assert actor[0].net[0].weight.grad is not None


def test_weights_of_another_shape_are_refused():
    class Columns(Answers):
        def __init__(self, plans):
            super().__init__(plans)
            self.config = {}
            self.net = nn.Linear(39, plans.num_steps)

    with pytest.raises(RuntimeError, match="size mismatch for net"):
        Columns(PLANS).with_plans(OTHER)


class Made(lw.QueryEvaluator):
    def __init__(self, make):
        super().__init__(PLANS)
        self.make = make

    def logits(self, observation, task_id):
        return self.make(*task_id.shape)


def act(make):
    return TensorDictSequential(Made(make), lw.PlanConditionedActor(PLANS).eval())(state(PLANS))


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda b: torch.zeros(b, S - 1), ValueError, rf"of Made must be \(B, {S}\).*got shape \(2, {S - 1}\)"),
        (lambda b: torch.zeros(()), ValueError, r"must be \(B, .*got shape \(\)"),
        (lambda b: torch.zeros(b, S, dtype=torch.bool), TypeError, r"must be float32.*got torch.bool"),
    ],
)
def test_wrong_logits_are_refused_by_name(make, error, message):
    with pytest.raises(error, match=message):
        act(make)


def test_logits_of_double_precision_are_accepted():
    double, single = (act(lambda b, d=d: torch.zeros(b, S, dtype=d)) for d in (torch.float64, torch.float32))
    assert torch.equal(double["skill_weights"], single["skill_weights"])
    assert double["qaf"].dtype == torch.float32
