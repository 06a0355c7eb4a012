"""What a QueryEvaluator answers is looked at once, where it is called."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch.func import vmap

import lw_torchrl as lw

PLANS = lw.load_plans("MT10")
S = PLANS.num_steps


class Answers(lw.QueryEvaluator):
    def __init__(self, plans, make):
        super().__init__(plans)
        self.make = make

    def logits(self, observation, task_id):
        return self.make(*task_id.shape)


def act(make):
    evaluator = Answers(PLANS, make)
    state = TensorDict(observation=torch.rand(2, 39), task_id=torch.full((2,), lw.task_id("push")), batch_size=2)
    return lw.PlanConditionedActor(PLANS, evaluator=evaluator, width=8).eval()(state)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda b: torch.zeros(b, S - 1), ValueError, rf"of Answers must be \(B, {S}\).*got shape \(2, {S - 1}\)"),
        (lambda b: torch.zeros(()), ValueError, r"must be \(B, .*got shape \(\)"),
        (lambda b: torch.zeros(b + 1, S), ValueError, rf"must be \(2, {S}\), a row for each.*got shape \(3, {S}\)"),
        (lambda b: torch.zeros(b, S, dtype=torch.bool), TypeError, r"must be float32.*got torch.bool"),
    ],
)
def test_other_logits_are_refused_by_name(make, error, message):
    with pytest.raises(error, match=message):
        act(make)


def test_double_precision_is_taken():
    double, single = (act(lambda b, d=d: torch.zeros(b, S, dtype=d)) for d in (torch.float64, torch.float32))
    assert torch.equal(double["skill_weights"], single["skill_weights"])


def test_alone_it_looks_too():
    state = TensorDict(observation=torch.rand(2, 39), task_id=torch.zeros(2, dtype=torch.int64), batch_size=2)
    with pytest.raises(ValueError, match="a column for each step"):
        Answers(PLANS, lambda b: torch.zeros(b, S + 1))(state)


def test_it_can_be_mapped_over():
    evaluator = Answers(PLANS, lambda b: torch.zeros(b, S))
    assert vmap(evaluator.answers)(torch.zeros(3, 2, 39), torch.zeros(3, 2)).shape == (3, 2, S)
