"""QueryProgram.logits: the sign is the hard truth, and gradients are finite and those of the deciding comparison."""

import functools
import random

import numpy as np
import pytest
import torch
from cases import read_cases
from hypothesis import example, given, settings
from hypothesis import strategies as st
from states import observation, random_states, real_states

from lw_torchrl.language.queries import supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import MT50, TASKS, task_id


@functools.cache
def everything():
    """Return a program of every base query of all 50 tasks, more negations, and conjunctions."""
    queries = {}
    for task in MT50:
        rng, base = random.Random(task), list(supported_queries(task))
        joined = [" and ".join(rng.sample(base, rng.choice([2, 3, 4]))) for _ in range(40)]
        queries[task] = [*base, "gripper is not open", "gripper isn't closed", *joined]
    return QueryProgram(queries)


def on_thresholds(states):
    """Round states to half centimetres, which puts many differences on a threshold."""
    return (np.round(states * 200) / 200).astype(states.dtype)


def same_sign(program, states, ids):
    """Compare the signs of all pairs, and return their number."""
    soft, hard = program.logits(states, ids), program(states, ids)
    assert soft.shape == hard.shape
    assert soft.dtype == torch.float32
    assert soft.isfinite().all()
    assert (soft != 0).all()
    assert torch.equal(soft > 0, hard)
    return sum(len(program.queries[MT50[i]]) for i in ids.reshape(-1).tolist())


@pytest.mark.parametrize(
    ("seeds", "n", "pairs"), [((11,), 10, 150_000), pytest.param((11, 12), 40, 1_000_000, marks=pytest.mark.slow)]
)
def test_soft_and_hard_truth_agree(seeds, n, pairs):
    compared = 0
    for seed in seeds:
        states = [random_states(task, seed=seed, n=n) for task in MT50]
        ids = torch.arange(50).repeat_interleave(n)
        for found in (np.concatenate(states), on_thresholds(np.concatenate(states))):
            for dtype in (torch.float32, torch.float64):
                compared += same_sign(everything(), torch.from_numpy(found).to(dtype), ids)
    assert compared > pairs


def test_soft_and_hard_truth_agree_on_an_experts_states():
    for task in ("reach", "peg-insert-side", "drawer-open"):
        states = torch.from_numpy(real_states(task))
        same_sign(everything(), states, torch.full((len(states),), task_id(task)))


CASES = read_cases("language/queries.toml")


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision(dtype):
    states = torch.cat([torch.from_numpy(random_states(task, n=5)) for task in MT50]).to(dtype).requires_grad_()
    ids = torch.arange(50).repeat_interleave(5)
    same_sign(everything(), states.detach(), ids)
    (gradient,) = torch.autograd.grad(everything().logits(states, ids).sum(), states)
    assert gradient.isfinite().all()


numbers = st.floats(-0.25, 0.25, width=32) | st.sampled_from([0.0, 0.02, 0.03, 0.04, -0.04, 0.06, 0.12, 0.23, 0.75])
large = st.floats(allow_nan=False, allow_infinity=False, width=32)


@settings(max_examples=40, deadline=None)
@example([0.0] * 39, 3)
@example([3.4e38] * 20 + [-3.4e38] * 19, 12)
@given(st.lists(numbers | large, min_size=39, max_size=39), st.integers(0, 49))
def test_logits_and_gradients_are_finite_for_any_finite_state(state, task):
    numbers = torch.tensor(state, requires_grad=True)
    logits = everything().logits(numbers, torch.tensor(task))
    assert logits.isfinite().all()
    assert torch.equal(logits > 0, everything()(numbers.detach(), torch.tensor(task)))
    (gradient,) = torch.autograd.grad(logits.sum(), numbers)
    assert gradient.isfinite().all()


def logit_of(query, task="push", temperature=1.0, **at):
    state = observation(**at)
    state.requires_grad_()
    logit = QueryProgram({task: [query]}).logits(state, torch.tensor(task_id(task)), temperature=temperature)
    (gradient,) = torch.autograd.grad(logit.sum(), state)
    return logit.item(), gradient


@pytest.mark.parametrize(("query", "at", "expected"), CASES["logits"])
def test_a_logit_is_the_distance_to_the_threshold_over_the_temperature(query, at, expected):
    logit, gradient = logit_of(query, **at)
    assert logit == pytest.approx(expected, rel=1e-4)
    assert gradient.abs().sum() > 0
    half, _ = logit_of(query, temperature=2.0, **at)
    assert half == pytest.approx(expected / 2, rel=1e-4)


@pytest.mark.parametrize(("query", "at", "reached"), CASES["gradients"])
def test_the_gradient_is_that_of_the_comparison_that_decides(query, at, reached):
    _, gradient = logit_of(query, **at)
    assert gradient.nonzero().flatten().tolist() == reached
    assert gradient.abs().max() == pytest.approx(20.0 if reached == [3] else 100.0, rel=1e-4)


def test_on_the_threshold_a_logit_has_the_sign_of_the_hard_truth():
    assert logit_of("gripper open", opening=0.75)[0] == pytest.approx(-1e-6)
    assert logit_of("gripper closed", opening=0.75)[0] == pytest.approx(1e-6)


def test_padding_is_far_below_at_any_temperature():
    program = QueryProgram({"push": ["gripper open"], "reach": ["gripper open", "gripper closed"]})
    for temperature in (1e-6, 1e-3, 1.0, 1e3, 1e6):
        logits = program.logits(torch.zeros(39), torch.tensor(task_id("push")), temperature=temperature)
        assert logits[1].item() == -1e4


def test_following_the_gradient_makes_a_query_true():
    query = "the gripper is above the puck and the puck is near the target location and the gripper is open"
    program, ids = QueryProgram({"push": [query]}), torch.full((64,), task_id("push"))
    state = torch.from_numpy(random_states("push", n=64)).requires_grad_()
    for _ in range(1000):
        logits = program.logits(state, ids)
        (gradient,) = torch.autograd.grad(logits.clamp(max=0.2).sum(), state)
        state = (state + 8e-5 * gradient).detach().requires_grad_()
    assert program(state.detach(), ids).float().mean() > 0.95


def test_logits_do_not_change_the_hard_truth():
    program, ids = everything(), torch.arange(50)
    states = torch.stack([torch.from_numpy(random_states(task, n=1)[0]) for task in TASKS])
    before = program(states, ids)
    program.logits(states.double(), ids)
    assert torch.equal(program(states, ids), before)
    assert not program(states.clone().requires_grad_(), ids).requires_grad
