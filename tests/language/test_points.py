"""Points of ours: places beside an object or fixed ones, which queries may name and the published list leaves out."""

import language_world as oracle
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from states import random_states, relation_holds

from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id

metres = st.floats(-0.2, 0.2)


def with_points(name, offset=(0.03, -0.1, 0.02)):
    """The published task and two points of ours: one beside its last object, one at a fixed place."""
    task = TASKS[name].published
    beside = NamedObject("place beside it", task.objects[-1].position, offset, ours=True)
    fixed = NamedObject("fixed place", (0.1, 0.7, 0.15), ours=True)
    return Task(name, task.description, (*task.objects, beside, fixed))


def states_of(name, n=100):
    return torch.from_numpy(random_states(name, seed=21, n=n)).double(), torch.full((n,), task_id(name))


@pytest.mark.parametrize("name", MT50)
def test_published_only_leaves_them_out_and_the_rest_stays_as_it_is(name):
    task, published = with_points(name), supported_queries(TASKS[name], published_only=True)
    assert supported_queries(task, published_only=True) == published
    assert supported_queries(task.published) == published
    assert len(published) == len(oracle.enumerate_base_queries(name))
    everything = supported_queries(task)
    assert set(published) < set(everything)
    assert [text for text in everything if "place" not in text] == list(published)
    for text in ("the robot's gripper is near the fixed place", "the fixed place is not above the place beside it"):
        assert text in everything
    assert "the fixed place is touching the table" not in everything
    assert all(str(parse_query(text, task)) == text for text in everything)


def test_the_truth_of_published_queries_does_not_change():
    changed = []
    for name in MT50:
        states, ids = states_of(name)
        published = list(supported_queries(name, published_only=True))
        alone = QueryProgram({TASKS[name].published: published})(states, ids)
        beside = QueryProgram({with_points(name): [*published, "gripper near fixed place"]})(states, ids)
        shipped = QueryProgram({name: published})(states, ids)
        if not (torch.equal(alone, beside[:, :-1]) and torch.equal(alone, shipped)):
            changed.append(name)
    assert not changed


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(MT50), st.tuples(metres, metres, metres), st.sampled_from(sorted(RELATIONS)))
def test_a_point_is_where_positions_say(name, offset, relation):
    task = with_points(name, offset)
    states, ids = states_of(name)
    at = task.positions(states)
    based = at[task.objects[-3].name] + torch.tensor(offset, dtype=torch.float64)
    torch.testing.assert_close(at["place beside it"], based, rtol=0, atol=0)
    assert at["fixed place"].tolist() == [[0.1, 0.7, 0.15]] * 100
    pairs = [(GRIPPER, "place beside it"), ("place beside it", GRIPPER), ("fixed place", "place beside it")]
    answer = QueryProgram({task: [f"the {a} is {relation} the {b}" for a, b in pairs]})(states, ids)
    for (first, second), found in zip(pairs, answer.unbind(1), strict=True):
        # Within rounding of a threshold either answer is right.
        expected = relation_holds(relation, at[first], at[second])
        moved = [relation_holds(relation, at[first] + x, at[second]) for x in (-1e-9, 1e-9)]
        sure = (moved[0] == expected) & (moved[1] == expected)
        assert torch.equal(found[sure], expected[sure])


def test_touching_the_table_counts_the_offset():
    low = NamedObject("low place", (4, 5, 6), (0.0, 0.0, -0.05), ours=True)
    task = Task("push", "Push it.", (*TASKS["push"].published.objects, low))
    state = torch.zeros(39)
    state[6] = 0.06
    answer = QueryProgram({task: ["puck touching the table", "low place touching the table"]})
    assert answer(state, torch.tensor(task_id("push"))).tolist() == [False, True]
