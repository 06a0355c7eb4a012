"""QueryProgram against the published query answering function, on real and random states of all 50 tasks."""

import functools
import math
import random
import shutil

import language_world as oracle
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from states import REAL, random_states, real_states

from lw_torchrl.language.named_objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import Clause, Query, parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import MT10, MT50, TASKS, Task, task_id

DIRECT = 15  # of each, on which conjunctions are asked of the oracle as they are


def ask_oracle(task, queries, states):
    return np.stack([oracle.eval_queries(task, queries, state) for state in states]).astype(bool)


def ask_program(task, queries, states):
    observation = torch.from_numpy(states)
    answer = QueryProgram({task: queries})(observation, torch.full((len(states),), task_id(task)))
    assert answer.dtype == torch.bool
    return answer.numpy()


def conjunctions(task, n=200):
    rng = random.Random(task)
    published = oracle.enumerate_base_queries(task)
    return [rng.sample(range(len(published)), rng.choice([2, 2, 3, 4])) for _ in range(n)]


def differences(queries, states, expected, found):
    return [
        f"{queries[q]!r}: {expected[s, q]} in the oracle; state {states[s].tolist()}"
        for s, q in np.argwhere(expected != found)[:5]
    ]


def agree(task, states, direct):
    """Every base query on every state; 200 conjunctions directly on ``direct`` states, on all as the AND."""
    published = oracle.enumerate_base_queries(task)
    expected = ask_oracle(task, published, states)
    found = ask_program(task, published, states)
    assert found.shape == (len(states), len(published))
    assert not differences(published, states, expected, found)
    # Our own list, in canonical spelling, asked of the oracle as it is.
    listed = list(supported_queries(task, published_only=True))
    assert not differences(
        listed, states[:5], ask_oracle(task, listed, states[:5]), ask_program(task, listed, states[:5])
    )
    picked = conjunctions(task)
    texts = [" and ".join(published[i] for i in picks) for picks in picked]
    found = ask_program(task, texts, states)
    clauses = np.stack([expected[:, picks].all(1) for picks in picked], 1)
    assert not differences(texts, states, clauses, found)
    asked = ask_oracle(task, texts, states[direct])
    assert not differences(texts, states[direct], asked, found[direct])
    return expected


@pytest.mark.parametrize("task", MT50)
def test_the_truth_is_the_oracles_on_random_states(task):
    states = random_states(task)
    expected = agree(task, states, slice(DIRECT))
    # The states must tell: each query is true in some and false in others.
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


def test_queries_that_are_answered_and_not_listed():
    # Touching for any object, around either way, the negations of open and closed.
    task = "pick-place-wall"
    states = random_states(task, seed=2)
    names = TASKS[task].published.object_names
    wider = [f"the {name} is {n}touching the table" for name in names for n in ("", "not ")]
    wider += [f"the {a} is {n}around the {b}" for a in names for b in names if a != b for n in ("", "not ")]
    expected = ask_oracle(task, wider, states)
    np.testing.assert_array_equal(ask_program(task, wider, states), expected)
    opening = ask_program(
        task, ["gripper is not open", "gripper closed", "gripper open", "gripper isn't closed"], states
    )
    assert (opening[:, 0] == opening[:, 1]).all()
    assert (opening[:, 2] == opening[:, 3]).all()
    assert (opening[:, 0] != opening[:, 2]).all()


def observation(**at):
    state = torch.zeros(39)
    for name, value in at.items():
        start = {"hand": 0, "opening": 3, "one": 4, "two": 11, "goal": 36}[name]
        value = torch.as_tensor(value).reshape(-1)
        state[start : start + len(value)] = value
    return state


