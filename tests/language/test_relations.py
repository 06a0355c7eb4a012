"""The meaning of relations: the 13 published formulas, custom relations, and points that we named."""

import math
import re
from pathlib import Path

import language_world as oracle
import numpy as np
import pytest
import torch
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from states import comparison_holds, observation, random_states, relation_holds

from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.plans import ConditionalPlan
from lw_torchrl.language.queries import QueryError, parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.relations import PREDICATES, PUBLISHED, RELATIONS, STATES, TOUCHING, UNARY, Comparison
from lw_torchrl.language.tasks import MT50, TASKS, Task, task_id

# Every relation as (value, sense, threshold) on d = first - second in metres, from the published semantics.
FORMULAS = {
    "near": lambda x, y, z: [(math.hypot(x, y, z), "<", 0.04)],
    "around": lambda x, y, z: [(math.hypot(x, y, z + 0.02), "<", 0.03)],
    "left of": lambda x, y, z: [(x, ">", 0.04)],
    "right of": lambda x, y, z: [(x, "<", -0.04)],
    "behind": lambda x, y, z: [(y, ">", 0.04), (math.hypot(x, z), "<", 0.04)],
    "in front of": lambda x, y, z: [(y, "<", -0.04), (math.hypot(x, z), "<", 0.04)],
    "above": lambda x, y, z: [(math.hypot(x, y), "<", 0.02), (z, ">", 0.0)],
    "below": lambda x, y, z: [(math.hypot(x, y), "<", 0.02), (z, "<", 0.0)],
    "vertically aligned with": lambda x, y, z: [(math.hypot(x, y), "<", 0.06)],
    "almost vertically aligned with": lambda x, y, z: [(math.hypot(x, y), "<", 0.12)],
    "mostly below": lambda x, y, z: [(z, "<", 0.23)],
    "horizontally aligned with": lambda x, y, z: [(math.hypot(y, z), "<", 0.03)],
    "forward aligned with": lambda x, y, z: [(math.hypot(x, z), "<", 0.03)],
}

relations = st.sampled_from(sorted(RELATIONS))
offsets = st.floats(-0.1, 0.1) | st.floats(-0.4, 0.4)
displacements = st.tuples(offsets, offsets, offsets)
positions = st.tuples(*(st.floats(-1, 1),) * 3)


def holds(relation, first, second, dtype=torch.float64):
    return relation_holds(relation, torch.tensor(first, dtype=dtype), torch.tensor(second, dtype=dtype)).item()


def moved(position, displacement):
    return tuple(p + d for p, d in zip(position, displacement, strict=True))


def test_the_relations_are_the_thirteen_published_ones():
    assert set(RELATIONS) == set(FORMULAS)
    assert set(UNARY) == {TOUCHING, "open", "closed", "wide open"}
    assert set(PREDICATES) == set(RELATIONS) | set(UNARY)


@settings(deadline=None)
@given(relation=relations, second=positions, displacement=displacements)
def test_a_relation_is_its_formula(relation, second, displacement):
    first = moved(second, displacement)
    parts = FORMULAS[relation](*(a - b for a, b in zip(first, second, strict=True)))
    # Within rounding of a threshold either answer is right.
    assume(all(abs(value - threshold) > 1e-9 for value, _, threshold in parts))
    expected = all(value < threshold if sense == "<" else value > threshold for value, sense, threshold in parts)
    assert holds(relation, first, second) is expected


@pytest.mark.parametrize("pair", [("left of", "right of"), ("behind", "in front of"), ("above", "below")])
@settings(deadline=None)
@given(second=positions, displacement=displacements, dtype=st.sampled_from([torch.float32, torch.float64]))
def test_opposites_swap_and_are_never_both_true(pair, second, displacement, dtype):
    first = moved(second, displacement)
    for one, other in (pair, pair[::-1]):
        forth = holds(one, first, second, dtype)
        assert forth == holds(other, second, first, dtype)
        assert not (forth and holds(one, second, first, dtype))
        assert not (forth and holds(other, first, second, dtype))


def written(part, opening):
    """A comparison as docs/reference.md writes it."""
    value = f"‖{part.axes}‖" if part.length else "opening" if opening else part.axes
    raised = f", z raised by {part.raise_z:g}" if part.raise_z else ""
    return f"{value} {part.sense} {part.threshold:g}{raised}"


def test_the_page_on_queries_has_every_threshold():
    page = (Path(__file__).parents[2] / "docs" / "reference.md").read_text("utf-8")
    table = page[page.index("| predicate | holds where |") :].split("\n\n")[0]
    rows = dict(re.findall(r"^\| ([a-z ]+) \| ([^|]+) \|$", table, re.MULTILINE))
    for name, parts in PREDICATES.items():
        assert rows.pop(name) == " and ".join(written(part, name in STATES) for part in parts)
    assert rows == {"predicate": "holds where"}  # the heading


def test_x_points_to_the_robots_right_y_away_from_it_and_z_up(metaworld_env):
    env = metaworld_env("reach")
    env.seed(0)
    env.reset()
    base, hand = env.data.body("base").xpos, env.data.body("hand").xpos
    forward = (hand - base) * [1, 1, 0]
    np.testing.assert_allclose(forward / np.linalg.norm(forward), [0, 1, 0], atol=0.05)
    up = -env.model.opt.gravity / np.linalg.norm(env.model.opt.gravity)
    np.testing.assert_array_equal(up, [0, 0, 1])
    right = np.cross(forward / np.linalg.norm(forward), up)
    np.testing.assert_allclose(right, [1, 0, 0], atol=0.05)
    # Left and right are those of someone who faces the robot.
    assert holds("left of", tuple(0.1 * right), (0.0, 0.0, 0.0))
    assert holds("behind", (0.0, 0.1, 0.0), (0.0, 0.0, 0.0))


