"""PlanAttention: softmax over the real steps of 10·truth - 5."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules import PlanAttention


def make_plan(task, steps):
    return ConditionalPlan.from_pairs(
        task, [("the gripper is open", f"move the gripper {i} times") for i in range(steps)]
    )


PLANS = Plans([make_plan("push", 4), make_plan("reach", 2), make_plan("sweep", 1)])
PUSH, REACH, SWEEP = (task_id(task) for task in PLANS)
LENGTH = {PUSH: 4, REACH: 2, SWEEP: 1}


def weights(qaf, task_ids):
    qaf, task_ids = torch.as_tensor(qaf), torch.as_tensor(task_ids)
    return PlanAttention(PLANS)(TensorDict({"qaf": qaf, "task_id": task_ids}, task_ids.shape))["skill_weights"]


def test_the_softmax_by_hand():
    found = weights([[True, False, True, False], [False, True, False, False]], [PUSH, REACH])
    high, low = math.exp(5), math.exp(-5)
    push = [high, low, high, low]
    expected = [[x / sum(push) for x in push], [low / (high + low), high / (high + low), 0, 0]]
    torch.testing.assert_close(found, torch.tensor(expected))
    assert found.dtype == torch.float32


def test_no_condition_true_is_uniform_over_the_real_steps():
    found = weights(torch.zeros(3, 4, dtype=torch.bool), [PUSH, REACH, SWEEP])
    torch.testing.assert_close(found, torch.tensor([[0.25] * 4, [0.5, 0.5, 0, 0], [1.0, 0, 0, 0]]))


def test_all_conditions_true_is_uniform_too():
    qaf = torch.tensor([[True] * 4, [True, True, False, False]])
    torch.testing.assert_close(weights(qaf, [PUSH, REACH]), torch.tensor([[0.25] * 4, [0.5, 0.5, 0, 0]]))


def test_truth_on_padding_gets_nothing():
    torch.testing.assert_close(weights([[False, False, True, True]], [REACH]), torch.tensor([[0.5, 0.5, 0, 0]]))


def test_soft_truth_moves_the_weight_smoothly():
    found = weights(torch.tensor([[0.5, 0.7, 0.0, 0.0]]), [REACH])
    odds = math.exp(10 * 0.2)
    torch.testing.assert_close(found, torch.tensor([[1 / (1 + odds), odds / (1 + odds), 0, 0]]))
    torch.testing.assert_close(weights([[1.0, 0, 1, 0]], [PUSH]), weights([[True, False, True, False]], [PUSH]))


def test_the_gradient_reaches_soft_truth_and_no_padding():
    qaf = torch.full((1, 4), 0.5, requires_grad=True)
    weights(qaf, [REACH])[0, 0].backward()
    assert qaf.grad[0, 0] > 0
    assert qaf.grad[0, 1] < 0
    assert qaf.grad[0, 2:].tolist() == [0, 0]


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 3), max_size=3), st.integers(0, 2**31), st.booleans())
def test_weights_sum_to_one_over_the_real_steps_for_any_leading_shape(shape, seed, soft):
    generator = torch.Generator().manual_seed(seed)
    task_ids = torch.tensor(list(LENGTH))[torch.randint(3, tuple(shape), generator=generator)]
    qaf = torch.rand(*shape, 4, generator=generator)
    found = weights(qaf if soft else qaf > 0.5, task_ids)
    assert found.shape == (*shape, 4)
    torch.testing.assert_close(found.sum(-1), torch.ones(tuple(shape)))
    lengths = task_ids.clone().apply_(LENGTH.get)
    padding = torch.arange(4) >= lengths.unsqueeze(-1)
    assert (found[padding] == 0).all()
    assert (found[~padding] > 0).all()


def test_a_row_does_not_depend_on_its_neighbours():
    generator = torch.Generator().manual_seed(0)
    qaf = torch.rand(20, 4, generator=generator) > 0.5
    task_ids = torch.tensor(list(LENGTH))[torch.randint(3, (20,), generator=generator)]
    together = weights(qaf, task_ids)
    assert torch.equal(together, torch.stack([weights(qaf[i], task_ids[i]) for i in range(20)]))


def test_a_task_without_a_plan_is_named():
    with pytest.raises(ValueError, match=r"without a plan.*: box-close, lever-pull"):
        weights(torch.zeros(3, 4), [task_id("lever-pull"), REACH, task_id("box-close")])


@pytest.mark.parametrize("wrong", [-1, 50, 1000])
def test_a_number_that_is_no_task_is_named(wrong):
    with pytest.raises(ValueError, match=f"task_id.*{wrong}"):
        weights(torch.zeros(2, 4), [REACH, wrong])


@pytest.mark.parametrize("shape", [(2, 3), (2, 5), (2, 1, 4)])
def test_truth_of_another_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"qaf must have shape \(2, 4\).*QAFTransform the same plans"):
        weights(torch.zeros(shape), [REACH, PUSH])


def test_a_plain_mapping_is_taken_for_plans():
    plan = make_plan("reach", 2)
    found = PlanAttention({"reach": plan})(TensorDict(qaf=torch.zeros(2), task_id=torch.tensor(REACH)))
    assert found["skill_weights"].tolist() == [0.5, 0.5]


def test_the_mask_is_no_part_of_the_saved_state():
    assert PlanAttention(PLANS).state_dict() == {}


@pytest.mark.parametrize("wrong", [math.nan, 100.0, -0.1, math.inf])
def test_soft_truth_is_of_numbers_from_0_to_1(wrong):
    with pytest.raises(ValueError, match="qaf must be bool, or numbers from 0 to 1"):
        weights(torch.tensor([[0.5, wrong, 0.0, 0.0]]), [REACH])
    assert weights(torch.tensor([[0.0, 1.0, 0.0, 0.0]]), [REACH]).sum() == 1