@pytest.mark.parametrize(
    ("query", "at", "expected"),
    [
        ("gripper open", {"opening": 0.75}, False),
        ("gripper closed", {"opening": 0.75}, True),
        ("gripper open", {"opening": np.nextafter(np.float32(0.75), np.float32(1))}, True),
        ("puck touching the table", {"one": [0.0, 0.6, 0.02]}, True),
        (
            "puck touching the table",
            {"one": [0.0, 0.6, np.nextafter(np.float32(0.02), np.float32(1))]},
            False,
        ),
        ("gripper above puck", {"hand": [0.1, 0.6, 0.2], "one": [0.1, 0.6, 0.2]}, False),
        ("gripper below puck", {"hand": [0.1, 0.6, 0.2], "one": [0.1, 0.6, 0.2]}, False),
        ("gripper left of puck", {"hand": [0.04, 0.0, 0.0]}, False),
        ("gripper right of puck", {"hand": [-0.04, 0.0, 0.0]}, False),
        ("gripper near puck", {"hand": [0.04, 0.0, 0.0]}, False),
        ("gripper not near puck", {"hand": [0.04, 0.0, 0.0]}, True),
    ],
)
def test_at_the_threshold_itself_float32_answers_as_published(query, at, expected):
    state = observation(**at)
    assert QueryProgram({"push": [query]})(state, torch.tensor(task_id("push"))).tolist() == [expected]
    text = str(parse_query(query, "push"))
    assert bool(oracle.eval_queries("push", [text], state.numpy())[0]) is expected


@functools.cache
def all_tasks():
    """All 50 tasks with lists of different lengths, and a mixed batch."""
    rng = random.Random(0)
    queries = {}
    for rank, task in enumerate(MT50):
        base = list(supported_queries(task))
        queries[task] = [*rng.sample(base, 1 + rank % 9), " and ".join(rng.sample(base, 1 + rank % 4))]
    ids = torch.randint(50, (600,), generator=torch.Generator().manual_seed(0))
    ids[:50] = torch.arange(50)
    states = torch.stack(
        [torch.from_numpy(random_states(MT50[i], seed=3, n=30))[row % 30] for row, i in enumerate(ids.tolist())]
    )
    return queries, states, ids


def test_a_mixed_batch_is_each_tasks_own_evaluation_and_padding_is_false():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    answer = program(states, ids)
    longest = max(map(len, queries.values()))
    assert program.num_queries == longest
    assert program.tasks == MT50
    assert answer.shape == (600, longest)
    for task in MT50:
        rows = ids == task_id(task)
        alone = QueryProgram({task: queries[task]})(states[rows], ids[rows])
        width = len(queries[task])
        assert alone.shape == (rows.sum(), width)
        assert torch.equal(answer[rows, :width], alone)
        assert not answer[rows, width:].any()
    for row in range(50):
        assert torch.equal(program(states[row], ids[row]), answer[row])


def test_a_row_does_not_depend_on_the_rows_beside_it():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    order = torch.randperm(600, generator=torch.Generator().manual_seed(1))
    assert torch.equal(program(states[order], ids[order]), program(states, ids)[order])


def test_the_order_of_the_tasks_plays_no_part():
    queries, states, ids = all_tasks()
    backwards = dict(reversed(queries.items()))
    assert QueryProgram(backwards).tasks == MT50
    assert torch.equal(QueryProgram(backwards)(states, ids), QueryProgram(queries)(states, ids))


@pytest.mark.parametrize("shape", [(), (1,), (600,), (20, 30), (2, 3, 100), (0,), (4, 0)])
def test_any_leading_shape(shape):
    queries, states, ids = all_tasks()
    n = math.prod(shape)
    program = QueryProgram(queries)
    answer = program(states[:n].reshape(*shape, 39), ids[:n].reshape(shape))
    assert answer.shape == (*shape, program.num_queries)
    assert answer.dtype == torch.bool
    assert torch.equal(answer.reshape(n, program.num_queries), program(states[:n], ids[:n]))


def test_input_that_is_not_contiguous():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    across = states.reshape(20, 30, 39).transpose(0, 1)
    answer = program(across, ids.reshape(20, 30).transpose(0, 1))
    assert torch.equal(answer, program(states, ids).reshape(20, 30, -1).transpose(0, 1))


@pytest.mark.parametrize("task", MT10)
def test_float64_states_answer_as_the_oracle_does_in_float64(task):
    published = oracle.enumerate_base_queries(task)
    states = random_states(task, seed=4, n=40).astype(np.float64)
    states += np.random.default_rng(0).normal(0, 1e-3, states.shape)
    np.testing.assert_array_equal(ask_program(task, published, states), ask_oracle(task, published, states))


def test_float32_and_float64_may_alternate():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    first = program(states, ids)
    program(states.double(), ids)
    assert torch.equal(program(states, ids), first)


