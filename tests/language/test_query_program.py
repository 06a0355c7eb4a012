"""QueryProgram: batches of mixed tasks; the kernel gives the bits of the tables; exported, compiled and in vmap."""

import copy
import math
import pickle
import random
import shutil
import sys

import pytest
import torch
from conditions import interpret, query_of, tower, trees
from hypothesis import given, settings
from hypothesis import strategies as st
from speed import within
from states import all_tasks, random_states
from tensordict import TensorDict

from lw_torchrl.language import query_program
from lw_torchrl.language.expressions import FALSE, TRUE, negate
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import Query, supported_queries
from lw_torchrl.language.query_program import QueryProgram, find_kernel
from lw_torchrl.language.query_tables import MOST_FACTS, compile_queries
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id


@pytest.fixture
def batch():
    """A program of all tasks, states and task ids."""
    queries, states, ids = all_tasks()
    return QueryProgram(queries), states, ids


def test_a_mixed_batch_equals_each_task_alone_and_padding_is_false(batch):
    program, states, ids = batch
    queries, answer = program.queries, program(states, ids)
    longest = max(map(len, queries.values()))
    assert program.num_queries == longest
    assert program.tasks == MT50
    assert answer.shape == (600, longest)
    for task in MT50:
        rows = ids == task_id(task)
        width = len(queries[task])
        assert torch.equal(answer[rows, :width], QueryProgram({task: queries[task]})(states[rows], ids[rows]))
        assert not answer[rows, width:].any()
    for row in range(50):
        assert torch.equal(program(states[row], ids[row]), answer[row])


@pytest.mark.parametrize("shape", [(), (600,), (2, 3, 100), (4, 0)])
def test_any_leading_shape(batch, shape):
    program, states, ids = batch
    n = math.prod(shape)
    answer = program(states[:n].reshape(*shape, 39), ids[:n].reshape(shape))
    assert answer.dtype == torch.bool
    assert torch.equal(answer, program(states[:n], ids[:n]).reshape(*shape, program.num_queries))


