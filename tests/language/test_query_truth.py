"""QueryProgram against the published query answering function, on real and random states of all 50 tasks."""

import random

import language_world as oracle
import numpy as np
import pytest
import torch
from cases import read_cases
from states import REAL, observation, random_states, real_states

from lw_torchrl.language.queries import parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import MT10, MT50, TASKS, task_id

DIRECT = 15  # states of each task, on which conjunctions are asked of the oracle as they are


def ask_oracle(task, queries, states):
    return np.stack([oracle.eval_queries(task, queries, state) for state in states]).astype(bool)


def ask_program(task, queries, states):
    observation = torch.from_numpy(states)
    answer = QueryProgram({task: queries})(observation, torch.full((len(states),), task_id(task)))
    assert answer.dtype == torch.bool
    return answer.numpy()


def conjunctions(task, n):
    rng = random.Random(task)
    published = oracle.enumerate_base_queries(task)
    return [rng.sample(range(len(published)), rng.choice([2, 2, 3, 4])) for _ in range(n)]


def differences(queries, states, expected, found):
    wrong = np.argwhere(expected != found)[:5]
    return [f"{queries[q]!r}: {expected[s, q]} in the oracle; state {states[s].tolist()}" for s, q in wrong]


def agree(task, states, direct, joined=200):
    """Every base query on every state; ``joined`` conjunctions directly on ``direct`` states, on all as the AND."""
    published = oracle.enumerate_base_queries(task)
    expected = ask_oracle(task, published, states)
    found = ask_program(task, published, states)
    assert found.shape == (len(states), len(published))
    assert not differences(published, states, expected, found)
    # Our own list, in canonical spelling, asked of the oracle as it is.
    listed = list(supported_queries(task, published_only=True))
    few = states[:5]
    assert not differences(listed, few, ask_oracle(task, listed, few), ask_program(task, listed, few))
    picked = conjunctions(task, joined)
    texts = [" and ".join(published[i] for i in picks) for picks in picked]
    found = ask_program(task, texts, states)
    clauses = np.stack([expected[:, picks].all(1) for picks in picked], 1)
    assert not differences(texts, states, clauses, found)
    asked = ask_oracle(task, texts, states[direct])
    assert not differences(texts, states[direct], asked, found[direct])
    return expected


def test_the_truth_is_the_oracles_in_all_tasks():
    for task in MT50:
        agree(task, random_states(task, n=20), slice(2), joined=40)


@pytest.mark.parametrize("task", [pytest.param(task, marks=[pytest.mark.slow] * (task != "reach")) for task in MT50])
def test_the_truth_is_the_oracles_on_random_states(task):
    states = random_states(task)
    expected = agree(task, states, slice(DIRECT))
    # Each query is true in some of the states and false in others.
    published = oracle.enumerate_base_queries(task)
    constant = [published[i] for i in np.flatnonzero(expected.all(0) | ~expected.any(0))]
    assert not constant


@pytest.mark.slow
@pytest.mark.parametrize("task", MT50)
def test_the_truth_is_the_oracles_on_real_states(task):
    states = real_states(task)
    assert len(np.unique(states, axis=0)) == len(states) == REAL
    agree(task, states, slice(None, None, REAL // DIRECT))


def test_every_pair_of_clauses_is_the_and_of_its_clauses():
    published = oracle.enumerate_base_queries("reach")
    pairs = [(a, b) for a in range(len(published)) for b in range(len(published))]
    states = random_states("reach", seed=1, n=50)
    expected = ask_oracle("reach", published, states)
    found = ask_program("reach", [f"{published[a]} and {published[b]}" for a, b in pairs], states)
    np.testing.assert_array_equal(found, np.stack([expected[:, a] & expected[:, b] for a, b in pairs], 1))


def test_queries_that_are_parsed_but_not_listed():
    # Touching for any object, around either way, the negations of open and closed.
    task = "pick-place-wall"
    states = random_states(task, seed=2)
    names = TASKS[task].published.object_names
    wider = [f"the {name} is {n}touching the table" for name in names for n in ("", "not ")]
    wider += [f"the {a} is {n}around the {b}" for a in names for b in names if a != b for n in ("", "not ")]
    expected = ask_oracle(task, wider, states)
    np.testing.assert_array_equal(ask_program(task, wider, states), expected)
    same = ask_program(task, ["gripper isn't open", "gripper closed", "gripper open", "gripper isn't closed"], states)
    assert (same == [[closed, closed, not closed, not closed] for closed in same[:, 0]]).all()


@pytest.mark.parametrize(("query", "at", "expected"), read_cases("language/queries.toml")["thresholds"])
def test_on_the_threshold_float32_answers_as_published(query, at, expected):
    state = observation(**at)
    assert QueryProgram({"push": [query]})(state, torch.tensor(task_id("push"))).tolist() == [expected]
    text = str(parse_query(query, "push"))
    assert bool(oracle.eval_queries("push", [text], state.numpy())[0]) is expected


@pytest.mark.parametrize("task", MT10)
def test_float64_states_answer_as_the_oracle_does_in_float64(task):
    published = oracle.enumerate_base_queries(task)
    states = random_states(task, seed=4, n=40).astype(np.float64)
    states += np.random.default_rng(0).normal(0, 1e-3, states.shape)
    np.testing.assert_array_equal(ask_program(task, published, states), ask_oracle(task, published, states))


def test_float64_is_not_rounded_to_float32():
    # Neither the state nor the thresholds (0.02 rounded to float32 is less than 0.02) nor fixed places.
    program = QueryProgram(
        {"push": ["gripper open", "puck touching the table"], "button-press-wall": ["gripper above wall"]}
    )
    state = torch.zeros(2, 39, dtype=torch.float64)
    state[0, [3, 6]] = torch.tensor([0.75 + 1e-12, 0.02], dtype=torch.float64)
    state[1, :3] = torch.tensor([0.1 + 0.02 - 1e-10, 0.6, 1e-12], dtype=torch.float64)
    ids = torch.tensor([task_id("push"), task_id("button-press-wall")])
    assert program(state, ids).tolist() == [[True, True], [True, False]]