def test_float64_is_not_rounded_to_float32():
    # Neither the state nor the thresholds: 0.02 rounded to float32 is less than 0.02.
    program = QueryProgram({"push": ["gripper open", "puck touching the table"]})
    state = observation(opening=0.75).double()
    state[3] += 1e-12
    state[6] = 0.02
    assert program(state, torch.tensor(task_id("push"))).tolist() == [True, True]


def test_float64_reads_fixed_places_in_float64():
    program = QueryProgram({"button-press-wall": ["gripper above wall", "gripper below wall"]})
    state = observation(hand=[0.1, 0.6, 0.0]).double()
    state[:3] = torch.tensor([0.1 + 0.02 - 1e-10, 0.6, 1e-12], dtype=torch.float64)
    assert program(state, torch.tensor(task_id("button-press-wall"))).tolist() == [True, False]


def test_int32_task_ids():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    assert torch.equal(program(states, ids.int()), program(states, ids))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_it_answers_on_the_device_of_the_observation():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    answer = program(states.cuda(), ids.cuda())
    assert answer.is_cuda
    assert torch.equal(answer.cpu(), program(states, ids))


def test_the_input_is_left_alone():
    queries, states, ids = all_tasks()
    kept, kept_ids = states.clone(), ids.clone()
    QueryProgram(queries)(states, ids)
    assert torch.equal(states, kept)
    assert torch.equal(ids, kept_ids)


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_a_conjunction_holds_where_all_its_clauses_hold(data):
    task = data.draw(st.sampled_from(MT50))
    listed = st.sampled_from(supported_queries(task))
    texts = data.draw(st.lists(listed, min_size=1, max_size=6))
    states = torch.from_numpy(random_states(task, seed=5, n=50))
    answer = QueryProgram({task: [*texts, " and ".join(texts)]})(states, torch.full((50,), task_id(task)))
    assert torch.equal(answer[:, -1], answer[:, :-1].all(1))


def test_queries_may_be_texts_in_any_spelling_or_query_objects():
    _, states, _ = all_tasks()
    spellings = [
        "Is the gripper open and not above the puck?",
        "gripper open and gripper isn't above puck",
        parse_query("the gripper is open and not above the puck", "push"),
        Query((Clause(GRIPPER, "open"), Clause(GRIPPER, "above", "puck", negated=True))),
    ]
    program = QueryProgram({"push": spellings})
    assert len(set(program.queries["push"])) == 1
    answer = program(states, torch.full((600,), task_id("push")))
    assert (answer == answer[:, :1]).all()
    assert 0 < answer[:, 0].sum() < 600


def test_a_task_object_may_be_the_key():
    mine = Task("push", "Push it.", (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("block", (11, 12, 13))))
    program = QueryProgram({mine: ["the gripper is near the block"]})
    near = observation(hand=[0.1, 0.6, 0.2], two=[0.1, 0.6, 0.21], one=[0.5, 0.9, 0.5])
    assert program(near, torch.tensor(task_id("push"))).tolist() == [True]


def test_the_same_task_twice_is_refused():
    with pytest.raises(ValueError, match="push"):
        QueryProgram({"push": ["gripper open"], TASKS["push"]: ["gripper closed"]})


@pytest.mark.parametrize(
    ("queries", "error", "says"),
    [
        ({}, ValueError, "at least one task"),
        ({"push": []}, ValueError, "at least one query"),
        ({"push": ["gripper open"], "reach": ()}, ValueError, "reach"),
        ({"push": "gripper open"}, ValueError, "list"),
        ({"psuh": ["gripper open"]}, ValueError, "'push'"),
        ({"push": ["the gripper is flying"]}, ValueError, "flying"),
        ({"push": ["gripper near drawer handle"]}, ValueError, "nearest query"),
        ({"push": [3]}, TypeError, "string"),
        ({"push": [None]}, TypeError, "string"),
        ({3: ["gripper open"]}, TypeError, "3"),
        (["gripper open"], TypeError, "map task names"),
        (None, TypeError, "map task names"),
    ],
)
def test_a_program_names_what_is_wrong(queries, error, says):
    with pytest.raises(error, match=says):
        QueryProgram(queries)


PUSH = task_id("push")