def test_input_of_any_memory_layout_and_precision(batch):
    program, states, ids = batch
    expected = program(states, ids)
    across = states.reshape(20, 30, 39).transpose(0, 1)
    answer = program(across, ids.reshape(20, 30).transpose(0, 1))
    assert torch.equal(answer, expected.reshape(20, 30, -1).transpose(0, 1))
    assert torch.equal(program(torch._neg_view(-states), ids), expected)
    program(states.double(), ids)
    assert torch.equal(program(states, ids.int()), expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_it_answers_on_the_device_of_the_observation(batch):
    program, states, ids = batch
    answer = program(states.cuda(), ids.cuda())
    assert answer.is_cuda
    assert torch.equal(answer.cpu(), program(states, ids))


@pytest.mark.parametrize(
    ("queries", "error", "message"),
    [
        ({"push": ["gripper open"], "reach": ()}, ValueError, "reach"),
        ({"push": "gripper open"}, ValueError, "queries"),
        ({"psuh": ["gripper open"]}, ValueError, "'push'"),
        ({"push": ["gripper near drawer handle"]}, ValueError, "nearest query"),
        ({"push": [3]}, TypeError, "queries"),
        ({3: ["gripper open"]}, ValueError, "queries"),
        ({"push": ["gripper open"], TASKS["push"]: ["gripper closed"]}, ValueError, "push"),
    ],
)
def test_faulty_queries_are_refused(queries, error, message):
    with pytest.raises(error, match=message):
        QueryProgram(queries)


PUSH = task_id("push")


@pytest.mark.parametrize(
    ("states", "ids", "message"),
    [
        (torch.zeros(4, 38), torch.full((4,), PUSH), "39"),
        (torch.zeros(()), torch.tensor(PUSH), "39"),
        (torch.zeros(4, 39, dtype=torch.int64), torch.full((4,), PUSH), "int64"),
        (torch.zeros(4, 39), torch.full((3,), PUSH), "task_id"),
        (torch.zeros(4, 39), torch.full((4, 1), PUSH), "task_id"),
        (torch.zeros(4, 39), torch.full((4,), float(PUSH)), "float32"),
        (torch.zeros(4, 39), torch.full((4,), 50), "50"),
        (torch.zeros(4, 39), torch.full((4,), -1), "-1"),
        (torch.zeros(4, 39), torch.full((4,), 10**12), "1000000000000"),
        (torch.zeros(4, 39), torch.tensor([PUSH, PUSH, task_id("reach"), PUSH]), "without queries.*: reach$"),
    ],
)  # fmt: skip
def test_a_wrong_batch_is_refused(states, ids, message):
    with pytest.raises(ValueError, match=message):
        QueryProgram({"push": ["gripper open"]})(states, ids)


def test_nan_or_infinity_anywhere_in_one_row_is_refused():
    for index in (0, 3, 17, 38):
        for value in (torch.nan, torch.inf, -torch.inf):
            states = torch.zeros(5, 39)
            states[3, index] = value
            with pytest.raises(ValueError, match="NaN"):
                QueryProgram({"push": ["gripper open"]})(states, torch.full((5,), PUSH))


# ---- the kernel


def both(program, states, ids):
    """Return the answers of the kernel and of the tables."""
    assert program._kernel(states, ids) is not None
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(query_program, "find_kernel", lambda: None)
        by_tables = program(states, ids)
    return program(states, ids), by_tables


def on_thresholds(states):
    """Return states of which some lie exactly on a threshold, and some are far away."""
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
def test_the_kernel_gives_the_bits_of_the_tables(data):
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


def test_the_kernel_gives_the_bits_of_the_tables_in_all_tasks(batch):
    program, states, ids = batch
    for given_states in (states, on_thresholds(states), states.double()):
        compiled, by_tables = both(program, given_states, ids)
        assert torch.equal(compiled, by_tables)
        assert 0 < compiled.sum() < compiled.numel()


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_expressions_are_interpreted_in_all_ways(data):
    """The kernel, the tables and both kinds of logits at their extremes agree with direct interpretation."""
    queries, expected, states = {}, [], []
    for task in data.draw(st.lists(st.sampled_from(MT50), min_size=1, max_size=3, unique=True)):
        leaves = data.draw(st.lists(st.sampled_from(supported_queries(task)), min_size=1, max_size=6, unique=True))
        conditions = data.draw(st.lists(trees(st.sampled_from(leaves), 20), min_size=1, max_size=4))
        states.append(torch.from_numpy(random_states(task, seed=3, n=30)))
        truth = QueryProgram({task: leaves})(states[-1], torch.full((30,), task_id(task)))
        columns = dict(zip(leaves, truth.unbind(1), strict=True))
        expected.append([interpret(tree, columns.__getitem__) for tree in conditions])
        queries[task] = [query_of(tree, task) for tree in conditions]
    program = QueryProgram(queries)
    states, ids = torch.cat(states), torch.tensor([task_id(task) for task in queries]).repeat_interleave(30)
    steps = program.num_queries
    padding = [torch.zeros(30, dtype=torch.bool)] * steps
    answers = torch.cat([torch.stack([*columns, *padding][:steps], 1) for columns in expected])
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(query_program, "find_kernel", lambda: None)
        assert torch.equal(program(states, ids), answers)
    assert torch.equal(program(states, ids), answers)
    for truth in ("min-max", "product"):
        logits = program.logits(states, ids, temperature=1e-6, truth=truth)
        assert torch.equal(logits > 0, answers) or truth == "product"
        clear = logits.abs() > 1.0  # a leaf may be exactly on its threshold
        assert torch.equal((logits > 0)[clear], answers[clear])


def test_shared_parts_are_one_gate():
    with within(8):  # without sharing, 2^30 gates
        tip = tower("stick-pull")
        tables, shapes = compile_queries({TASKS["stick-pull"]: [Query(tip), Query(negate(tip))]})
        assert sum(gates for *_, gates in shapes) <= 30 * 65 + 2
        assert tables.inputs.shape[1] < 500_000


def test_the_logits_of_a_disjunction_and_a_negation():
    texts = ["gripper open", "gripper near puck", "gripper open or near puck", "not (gripper open or near puck)"]
    program, ids = QueryProgram({"push": texts}), torch.full((50,), task_id("push"))
    states = torch.from_numpy(random_states("push", n=50)).requires_grad_()
    opened, near, either, neither = program.logits(states, ids).unbind(1)
    assert torch.equal(either, torch.maximum(opened, near))
    assert torch.equal(neither, -either)
    opened, near, either, neither = program.logits(states, ids, truth="product", temperature=10.0).double().unbind(1)
    expected = 1 - (1 - opened.sigmoid()) * (1 - near.sigmoid())
    torch.testing.assert_close(either.sigmoid(), expected)
    torch.testing.assert_close(neither.sigmoid(), 1 - expected)
    (gradient,) = torch.autograd.grad(either.sum(), states)
    assert gradient.isfinite().all()
    assert (gradient[:, [0, 3]] != 0).any(0).all(), "both operands have a gradient"
    with pytest.raises(ValueError, match="min-max"):
        program.logits(states, ids, truth="sum")


def test_constant_conditions():
    impossible = "the gripper is near the puck and the gripper is not near the puck"
    program = QueryProgram({"push": ["always", "never", impossible], "reach": ["always"]})
    states, ids = torch.zeros(2, 39), torch.tensor([PUSH, task_id("reach")])
    for answer in both(program, states, ids):
        assert answer.tolist() == [[True, False, False]] * 2
    assert program.logits(states, ids)[:, :2].tolist() == [[1e4, -1e4]] * 2
    for constant in (TRUE, FALSE):  # also if no condition needs a fact
        assert QueryProgram({"push": [Query(constant)]})(states[:1], ids[:1]).tolist() == [[constant == TRUE]]


def test_fixed_coordinates_are_not_indices():
    objects = (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("puck", (4, 5, 6)), NamedObject("wall", (0.0, 1, 2)))
    program = QueryProgram({Task("slide", "", objects): ["gripper near puck", "wall near puck", "gripper near wall"]})
    states = torch.zeros(2, 39)
    states[0, [0, 4]] = 0.5
    for answer in both(program, states, torch.full((2,), task_id("slide"))):
        assert answer.tolist() == [[True, False, False], [True] * 3]


def test_the_tables_answer_more_facts_than_the_kernel_has_bits():
    queries = list(supported_queries("push"))
    program = QueryProgram({"push": queries, "reach": ["gripper open"]})
    assert len(queries) > MOST_FACTS
    states = torch.from_numpy(random_states("push", n=50))
    ids = torch.full((50,), task_id("push"))
    assert program._kernel(states, ids) is None
    few = random.Random(0).sample(range(len(queries)), 8)
    alone = QueryProgram({"push": [queries[i] for i in few]})
    assert torch.equal(program(states, ids)[:, few], alone(states, ids))


def test_without_numba_the_tables_answer(monkeypatch, batch):
    program, states, ids = batch
    expected = program(states, ids)
    monkeypatch.setitem(sys.modules, "numba", None)
    monkeypatch.delitem(sys.modules, "lw_torchrl.language.query_kernel", raising=False)
    find_kernel.cache_clear()
    try:
        assert find_kernel() is None
        assert torch.equal(program(states, ids), expected)
    finally:
        find_kernel.cache_clear()


def test_the_tables_are_buffers_that_are_not_saved():
    program = QueryProgram({"push": ["gripper open"]})
    assert isinstance(program, torch.nn.Module)
    assert {buffer.dtype for buffer in program.buffers()} >= {torch.float64, torch.int64, torch.bool}
    assert not program.state_dict()
    assert {buffer.device.type for buffer in program.to("meta").buffers()} == {"meta"}


def test_a_cast_of_the_module_keeps_its_precision(monkeypatch, batch):
    monkeypatch.setattr(query_program, "find_kernel", lambda: None)
    program, states, ids = batch
    expected = program(on_thresholds(states), ids)
    for cast in (torch.nn.Module.half, torch.nn.Module.bfloat16, torch.nn.Module.float):
        assert torch.equal(cast(program)(on_thresholds(states), ids), expected)


def test_a_copy_gives_the_same_answers(batch):
    program, states, ids = batch
    with torch.inference_mode():
        expected = program(states, ids)
    for again in (copy.deepcopy(program), pickle.loads(pickle.dumps(program))):
        assert torch.equal(again(states, ids), expected)


# ---- compiled


class Both(torch.nn.Module):
    """Truth and logits in a module, which can be exported."""

    def __init__(self, program):
        super().__init__()
        self.program = program

    def forward(self, states, ids):
        return self.program(states, ids), self.program.logits(states, ids)


def agrees_with_eager(compiled, program, states, ids):
    truth, logits = compiled(states, ids)
    assert torch.equal(truth, program(states, ids))
    assert torch.equal(logits > 0, truth)
    torch.testing.assert_close(logits, program.logits(states, ids), atol=1e-4, rtol=1e-5)
    with pytest.raises(RuntimeError, match="tasks without queries"):
        compiled(states, torch.full_like(ids, 50))
    with pytest.raises(RuntimeError, match="finite numbers"):
        compiled(states / 0.0, ids)


def test_an_exported_program_agrees_with_the_eager_one(batch):
    program, states, ids = batch
    exported = torch.export.export(Both(program), (states, ids)).module()
    agrees_with_eager(exported, program, states, ids)
    assert torch.equal(QueryProgram(program.queries)(states, ids), program(states, ids))


def test_a_compiled_program_agrees_with_the_eager_one(batch):
    program, states, ids = batch
    agrees_with_eager(torch.compile(Both(program), fullgraph=True, backend="aot_eager"), program, states, ids)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.filterwarnings("ignore:.*script_method. is deprecated:DeprecationWarning")
def test_inductor_agrees_on_the_thresholds(batch):
    program, states, ids = batch
    states = states.clone()
    states[::3, 3] = 0.75
    states[::3, 4:7] = states[::3, 0:3]
    states[::3, 4] -= 0.04
    agrees_with_eager(torch.compile(Both(program), fullgraph=True), program, states, ids)


def test_an_ensemble_may_have_its_own_tables_for_each_member():
    program = QueryProgram({"push": ["gripper near puck", "gripper open"]})
    states, ids = torch.from_numpy(random_states("push", n=20)), torch.full((20,), PUSH)
    members = TensorDict.from_modules(program, QueryProgram(program.queries), as_module=True)
    for answer in (program.forward, program.logits):

        def ask(member, answer=answer):
            with member.to_module(program):
                return answer(states, ids)

        assert torch.equal(torch.vmap(ask)(members), answer(states, ids).expand(2, 20, 2))


def test_vmap_agrees_with_the_batch(batch):
    program, states, ids = batch
    assert torch.equal(torch.vmap(program)(states[:50], ids[:50]), program(states[:50], ids[:50]))
    slopes = torch.func.grad(lambda given: program.logits(given, ids[:50]).sum())(states[:50])
    given = states[:50].clone().requires_grad_()
    program.logits(given, ids[:50]).sum().backward()
    assert torch.equal(slopes, given.grad)
