"""QueryProgram's compiled pass gives the bits of its tables; as a module it moves, copies and keeps its precision."""

import copy
import pickle
import random
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from states import all_tasks, random_states

from lw_torchrl.language import query_program
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import supported_queries
from lw_torchrl.language.query_program import QueryProgram, find_kernel
from lw_torchrl.language.query_tables import MOST_FACTS
from lw_torchrl.language.tasks import MT50, Task, task_id


@pytest.fixture
def without_numba(monkeypatch):
    monkeypatch.setattr(query_program, "find_kernel", lambda: None)


def both(program, states, ids):
    """The answers of the compiled pass, and of the tables."""
    assert program._kernel(states, ids) is not None
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(query_program, "find_kernel", lambda: None)
        by_tables = program(states, ids)
    return program(states, ids), by_tables


def on_thresholds(states):
    """States some of which lie exactly on a threshold, and some far away."""
    states = states.clone()
    states[::7, 3] = 0.75
    states[::5, 4:7] = states[::5, 0:3]
    states[::5, 4] -= 0.04
    states[::11, 6] = 0.02
    states[::13] *= 1e18
    states[1::13] *= 1e-30
    return states


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_the_compiled_pass_gives_the_bits_of_the_tables(data):
    names = data.draw(st.lists(st.sampled_from(MT50), min_size=1, max_size=4, unique=True))
    queries = {}
    for name in names:
        query = st.lists(st.sampled_from(supported_queries(name)), min_size=1, max_size=3).map(" and ".join)
        queries[name] = data.draw(st.lists(query, min_size=1, max_size=5))
    program = QueryProgram(queries)
    n = 40
    states = on_thresholds(torch.cat([torch.from_numpy(random_states(name, seed=9, n=n)) for name in names]))
    ids = torch.tensor([task_id(name) for name in names]).repeat_interleave(n)
    dtype = data.draw(st.sampled_from([torch.float32, torch.float64]))
    compiled, by_tables = both(program, states.to(dtype), ids)
    assert torch.equal(compiled, by_tables)


def test_on_all_tasks_and_lists_of_different_lengths():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    for given_states in (states, on_thresholds(states), states.double()):
        compiled, by_tables = both(program, given_states, ids)
        assert torch.equal(compiled, by_tables)
        assert 0 < compiled.sum() < compiled.numel()


@pytest.mark.parametrize("compiled", [True, False])
def test_a_place_in_metres_is_no_place_in_the_observation(compiled, monkeypatch):
    if not compiled:
        monkeypatch.setattr(query_program, "find_kernel", lambda: None)
    objects = (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("puck", (4, 5, 6)), NamedObject("wall", (0.0, 1, 2)))
    program = QueryProgram({Task("slide", "", objects): ["gripper near puck", "wall near puck", "gripper near wall"]})
    states = torch.zeros(2, 39)
    states[0, [0, 4]] = 0.5
    assert program(states, torch.full((2,), task_id("slide"))).tolist() == [[True, False, False], [True] * 3]


def test_a_view_whose_sign_is_noted_and_not_yet_changed():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    assert torch.equal(program(torch._neg_view(-states), ids), program(states, ids))


def test_what_contradicts_itself_never_holds():
    program = QueryProgram({"push": ["the gripper is near the puck and the gripper is not near the puck"]})
    states = torch.from_numpy(random_states("push"))
    compiled, by_tables = both(program, states, torch.full((len(states),), task_id("push")))
    assert not compiled.any()
    assert not by_tables.any()


def test_more_facts_than_bits_are_left_to_the_tables():
    queries = list(supported_queries("push"))
    program = QueryProgram({"push": queries, "reach": ["gripper open"]})
    assert len(queries) > MOST_FACTS
    states = torch.from_numpy(random_states("push", n=50))
    ids = torch.full((50,), task_id("push"))
    assert program._kernel(states, ids) is None
    few = random.Random(0).sample(range(len(queries)), 8)
    alone = QueryProgram({"push": [queries[i] for i in few]})
    assert torch.equal(program(states, ids)[:, few], alone(states, ids))


def test_without_numba_the_tables_answer(monkeypatch):
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    expected = program(states, ids)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "lw_torchrl.language.query_kernel", raising=False)
    find_kernel.cache_clear()
    try:
        assert find_kernel() is None
        assert torch.equal(program(states, ids), expected)
    finally:
        find_kernel.cache_clear()


def test_gradients_still_come_from_the_logits():
    queries, states, ids = all_tasks()
    states = states.clone().requires_grad_()
    assert not QueryProgram(queries)(states, ids).requires_grad
    QueryProgram(queries).logits(states, ids).sum().backward()
    assert states.grad.abs().sum() > 0


def test_its_tables_are_buffers_that_are_not_saved():
    program = QueryProgram({"push": ["gripper open"]})
    assert isinstance(program, torch.nn.Module)
    assert {buffer.dtype for buffer in program.buffers()} >= {torch.float64, torch.int64, torch.bool}
    assert not program.state_dict()
    assert {buffer.device.type for buffer in program.to("meta").buffers()} == {"meta"}


@pytest.mark.usefixtures("without_numba")
def test_a_cast_of_the_module_leaves_its_metres_exact():
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    expected = program(on_thresholds(states), ids)
    for cast in (torch.nn.Module.half, torch.nn.Module.bfloat16, torch.nn.Module.float):
        assert torch.equal(cast(program)(on_thresholds(states), ids), expected)


@pytest.mark.parametrize("again", [copy.deepcopy, lambda program: pickle.loads(pickle.dumps(program))])
def test_a_copy_answers_too(again):
    queries, states, ids = all_tasks()
    program = QueryProgram(queries)
    with torch.inference_mode():
        expected = program(states, ids)
    assert torch.equal(again(program)(states, ids), expected)