@pytest.mark.parametrize(
    ("states", "ids", "says"),
    [
        (torch.zeros(4, 38), torch.full((4,), PUSH), "39"),
        (torch.zeros(4, 40), torch.full((4,), PUSH), "39"),
        (torch.zeros(39, 4), torch.full((39,), PUSH), "39"),
        (torch.zeros(()), torch.tensor(PUSH), "39"),
        (torch.zeros(4, 39, dtype=torch.int64), torch.full((4,), PUSH), "int64"),
        (torch.zeros(4, 39, dtype=torch.bool), torch.full((4,), PUSH), "bool"),
        (torch.zeros(4, 39), torch.full((3,), PUSH), "task_id"),
        (torch.zeros(4, 39), torch.full((4, 1), PUSH), "task_id"),
        (torch.zeros(4, 39), torch.tensor(PUSH), "task_id"),
        (torch.zeros(39), torch.full((1,), PUSH), "task_id"),
        (torch.zeros(4, 39), torch.full((4,), float(PUSH)), "float32"),
        (torch.zeros(4, 39), torch.ones(4, dtype=torch.bool), "bool"),
        (torch.zeros(4, 39), torch.full((4,), 50), "50"),
        (torch.zeros(4, 39), torch.full((4,), -1), "-1"),
        (torch.zeros(4, 39), torch.full((4,), 10**12), "1000000000000"),
        (torch.zeros(4, 39), torch.full((4,), task_id("reach")), "reach"),
    ],
)  # fmt: skip
def test_a_wrong_state_or_task_is_named(states, ids, says):
    with pytest.raises(ValueError, match=says):
        QueryProgram({"push": ["gripper open"]})(states, ids)


@pytest.mark.parametrize("index", [0, 3, 17, 38])
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_nan_or_infinity_anywhere_in_one_row_is_refused(index, value):
    states = torch.zeros(5, 39)
    states[3, index] = value
    with pytest.raises(ValueError, match="NaN"):
        QueryProgram({"push": ["gripper open"]})(states, torch.full((5,), PUSH))


def test_one_row_of_a_task_without_queries_is_named_among_the_others():
    ids = torch.tensor([PUSH, PUSH, task_id("reach"), PUSH])
    with pytest.raises(ValueError, match=r"without queries.*: reach$") as caught:
        QueryProgram({"push": ["gripper open"]})(torch.zeros(4, 39), ids)
    assert "push" not in str(caught.value)


class Asked(torch.nn.Module):
    """A module, since that is what can be exported."""

    def __init__(self, program):
        super().__init__()
        self.program = program

    def forward(self, states, ids):
        return self.program(states, ids), self.program.logits(states, ids)


def agrees_with_eager(asked, program, states, ids):
    truth, logits = asked(states, ids)
    assert torch.equal(truth, program(states, ids))
    assert torch.equal(logits > 0, truth)
    torch.testing.assert_close(logits, program.logits(states, ids), atol=1e-4, rtol=1e-5)
    with pytest.raises(RuntimeError, match="tasks without queries"):
        asked(states, torch.full_like(ids, 50))
    with pytest.raises(RuntimeError, match="finite numbers"):
        asked(states / 0.0, ids)


def test_an_exported_program_answers_and_the_eager_one_still_does():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    exported = torch.export.export(Asked(program), (states, ids)).module()
    agrees_with_eager(exported, program, states, ids)
    fresh = QueryProgram(queries)
    assert torch.equal(fresh(states, ids), program(states, ids))


def test_a_compiled_program_answers_as_the_eager_one():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    agrees_with_eager(torch.compile(Asked(program), fullgraph=True, backend="aot_eager"), program, states, ids)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.filterwarnings("ignore:.*script_method. is deprecated:DeprecationWarning")
def test_inductor_answers_on_the_thresholds_too():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    states = states.clone()
    states[::3, 3] = 0.75
    states[::3, 4:7] = states[::3, 0:3]
    states[::3, 4] -= 0.04
    agrees_with_eager(torch.compile(Asked(program), fullgraph=True), program, states, ids)


def test_each_state_by_vmap_answers_as_the_batch():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    assert torch.equal(torch.vmap(program)(states[:50], ids[:50]), program(states[:50], ids[:50]))
    slopes = torch.func.grad(lambda given: program.logits(given, ids[:50]).sum())(states[:50])
    given = states[:50].clone().requires_grad_()
    program.logits(given, ids[:50]).sum().backward()
    assert torch.equal(slopes, given.grad)
