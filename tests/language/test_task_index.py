"""TaskIndex and TaskTables: the row of each task, and errors for wrong ids; also compiled, exported and in vmap."""

from typing import NamedTuple

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

import lw_torchrl as lw
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import task_ids

NAMES = st.sampled_from([*lw.MT50, "stack-blocks", "wipe", "pour-tea", "x"])


@settings(deadline=None)
@given(tasks=st.lists(NAMES, min_size=1, unique=True), shape=st.lists(st.integers(0, 4), max_size=3), data=st.data())
def test_rows_are_in_the_order_of_the_ids_for_any_shape(tasks, shape, data):
    index = TaskIndex(task_ids(tasks))
    ids = [lw.task_id(task) for task in index.tasks]
    assert ids == sorted(ids)
    assert sorted(index.tasks) == sorted(tasks)
    seed = data.draw(st.integers(0, 2**31))
    rows = torch.randint(len(tasks), shape, generator=torch.Generator().manual_seed(seed))
    given_ids = torch.tensor(ids)[rows]
    assert torch.equal(index.rows(given_ids, "wrong"), rows)
    assert torch.equal(index.rows(given_ids.int(), "wrong"), rows)
    assert [index.row(task) for task in index.tasks] == list(range(len(tasks)))


@pytest.mark.parametrize("wrong", [-1, 0, 50, 2**31, 2**63 - 1, -(2**63), lw.task_id("wipe")])
def test_an_id_without_a_row_is_named(wrong):
    index = TaskIndex(task_ids(["push", "reach", "stack-blocks"]))
    with pytest.raises(ValueError, match=r"task_id contains tasks without a plan: ") as caught:
        index.rows(torch.tensor([[lw.task_id("push"), wrong]]), "tasks without a plan")
    named = "assembly" if wrong == 0 else f"{wrong} (not a Meta-World task)"
    assert str(caught.value).endswith(f": {named}")


def test_two_names_with_the_same_id_and_float_ids_are_refused():
    with pytest.raises(ValueError, match="'wipe' and 'pour'"):
        TaskIndex({"wipe": 60, "pour": 60})
    with pytest.raises(ValueError, match="task_id"):
        TaskIndex(task_ids(["push"])).rows(torch.zeros(2), "wrong")


class Numbers(NamedTuple):
    whole: Tensor
    real: Tensor


class Reader(nn.Module):
    def __init__(self):
        super().__init__()
        numbers = Numbers(torch.tensor([[1], [2]]), torch.tensor([[0.1], [0.2]]))
        self.tables = TaskTables(TaskIndex(task_ids(["push", "reach"])), numbers, "tasks without numbers")

    def forward(self, observation, task_id):
        selected = self.tables.select(task_id, observation)
        return selected.whole + selected.real


IDS = torch.tensor([lw.task_id("reach"), lw.task_id("push"), lw.task_id("reach")])
STATES = torch.zeros(3, 39)
EXPECTED = torch.tensor([[2.2], [1.1], [2.2]])


def test_kept_rows_are_for_this_batch_dtype_and_mode():
    reader = Reader()
    for _ in range(2):
        assert torch.equal(reader(STATES, IDS), EXPECTED)
        assert torch.equal(reader(STATES, IDS.flip(0)[:2]), EXPECTED.flip(0)[:2])
        assert reader(STATES.double(), IDS).dtype == torch.float64
        with torch.inference_mode():
            reader(STATES, IDS)
        selected = reader.tables.select(IDS, STATES)
        weight = torch.ones(3, 1, requires_grad=True)
        (weight * selected.real).sum().backward()  # refused of a table made in inference mode
    ids = IDS.clone()
    reader(STATES, ids)
    ids[0] = lw.task_id("push")  # the caller's tensor, changed in place
    assert reader(STATES, ids)[0].item() == pytest.approx(1.1)


@pytest.mark.parametrize("how", ["compiled", "exported"])
def test_a_compiled_reader_refuses_an_unknown_id(how):
    reader = Reader()
    if how == "compiled":
        faster = torch.compile(reader, fullgraph=True, backend="aot_eager")
    else:
        faster = torch.export.export(reader, (STATES, IDS)).module()
    assert torch.equal(faster(STATES, IDS), EXPECTED)
    assert torch.equal(reader(STATES, IDS), EXPECTED)
    wrong = IDS.clone()
    wrong[1] = lw.task_id("wipe")
    with pytest.raises(RuntimeError, match="tasks without numbers"):
        faster(STATES, wrong)


def test_in_vmap_an_unknown_id_has_no_row():
    reader = Reader()
    each = torch.vmap(lambda state, task: reader(state.unsqueeze(0), task.unsqueeze(0))[0])
    assert torch.equal(each(STATES, IDS), EXPECTED)
    assert torch.equal(reader(STATES, IDS), EXPECTED)
    with pytest.raises((IndexError, RuntimeError), match="out of"):
        each(STATES, IDS + 1)


def test_in_compiled_vmap_nothing_is_asserted():
    # PyTorch has no such assertion; compiled losses of critics are an example.
    index = TaskIndex(task_ids(["push", "reach"]))
    rows = torch.compile(torch.vmap(lambda ids: index.rows(ids, "wrong")), fullgraph=True, backend="eager")
    assert torch.equal(rows(IDS.unsqueeze(-1)), torch.tensor([[1], [0], [1]]))
    assert torch.equal(rows(IDS.unsqueeze(-1) + 1), torch.full((3, 1), 2)), "a row beyond the last"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_tables_follow_the_ids_to_their_device():
    reader = Reader()
    assert torch.equal(reader(STATES.cuda(), IDS.cuda()).cpu(), EXPECTED)
    assert torch.equal(reader(STATES, IDS), EXPECTED)
