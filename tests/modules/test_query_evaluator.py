"""A QueryEvaluator in front of a policy: soft and hard answers, other plans, and logits that are refused."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictSequential
from torch import nn
from torch.func import vmap

import lw_torchrl as lw
from lw_torchrl.modules import with_plans

PLANS = lw.load_plans("MT10")
OTHER = lw.Plans([PLANS["push"]])
S = PLANS.num_steps


class Network(lw.QueryEvaluator):
    """A table for the plans, a network, and a statistic."""

    def __init__(self, plans, width=5):
        super().__init__(plans)
        self.config = {"width": width}
        self.net = nn.Sequential(nn.Linear(39, width), nn.Linear(width, 1))
        self.register_buffer("seen", torch.zeros(()))
        self.register_buffer("table", torch.ones(len(plans), plans.num_steps), persistent=False)

    def logits(self, observation, task_id):
        return self.net(observation) + self.table[0] + self.seen


class Answers(lw.QueryEvaluator):
    """Returns any logits."""

    def __init__(self, plans, make, **options):
        super().__init__(plans, **options)
        self.make = make

    def logits(self, observation, task_id):
        return self.make(*task_id.shape)


def state(rows=2):
    ids = torch.full((rows,), lw.task_id("push"))
    return TensorDict(observation=torch.rand(rows, 39), task_id=ids, batch_size=rows)


def test_soft_answers_are_probabilities_and_hard_ones_have_their_gradient():
    logits = torch.linspace(-8, 8, 2 * S).reshape(2, S).requires_grad_()
    soft = Answers(PLANS, lambda b: logits)(state())["qaf"]
    assert torch.equal(soft, logits.sigmoid())
    (slope,) = torch.autograd.grad(soft.sum(), logits)
    hard = Answers(PLANS, lambda b: logits, answers="hard")(state())["qaf"]
    assert torch.equal(hard, (logits > 0).float())
    assert torch.equal(torch.autograd.grad(hard.sum(), logits)[0], slope)


def test_hard_answers_act_as_exact_truth_does():
    class Truth(lw.QueryEvaluator):
        def logits(self, observation, task_id):
            rows = TensorDict(observation=observation, task_id=task_id, batch_size=task_id.shape)
            return torch.where(lw.QAFTransform(self.plans)(rows)["qaf"], 0.3, -12.0)

    actor, rows = lw.PlanConditionedActor(PLANS).eval(), state(20)
    expected = actor(lw.QAFTransform(PLANS)(rows.clone()))
    for answers in ("hard", "soft"):
        policy = TensorDictSequential(Truth(PLANS, answers=answers), actor)
        assert policy.in_keys == ["observation", "task_id"]
        found = policy(rows.clone())
        for key in ("skill_weights", "action"):
            assert torch.equal(found[key], expected[key]) is (answers == "hard"), key


def test_a_constructor_that_does_not_accept_answers_stays_soft():
    evaluator = Network(PLANS)
    assert (evaluator.answers, evaluator.config) == ("soft", {"width": 5})
    with pytest.raises(TypeError, match="constructor of Network must accept answers=, got answers='hard'"):
        evaluator.answers = "hard"
    evaluator = lw.StateQueryEvaluator(PLANS, width=8)
    evaluator.answers = "hard"
    assert evaluator.with_plans(OTHER).answers == evaluator.config["answers"] == "hard"
    with pytest.raises(ValueError, match="answers must be one of 'soft', 'hard', got 'firm'"):
        evaluator.answers = "firm"


def test_with_plans_shares_its_weights_and_not_its_tables():
    policy = TensorDictSequential(Network(PLANS), lw.PlanConditionedActor(PLANS)).eval()
    other = with_plans(policy, OTHER)
    assert {id(one) for one in policy.parameters()} == {id(one) for one in other.parameters()}
    evaluator, own = other[0], policy[0]
    assert evaluator.seen is own.seen
    assert evaluator.table.shape == (1, OTHER.num_steps)
    assert not evaluator.training
    other(state())["action"].sum().backward()
    assert own.net[0].weight.grad is not None


def test_weights_of_another_shape_are_refused():
    class Columns(Network):
        def __init__(self, plans):
            super().__init__(plans)
            self.config = {}
            self.net = nn.Linear(39, plans.num_steps)

    with pytest.raises(RuntimeError, match="size mismatch for net"):
        Columns(PLANS).with_plans(OTHER)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda b: torch.zeros(b, S - 1), ValueError, rf"of Answers must be \(B, {S}\).*got shape \(2, {S - 1}\)"),
        (lambda b: torch.zeros(()), ValueError, r"must be \(B, .*got shape \(\)"),
        (lambda b: torch.zeros(b + 1, S), RuntimeError, r"batch dimension mismatch"),
        (lambda b: torch.zeros(b, S, dtype=torch.bool), TypeError, r"must be float32.*got torch.bool"),
    ],
)
def test_other_logits_are_refused_by_name(make, error, message):
    with pytest.raises(error, match=message):
        Answers(PLANS, make)(state())


def test_double_precision_is_taken_and_rows_can_be_mapped_over():
    evaluator = Answers(PLANS, lambda b: torch.zeros(b, S, dtype=torch.float64))
    assert evaluator(state())["qaf"].dtype == torch.float32
    batch = torch.stack([state(), state(), state()])
    assert vmap(evaluator.logits_of)(batch).shape == (3, 2, S)
