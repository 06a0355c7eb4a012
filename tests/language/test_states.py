"""States of openings: "open" and "closed" of an object's own number, custom states; layouts."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lw_torchrl.language.layout import METAWORLD, Layout, Slot, places
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.queries import QueryError, parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.relations import PREDICATES, STATES, Comparison
from lw_torchrl.language.tasks import Task, task_id
from lw_torchrl.planners.prompts import plan_prompt

THINGS = ("door", "light switch")
LAYOUT = Layout("house", 15, hand=0, opening=3, things=(Slot(4), Slot(7)), goal=12)
HOUSE = Task(
    "house/tidy-up",
    "Tidy up.",
    (
        NamedObject(GRIPPER, (0, 1, 2)),
        NamedObject("door", (4, 5, 6), opening=10),
        NamedObject("light switch", (7, 8, 9), opening=11),
        NamedObject("cup", (12, 13, 14)),
    ),
    LAYOUT,
)


def answers(state, *asked):
    ids = torch.full((len(state),), task_id(HOUSE.name))
    program = QueryProgram({HOUSE: list(asked)})
    truth, logits = program(state, ids), program.logits(state, ids)
    assert torch.equal(logits > 0, truth)
    return truth, logits


shares = st.floats(0.0, 1.0, width=32)


@given(st.lists(st.tuples(shares, shares, shares), min_size=1, max_size=9), st.sampled_from(THINGS))
def test_open_and_closed_compare_an_object_s_own_opening(openings, thing):
    state = torch.zeros(len(openings), 15)
    state[:, [3, 10, 11]] = torch.tensor(openings)
    share = state[:, HOUSE.openings[thing]]
    both = f"the {thing} isn't open and the cup is near the gripper"
    truth, logits = answers(state, f"the {thing} is open", f"is the {thing} closed?", both)
    assert torch.equal(truth, torch.stack((share > 0.75, share <= 0.75, share <= 0.75), -1))
    state[:, 3] = share
    assert torch.equal(answers(state, "the gripper is open")[1][:, 0], logits[:, 0])


def test_a_layout_s_own_threshold_counts():
    half = replace(HOUSE, layout=replace(LAYOUT, thresholds={"open": 0.5}))
    state = torch.zeros(1, 15)
    state[0, 10] = 0.6
    program = QueryProgram({half: ["the door is open"]})
    assert program(state, torch.tensor([task_id(half.name)])).item()


def test_states_are_listed_and_in_prompts():
    listed = tuple(f"the {thing} is {state}" for thing in THINGS for state in ("open", "closed", "wide open"))
    assert supported_queries(HOUSE)[-8:-2] == listed
    assert not {*listed} & {*supported_queries(HOUSE, published_only=True)}
    assert str(nearest_query("the dor is opn", HOUSE).query) == "the door is open"
    for task, openable in ((HOUSE, "robot's gripper or door or light switch"), ("push", "robot's gripper")):
        part = f"or that the {openable} is open or closed or wide open. Several conditions"
        assert part in plan_prompt(task, "basic_py", vocabulary=True)


def test_a_custom_state_is_a_predicate_of_objects_with_an_opening(monkeypatch):
    with pytest.raises(QueryError, match=r"expected one of .*'open', 'closed'"):
        parse_query("the light switch is on", HOUSE)
    ajar = Comparison("z", ">", 0.1, length=False), Comparison("z", "<=", 0.75, length=False)
    monkeypatch.setitem(STATES, "on", STATES["open"])
    monkeypatch.setitem(STATES, "ajar", ajar)
    assert str(parse_query("Isn't the light switch on?", HOUSE)) == "the light switch is not on"
    assert {"the door is ajar", "the robot's gripper is ajar"} & {*supported_queries(HOUSE)} == {"the door is ajar"}
    state = torch.zeros(4, 15)
    state[:, 10] = torch.tensor([0.05, 0.5, 0.75, 0.8])
    asked = "the door is ajar", "the door is not ajar", "the door is on and the light switch is not on"
    truth, _ = answers(state, *asked)
    assert truth.T.tolist() == [[False, True, True, False], [True, False, False, True], [False, False, False, True]]
    with pytest.raises(QueryError, match=r"the cup .only the gripper and the door and the light switch can be"):
        parse_query("the cup is on", HOUSE)
    with pytest.raises(QueryError, match="only the gripper can be open or closed or wide open or on or ajar"):
        parse_query("the puck is ajar", "push")


@pytest.mark.parametrize(
    ("name", "parts", "message"),
    [
        ("near", STATES["open"], "'near'"),
        ("touching the table", STATES["open"], "touching"),
        ("on", (Comparison("x", ">", 0.5, length=False),), "opening"),
        ("on", (Comparison("z", ">", 0.5),), "opening"),
        ("on", Comparison("z", ">", 0.5, length=False), "Comparison"),
    ],
)
def test_a_faulty_state_is_refused(name, parts, message):
    with pytest.raises(ValueError, match=message):
        STATES[name] = parts
    assert [*STATES] == ["open", "closed", "wide open"]
    assert [*PREDICATES][-4:] == ["touching the table", "open", "closed", "wide open"]


def test_openings_are_written_and_read_again():
    assert HOUSE.to_json()["objects"]["door"] == {"position": "obs[4:7]", "opening": "obs[10]"}
    assert Task.from_json(HOUSE.name, HOUSE.to_json()) == HOUSE
    position = {"position": "obs[0:3]"}
    for at in ({"opening": "obs[3]"}, position, position | {"opening": 3}, {"openin": "obs[3]"}):
        with pytest.raises(ValueError, match=r"object 'door': .*opening"):
            Task.from_json("mine", {"description": "Mine.", "objects": {"door": at}})


def test_an_action_may_have_no_displacement_and_no_gripper():
    joints = replace(LAYOUT, displacement=None, gripper=None, action_size=2)
    assert Layout.from_json(joints.to_json()) == joints
    assert (LAYOUT.effort, LAYOUT.displaced("it")) == (slice(3, 4), slice(0, 3))
    assert joints.effort == slice(0, 0)
    with pytest.raises(ValueError, match=r"it: .*displacement of the hand, got layout 'house'"):
        joints.displaced("it")


# ---- layouts

HAND, FIRST, SECOND, GOAL = METAWORLD.positions


def test_the_parts_are_where_meta_world_puts_them(metaworld_env):
    env = metaworld_env("stick-pull")  # has two objects
    env.seed(0)
    env.reset()
    before = None
    turned = [slice(thing.quaternion, thing.quaternion + 4) for thing in METAWORLD.things]
    for _ in range(3):
        state = env.step(np.array([0.3, 0.2, -0.1, 1.0]))[0]
        np.testing.assert_allclose(state[HAND], env.get_endeff_pos(), atol=1e-12)
        np.testing.assert_array_equal(state[GOAL], env._target_pos)
        objects = env._get_pos_objects()
        np.testing.assert_allclose(np.concatenate([state[FIRST], state[SECOND]]), objects, atol=1e-12)
        turns = np.concatenate([state[part] for part in turned])
        np.testing.assert_allclose(turns, env._get_quat_objects(), atol=1e-12)
        assert 0 <= state[METAWORLD.opening] <= 1
        if before is not None:
            np.testing.assert_array_equal(state[METAWORLD.a_step_before(slice(0, 18))], before)
        before = state[:18]
    assert state.shape == (METAWORLD.size,)
    assert env.action_space.shape == (METAWORLD.action_size,)


def test_the_parts_cover_every_number_once():
    assert [part.start for part in METAWORLD.all_positions] == [0, 4, 11, 36, 18, 22, 29]
    numbers = [sorted(number for part in parts for number in places(part)) for parts in METAWORLD.parts]
    assert numbers == [[*range(4, 11), *range(22, 29)], [*range(11, 18), *range(29, 36)], [36, 37, 38]]


def test_a_layout_survives_json_and_pickle():
    own = Layout("mine", 12, hand=0, opening=3, things=(Slot(4),), goal=8, thresholds={"near": 0.05})
    for again in (Layout.from_json(own.to_json()), pickle.loads(pickle.dumps(own))):
        assert (again, hash(again)) == (own, hash(own))
    assert own != METAWORLD
    with pytest.raises(ValueError, match="previous time step"):
        own.a_step_before(slice(0, 3))
