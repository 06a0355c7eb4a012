"""The 50 tasks against the published package, and the ways to name them."""

import json
from inspect import signature
from pydoc import render_doc

import language_world as oracle
import numpy as np
import pytest
import torch

import lw_torchrl as lw
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.objects import GRIPPER, NamedObject
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.queries import parse_query, supported_queries
from lw_torchrl.language.query_program import QueryProgram
from lw_torchrl.language.tasks import (
    MT10,
    MT50,
    TASKS,
    Task,
    TaskError,
    check_task,
    get_task,
    load_tasks,
    resolve_tasks,
    task_id,
)


def read(position, observation):
    return np.array([float(observation[c]) if isinstance(c, int) else c for c in position])


def test_the_names_are_the_published_ones_in_sorted_order():
    assert len(TASKS) == 50
    assert list(TASKS) == sorted(oracle.MT50_ENV_NAMES)
    assert list(MT50) == list(TASKS)
    assert list(MT10) == sorted(oracle.MT10_ENV_NAMES)
    assert all(task.name == name for name, task in TASKS.items())


def test_the_table_cannot_be_changed():
    with pytest.raises(TypeError):
        TASKS["reach"] = TASKS["push"]


def test_the_task_id_is_the_rank_of_the_name():
    assert [task_id(name) for name in sorted(oracle.MT50_ENV_NAMES)] == list(range(50))
    # Without "-v3": with it "button-press-topdown-v3" would come before "button-press-v3".
    assert task_id("button-press") < task_id("button-press-topdown")


def test_descriptions_are_distinct_sentences_of_our_own():
    descriptions = [task.description for task in TASKS.values()]
    assert len(set(descriptions)) == 50
    assert len({text.casefold().strip(".") for text in descriptions}) == 50
    assert TASKS["door-lock"].description != TASKS["door-unlock"].description
    published = {text.casefold() for text in oracle.TASK_DESCRIPTIONS.values()}
    for text in descriptions:
        assert text[0].isupper()
        assert text.endswith(".")
        assert ". " not in text, "one sentence"
        assert text.casefold().strip(".") not in published


@pytest.mark.parametrize("name", MT50)
def test_objects_are_the_published_ones(name):
    relations = [query.split(" is near ") for query in oracle.enumerate_base_queries(name) if " is near " in query]
    named = {side.removeprefix("the ") for sides in relations for side in sides}
    published = TASKS[name].published
    assert set(published.object_names) == named
    assert published.object_names[0] == GRIPPER
    assert len(published.objects) == len(named)
    assert all(thing.offset == (0.0, 0.0, 0.0) for thing in published.objects)
    assert TASKS[name].objects[: len(named)] == published.objects, "points of ours come after"


@pytest.mark.parametrize("name", MT50)
def test_positions_are_read_where_the_published_package_reads_them(name):
    observation = np.random.default_rng(0).uniform(-1, 1, 39)
    parsed = oracle.ParsedObs.from_obs(observation)
    for named in TASKS[name].published.objects:
        expected = oracle._get_object_location(name, f"the {named.name}", parsed)
        np.testing.assert_array_equal(read(named.position, observation), expected, err_msg=named.name)


@pytest.mark.parametrize("name", MT50)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_positions_of_a_whole_batch(name, dtype):
    observation = torch.rand(2, 3, 39, generator=torch.Generator().manual_seed(0)).to(dtype)
    positions = TASKS[name].positions(observation)
    assert tuple(positions) == TASKS[name].object_names
    for named in TASKS[name].objects:
        at = positions[named.name]
        assert at.shape == (2, 3, 3)
        assert at.dtype == dtype
        expected = torch.stack([torch.from_numpy(read(named.position, o)) for o in observation.reshape(6, 39)])
        assert torch.equal(at.reshape(6, 3), expected.to(dtype) + torch.tensor(named.offset, dtype=dtype))
    assert TASKS[name].positions(observation[0, 0])[GRIPPER].tolist() == observation[0, 0, :3].tolist()


