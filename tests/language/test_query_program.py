"""QueryProgram: batches of mixed tasks, spellings of queries, and what is wrong with either."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from states import all_tasks, observation, random_states

from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import Clause, Query, parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id


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


def test_float32_and_float64_may_alternate():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    first = program(states, ids)
    program(states.double(), ids)
    assert torch.equal(program(states, ids), first)


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