OWN = {
    "beside": (
        Comparison("xy", "<", 0.1),
        Comparison("z", "<", 0.02, length=False),
        Comparison("z", ">", -0.02, length=False),
    ),
    "far from": (Comparison("xyz", ">", 0.2),),
    "level with": (Comparison("z", "<=", 0.0, length=False), Comparison("yz", "<=", 0.05, raise_z=0.01)),
    "somewhere over": (*(Comparison(axis, ">", -0.05, length=False) for axis in "xyz"), Comparison("xy", ">", 0.05)),
}


@pytest.mark.parametrize("name", OWN)
def test_a_custom_relation_is_compiled_with_all_its_comparisons(monkeypatch, name):
    monkeypatch.setitem(RELATIONS, name, OWN[name])
    first = torch.randn(400, 3, generator=torch.Generator().manual_seed(0)) * 0.1
    states = torch.zeros(400, 39)
    states[:, 0:3] = first
    program = QueryProgram({"push": [f"gripper {name} puck", f"gripper not {name} puck and open", "gripper near puck"]})
    ids = torch.full((400,), task_id("push"))
    expected = relation_holds(name, first, torch.zeros(3))
    assert 10 < expected.sum() < 390
    for part in OWN[name]:  # each counts
        others = [comparison_holds(p, first) for p in OWN[name] if p is not part]
        assert len(OWN[name]) == 1 or not torch.equal(torch.stack(others).all(0), expected)
    assert torch.equal(program(states, ids)[:, 0], expected)
    assert torch.equal(program(states, ids)[:, 2], relation_holds("near", first, torch.zeros(3)))
    assert torch.equal(program.logits(states, ids) > 0, program(states, ids))


def test_a_custom_relation_is_listed_parsed_and_matched_until_it_is_removed(monkeypatch):
    before, published = supported_queries("push"), supported_queries("push", published_only=True)
    text = "the robot's gripper is beside the puck"
    with pytest.raises(QueryError):
        parse_query(text, "push")
    assert "beside" not in str(nearest_query("gripper besides puck", "push").query)
    with monkeypatch.context() as patched:
        patched.setitem(RELATIONS, "beside", OWN["beside"])
        assert text in supported_queries("push")
        assert supported_queries("push", published_only=True) == published
        assert str(nearest_query("gripper besides puck", "push").query) == text
        plan = ConditionalPlan.from_pairs("push", [("gripper beside puck", "wait")])
        assert str(plan.steps[0].condition) == text
        with pytest.raises(QueryError, match="'beside'"):
            parse_query("gripper besides puck", "push")
    assert supported_queries("push") == before
    assert tuple(RELATIONS) == PUBLISHED


@pytest.mark.parametrize(
    ("name", "parts", "message"),
    [
        ("Beside", OWN["beside"], "lower-case words"),
        (3, OWN["beside"], "lower-case words"),
        ("open", OWN["beside"], "reserved in queries"),
        ("not near", OWN["beside"], "reserved in queries"),
        ("near or at", OWN["beside"], "reserved in queries"),
        ("near and dear to", OWN["beside"], "'and'"),
        ("beside", (), "at least one"),
        ("beside", OWN["beside"][0], "at least one Comparison"),
        ("beside", ("xy < 0.1",), "at least one Comparison"),
    ],
)
def test_a_faulty_relation_is_refused(name, parts, message):
    with pytest.raises(ValueError, match=message):
        RELATIONS[name] = parts
    assert tuple(RELATIONS) == PUBLISHED


# ---- points

metres = st.floats(-0.2, 0.2)


def with_points(name, offset=(0.03, -0.1, 0.02)):
    """Return the published task with two points: one on its last object, one at a fixed place."""
    task = TASKS[name].published
    beside = NamedObject("place beside it", task.objects[-1].position, offset, ours=True)
    fixed = NamedObject("fixed place", (0.1, 0.7, 0.15), ours=True)
    return Task(name, task.description, (*task.objects, beside, fixed))


def states_of(name, n=100):
    return torch.from_numpy(random_states(name, seed=21, n=n)).double(), torch.full((n,), task_id(name))


@pytest.mark.parametrize("name", MT50)
def test_published_only_lists_no_points(name):
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


def test_points_do_not_change_the_truth_of_published_queries():
    for name in MT50:
        states, ids = states_of(name)
        published = list(supported_queries(name, published_only=True))
        alone = QueryProgram({TASKS[name].published: published})(states, ids)
        extended = QueryProgram({with_points(name): [*published, "gripper near fixed place"]})(states, ids)
        assert torch.equal(alone, extended[:, :-1]), name
        assert torch.equal(alone, QueryProgram({name: published})(states, ids)), name


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(MT50), st.tuples(metres, metres, metres), st.sampled_from(sorted(RELATIONS)))
def test_queries_use_the_position_of_a_point(name, offset, relation):
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


def test_touching_the_table_includes_the_offset():
    low = NamedObject("low place", (4, 5, 6), (0.0, 0.0, -0.05), ours=True)
    task = Task("push", "Push it.", (*TASKS["push"].published.objects, low))
    program = QueryProgram({task: ["puck touching the table", "low place touching the table"]})
    assert program(observation(one=[0.0, 0.0, 0.06]), torch.tensor(task_id("push"))).tolist() == [False, True]