def test_positions_that_are_not_plain_slices():
    # The facts in words, so that a change on both sides of the test above is seen too.
    assert TASKS["peg-insert-side"].object("hole").position == (-0.35, 37, 0.16)
    assert TASKS["stick-pull"].object("thermos").position == (11, 12, 13)
    assert TASKS["button-press-wall"].object("wall").position == (0.1, 0.6, 0.0)
    assert TASKS["button-press-topdown-wall"].object("wall").position == (0.1, 0.7, 0.0)
    assert all(TASKS[f"{n}-wall"].object("wall").position == (0.1, 0.75, 0.06) for n in ("reach", "push", "pick-place"))
    assert all(task.object(GRIPPER).position == (0, 1, 2) for task in TASKS.values())
    # A whole number in the table is a fixed place, not an index.
    assert all(isinstance(c, float) for c in TASKS["button-press-wall"].object("wall").position)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ("MT10", MT10),
        ("MT50", MT50),
        ("pick-place", ("pick-place",)),
        (["push", "door-open"], ("door-open", "push")),
        (("reach",), ("reach",)),
        ({"push": 1, "assembly": 2}, ("assembly", "push")),
        ((name for name in ["window-open", "basketball"]), ("basketball", "window-open")),
        (reversed(MT50), MT50),
    ],
)
def test_resolve_tasks_takes_a_set_a_name_or_names(given, expected):
    assert resolve_tasks(given) == expected


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ("pick-plaec", ValueError, ["'pick-plaec'", "did you mean", "'pick-place'"]),
        ("MT5", ValueError, ["'MT5'", "'MT50'"]),
        ("mt10", ValueError, ["'MT10'"]),
        (["reach", "drawer-opne"], ValueError, ["'drawer-opne'", "'drawer-open'"]),
        (["MT10"], ValueError, ["'MT10'"]),
        (["push", "reach", "push"], ValueError, ["once", "push"]),
        ([], ValueError, ["at least one task", "empty"]),
        (3, TypeError, ["tasks", "3"]),
        ([None], TypeError, ["None"]),
    ],
)
def test_resolve_tasks_names_what_is_wrong(given, error, says):
    with pytest.raises(error) as caught:
        resolve_tasks(given)
    assert all(word in str(caught.value) for word in says), str(caught.value)


@pytest.mark.parametrize("function", [check_task, get_task])
@pytest.mark.parametrize("name", ["reahc", "", "Reach", " reach", "reach-v3"])
def test_an_unknown_task_is_a_value_error(function, name):
    with pytest.raises(ValueError, match="task must be one of"):
        function(name)


OWN = {"stack-blocks": 650718257, "reahc": 893438262, "reach-v3": 94884373, "x": 950319221}


@pytest.mark.parametrize(("name", "number"), OWN.items())
def test_any_other_name_has_an_id_of_its_own_that_never_changes(name, number):
    assert task_id(name) == number
    assert 50 <= number < 2**31


@pytest.mark.parametrize("name", ["", "Reach", " reach", "reach_v3", "reach-", "-", "../reach", "3d", "reach\n", "ré"])
def test_a_name_that_no_task_may_have(name):
    for function in (task_id, lambda given: Task(given, "Do it.", (NamedObject(GRIPPER, (0, 1, 2)),))):
        with pytest.raises(ValueError, match="lower-case words joined by hyphens"):
            function(name)


def test_a_suite_s_name_may_have_a_hyphen():
    task = Task("my-desk/hover-low", "Do it.", (NamedObject(GRIPPER, (0, 1, 2)),))
    plan = lw.ConditionalPlan.from_pairs(task, [("the gripper is open", "wait at the gripper")])
    assert "def my_desk__hover_low(robot):" in str(plan)
    assert parse_plan(str(plan), tasks={task.name: task}).task == "my-desk/hover-low"


def test_an_unknown_object_names_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'drawer handle'"):
        TASKS["drawer-open"].object("drawer handel")


def test_a_task_of_ones_own_is_returned_as_it_is():
    mine = Task("stacking", "Stack them.", (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("block", (4, 5, 6))))
    assert get_task(mine) is mine
    assert mine.object_names == (GRIPPER, "block")


@pytest.mark.parametrize(
    "name", ["", "Puck", "the puck", "puck and peg", "what is it", "not puck", "puck  peg", " puck"]
)
def test_an_object_name_that_queries_could_not_hold_is_refused(name):
    with pytest.raises(ValueError, match="name"):
        NamedObject(name, (4, 5, 6))


@pytest.mark.parametrize("position", [(4, 5), (4, 5, 39), (-1, 0, 1), ()])
def test_a_position_outside_the_observation_is_refused(position):
    with pytest.raises(ValueError, match="puck"):
        Task("mine", "Mine.", (NamedObject(GRIPPER, (0, 1, 2)), NamedObject("puck", position)))


@pytest.mark.parametrize("names", [[], ["puck"], ["puck", GRIPPER], [GRIPPER, "puck", "puck"], [GRIPPER, GRIPPER]])
def test_a_task_needs_the_gripper_first_and_different_names(names):
    with pytest.raises(ValueError, match="objects of task 'mine'"):
        Task("mine", "Mine.", tuple(NamedObject(name, (4, 5, 6)) for name in names))


def test_a_task_has_at_most_64_objects():
    objects = {f"cup {number}": "obs[4:7]" for number in range(63)}
    task = Task.from_json("mine", {"description": "Mine.", "objects": objects})
    assert len(task.object_names) == 64
    assert str(nearest_query("cup 61 is abof cup 2", task).parts[0].query) == "the cup 61 is above the cup 2"
    with pytest.raises(TaskError, match="objects of task 'mine' must be at most 64, the gripper included, got 65"):
        Task.from_json("mine", {"description": "Mine.", "objects": objects | {"lid": "obs[4:7]"}})


PUSH = '[push]\ndescription = "Push the disc."\nobjects.disc = "obs[4:7]"\n'


def load(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, "utf-8")
    return load_tasks(path)


def test_tasks_of_ones_own_replace_ours_of_the_same_name(tmp_path):
    mine = load(
        tmp_path,
        PUSH
        + """
objects.goal = [0.1, "obs[37]", 0]
points."disc edge" = {object = "disc", offset = [0.03, 0, 0]}
points.corner = [0.4, 0.9, 0.0]
points.shadow = ["obs[4]", "obs[5]", 0.0]
points."gripper tip" = {object = "robot's gripper", offset = [0.0, 0.0, -0.04]}
""",
    )
    assert list(mine) == list(TASKS)
    assert all(mine[name] is TASKS[name] for name in MT50 if name != "push")
    push = mine["push"]
    assert push.description == "Push the disc."
    assert push.object_names == (GRIPPER, "disc", "goal", "disc edge", "corner", "shadow", "gripper tip")
    assert push.published.object_names == (GRIPPER, "disc", "goal")
    assert push.object("goal") == NamedObject("goal", (0.1, 37, 0.0))
    assert push.object("disc edge") == NamedObject("disc edge", (4, 5, 6), (0.03, 0, 0), ours=True)
    assert push.object("corner") == NamedObject("corner", (0.4, 0.9, 0.0), ours=True)
    assert push.object("shadow") == NamedObject("shadow", (4, 5, 0.0), ours=True)
    assert push.object("gripper tip").position == (0, 1, 2)
    with pytest.raises(TypeError):
        mine["push"] = push
    assert TASKS["push"].object_names != push.object_names


def test_a_task_of_ones_own_is_taken_wherever_a_task_is_asked_for(tmp_path):
    push = load(tmp_path, PUSH)["push"]
    assert str(parse_query("gripper above the disc", push)) == "the robot's gripper is above the disc"
    assert "the disc is touching the table" in supported_queries(push)
    assert str(nearest_query("gripper abov the disk", push).query) == "the robot's gripper is above the disc"
    program = QueryProgram({push: ["gripper near disc", "disc touching the table"]})
    state, ids = torch.zeros(39), torch.tensor(task_id("push"))
    assert program(state, ids).tolist() == [True, True]
    assert (program.logits(state, ids) > 0).tolist() == [True, True]


STACK = PUSH + '[stack-blocks]\ndescription = "Stack them."\nobjects.block = "obs[4:7]"\nobjects.tower = "obs[11:14]"\n'


def test_tasks_that_the_simulator_does_not_have(tmp_path):
    mine = load(tmp_path, STACK)
    assert list(mine) == sorted([*TASKS, "stack-blocks"])
    assert mine["stack-blocks"].object_names == (GRIPPER, "block", "tower")
    assert resolve_tasks(["stack-blocks", "push"], tasks=mine) == ("push", "stack-blocks")
    assert resolve_tasks("stack-blocks", tasks=mine) == ("stack-blocks",)
    assert resolve_tasks("MT50", tasks=mine) == MT50
    with pytest.raises(ValueError, match="did you mean 'stack-blocks'"):
        resolve_tasks(["stack-block"], tasks=mine)
    with pytest.raises(ValueError, match="must be one of"):
        resolve_tasks(["stack-blocks"])


@pytest.mark.parametrize("name", MT50)
def test_a_task_is_the_same_read_from_its_json(name):
    row = json.loads(json.dumps(TASKS[name].to_json()))
    assert Task.from_json(name, row) == TASKS[name]


def test_a_task_that_is_no_row_of_the_table():
    beside = NamedObject("edge", (4, 5, 6), (0.1, 0.0, 0.0), ours=True)
    with pytest.raises(TaskError, match="cannot be written"):
        Task("mine", "Mine.", (NamedObject(GRIPPER, (0, 1, 2)), beside)).to_json()
    with pytest.raises(TaskError, match="cannot be written"):
        Task("mine", "Mine.", (NamedObject(GRIPPER, (4, 5, 6)),)).to_json()


def test_our_own_table_is_such_a_file():
    from importlib.resources import files

    assert load_tasks(files("lw_torchrl.language") / "data" / "tasks.toml") == TASKS


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("[push", ["']'", "end of document"]),
        ('[psuh]\ndescription = "Push."', ["'psuh'", "must name its objects", "did you mean 'push'"]),
        (PUSH.replace("[push]", '["Push it"]'), ["'Push it'", "lower-case words joined by hyphens"]),
        ("push = 3", ["'push'", "table", "3"]),
        (PUSH + 'object.puck = "obs[4:7]"', ["'push'", "'object'", "did you mean 'objects'"]),
        (PUSH + 'point.puck = "obs[4:7]"', ["'push'", "'point'", "'points'"]),
        (PUSH.replace("description", "desciption"), ["'desciption'", "'description'"]),
        ('[push]\nobjects.disc = "obs[4:7]"', ["'push'", "description must be a sentence"]),
        ("[push]\ndescription = 3", ["'push'", "description must be a sentence", "3"]),
        (PUSH.replace("obs[4:7]", "obs[4:8]"), ["'push'", "'disc'", "'obs[4:8]'", "'obs[4:7]'"]),
        (PUSH.replace("obs[4:7]", "obs[37:40]"), ["'push'", "'disc'", "obs[39]", "0 to 38"]),
        (PUSH.replace("obs[4:7]", "state[4:7]"), ["'push'", "'disc'", "'obs[4:7]'"]),
        (PUSH.replace('"obs[4:7]"', "[0.1, 0.2]"), ["'push'", "'disc'", "[0.1, 0.2]"]),
        (PUSH.replace('"obs[4:7]"', "[0.1, nan, 0.2]"), ["'push'", "'disc'", "nan"]),
        (PUSH.replace('"obs[4:7]"', f"[0.1, {10**400}, 0.2]"), ["'push'", "'disc'"]),
        (PUSH.replace(".disc", '."The Disc"'), ["'push'", "'The Disc'", "lower-case"]),
        (PUSH.replace(".disc", '."robot\'s gripper"'), ["'push'", "robot's gripper", "every task has"]),
        ('[push]\ndescription = "Push."\nobjects = ["disc"]', ["'push'", "objects must be a table", "disc"]),
        (PUSH + "points = 3", ["'push'", "points must be a table", "3"]),
        (PUSH + "points.edge = {object = 'disk', offset = [0, 0, 0]}", ["'edge'", "'disk'", "did you mean 'disc'"]),
        (PUSH + "points.edge = {object = 'disc'}", ["'edge'", "object and offset"]),
        (PUSH + "points.edge = {objekt = 'disc', offset = [0, 0, 0]}", ["'edge'", "'objekt'", "did you mean 'object'"]),
        (PUSH + "points.edge = {object = 'disc', offset = [0, 0]}", ["'edge'", "three numbers", "[0, 0]"]),
        (PUSH + "points.edge = {object = ['disc'], offset = [0, 0, 0]}", ["'edge'", "['disc']"]),
        (PUSH + "points.edge = 'obs[4]'", ["'edge'", "'obs[4:7]'"]),
        (PUSH + "points.disc = [0, 0, 0]", ["'push'", "different names", "'disc'"]),
        (PUSH + "points.disc = ", ["Invalid value"]),
        (PUSH + "points.disc = " + "[" * 5000, ["mine.toml"]),
        (PUSH + "points.disc = " + "9" * 5000, ["4300 digits"]),
    ],
)
def test_a_file_of_tasks_says_what_is_wrong_and_where(tmp_path, text, says):
    with pytest.raises(TaskError) as caught:
        load(tmp_path, text)
    message = str(caught.value)
    assert isinstance(caught.value, ValueError)
    assert all(word in message for word in ["mine.toml", *says]), message


def test_a_missing_or_unreadable_file_of_tasks(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_tasks(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"# caf\xe9")
    with pytest.raises(TaskError, match=r"latin\.toml"):
        load_tasks(tmp_path / "latin.toml")


@pytest.mark.parametrize("function", [lw.load_plans, lw.load_skills, lw.decode_plan, lw.plan_prompt])
def test_help_begins_with_a_short_signature(function):
    said = render_doc(function)
    assert "lw.TASKS, the 50 tasks from assembly to window-open" in said
    assert len(str(signature(function))) < 500
