"""The 50 tasks against the published package; names, ids, files of tasks; a custom task from its plan to an action."""

import json
from importlib.resources import files
from inspect import signature
from pathlib import Path
from pydoc import render_doc

import language_world as oracle
import numpy as np
import pytest
import torch
from cases import read_cases
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.objects import GRIPPER, NamedObject, read_objects, write_objects
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.skills import SkillError
from lw_torchrl.language.tasks import MT10, MT50, TASKS, Task, TaskError, get_task, load_tasks, resolve_tasks, task_id

CASES = read_cases("language/tasks.toml")
HAND = NamedObject(GRIPPER, (0, 1, 2))


def read(position, observation):
    return np.array([float(observation[c]) if isinstance(c, int) else c for c in position])


def test_the_names_are_the_published_ones_in_sorted_order():
    assert list(MT50) == list(TASKS) == sorted(oracle.MT50_ENV_NAMES)
    assert list(MT10) == sorted(oracle.MT10_ENV_NAMES)
    assert all(task.name == name for name, task in TASKS.items())
    with pytest.raises(TypeError):
        TASKS["reach"] = TASKS["push"]


def test_the_task_id_is_the_rank_of_the_name():
    assert [task_id(name) for name in sorted(oracle.MT50_ENV_NAMES)] == list(range(50))
    # Without "-v3": with it "button-press-topdown-v3" would come before "button-press-v3".
    assert task_id("button-press") < task_id("button-press-topdown")


def test_descriptions_are_different_sentences_and_not_the_published_ones():
    descriptions = [task.description for task in TASKS.values()]
    assert len({text.casefold().strip(".") for text in descriptions}) == 50
    published = {text.casefold() for text in oracle.TASK_DESCRIPTIONS.values()}
    for text in descriptions:
        assert text[0].isupper()
        assert text.endswith(".")
        assert ". " not in text, "one sentence"
        assert text.casefold().strip(".") not in published


@pytest.mark.parametrize("name", MT50)
def test_objects_and_their_positions_are_the_published_ones(name):
    relations = [query.split(" is near ") for query in oracle.enumerate_base_queries(name) if " is near " in query]
    names = {side.removeprefix("the ") for sides in relations for side in sides}
    published = TASKS[name].published
    assert sorted(published.object_names) == sorted(names)
    assert published.object_names[0] == GRIPPER
    assert all(named.offset == (0.0, 0.0, 0.0) for named in published.objects)
    assert TASKS[name].objects[: len(names)] == published.objects, "our points come last"
    observation = np.random.default_rng(0).uniform(-1, 1, 39)
    parsed = oracle.ParsedObs.from_obs(observation)
    for named in published.objects:
        expected = oracle._get_object_location(name, f"the {named.name}", parsed)
        np.testing.assert_array_equal(read(named.position, observation), expected, err_msg=named.name)


@pytest.mark.parametrize("name", MT50)
def test_positions_of_a_batch(name):
    for dtype in (torch.float32, torch.float64):
        observation = torch.rand(2, 3, 39, generator=torch.Generator().manual_seed(0)).to(dtype)
        positions = TASKS[name].positions(observation)
        assert tuple(positions) == TASKS[name].object_names
        for named in TASKS[name].objects:
            expected = torch.stack([torch.from_numpy(read(named.position, o)) for o in observation.reshape(6, 39)])
            expected = expected.to(dtype) + torch.tensor(named.offset, dtype=dtype)
            assert torch.equal(positions[named.name], expected.reshape(2, 3, 3))
            assert positions[named.name].dtype == dtype
    assert TASKS[name].positions(observation[0, 0])[GRIPPER].tolist() == observation[0, 0, :3].tolist()


def test_positions_that_are_not_plain_slices():
    # The numbers themselves, so that a change on both sides of the test above is seen too.
    assert TASKS["peg-insert-side"].object("hole").position == (-0.35, 37, 0.16)
    assert TASKS["stick-pull"].object("thermos").position == (11, 12, 13)
    assert TASKS["button-press-wall"].object("wall").position == (0.1, 0.6, 0.0)
    assert TASKS["button-press-topdown-wall"].object("wall").position == (0.1, 0.7, 0.0)
    assert all(TASKS[f"{n}-wall"].object("wall").position == (0.1, 0.75, 0.06) for n in ("reach", "push", "pick-place"))
    assert all(task.object(GRIPPER).position == (0, 1, 2) for task in TASKS.values())
    # A whole number in the table is a fixed place, not an index.
    assert all(isinstance(c, float) for c in TASKS["button-press-wall"].object("wall").position)


# ---- names and ids


def test_resolve_tasks_accepts_a_set_a_name_or_names():
    assert [resolve_tasks(names) for names in ("MT10", "MT50", "pick-place")] == [MT10, MT50, ("pick-place",)]
    for names in (["push", "assembly"], {"push": 1, "assembly": 2}, (name for name in ["push", "assembly"])):
        assert resolve_tasks(names) == ("assembly", "push")


@pytest.mark.parametrize(
    ("names", "error", "words"),
    [
        ("pick-plaec", ValueError, ["'pick-plaec'", "did you mean", "'pick-place'"]),
        ("MT5", ValueError, ["'MT5'", "'MT50'"]),
        ("mt10", ValueError, ["'MT10'"]),
        (["reach", "drawer-opne"], ValueError, ["'drawer-opne'", "'drawer-open'"]),
        (["MT10"], ValueError, ["'MT10'"]),
        ("push, reach", ValueError, ["'push, reach'", "spaces", "list"]),
        ([None], TypeError, ["None"]),
    ],
)
def test_resolve_tasks_names_the_fault(names, error, words):
    with pytest.raises(error) as caught:
        resolve_tasks(names)
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("name", ["reahc", "", "Reach", " reach", "reach-v3"])
def test_an_unknown_task_is_a_value_error(name):
    with pytest.raises(ValueError, match="task must be one of"):
        get_task(name)


def test_the_id_of_any_other_name_never_changes():
    ids = {"stack-blocks": 650718257, "reahc": 893438262, "reach-v3": 94884373, "x": 950319221}
    assert {name: task_id(name) for name in ids} == ids


@pytest.mark.parametrize("name", ["", "Reach", " reach", "reach_v3", "reach-", "-", "../reach", "3d", "reach\n", "ré"])
def test_a_wrong_task_name_is_refused(name):
    for function in (task_id, lambda name: Task(name, "Do it.", (HAND,))):
        with pytest.raises(ValueError, match="lower-case words"):
            function(name)


def test_a_suite_s_name_may_have_a_hyphen():
    task = Task("my-desk/hover-low", "Do it.", (HAND,))
    plan = lw.ConditionalPlan.from_pairs(task, [("the gripper is open", "wait at the gripper")])
    assert "def my_desk__hover_low(robot):" in str(plan)
    assert parse_plan(str(plan), tasks={task.name: task}).task == "my-desk/hover-low"


def test_help_begins_with_a_short_signature():
    for function in (lw.load_plans, lw.load_skills, lw.decode_plan, lw.planners.plan_prompt):
        assert "lw.TASKS, the 50 tasks from assembly to window-open" in render_doc(function)
        assert len(str(signature(function))) < 500


# ---- custom tasks


def test_an_unknown_object_names_the_nearest():
    with pytest.raises(ValueError, match="did you mean 'drawer handle'"):
        TASKS["drawer-open"].object("drawer handel")


@pytest.mark.parametrize("name", ["", "Puck", "the puck", "puck and peg", "what is it", "not puck", "a  peg", " puck"])
def test_an_object_name_that_queries_cannot_contain_is_refused(name):
    with pytest.raises(ValueError, match="name"):
        NamedObject(name, (4, 5, 6))


@pytest.mark.parametrize("position", [(4, 5, 39), (-1, 0, 1)])
def test_a_position_outside_the_observation_is_refused(position):
    with pytest.raises(ValueError, match="position of 'puck'"):
        Task("mine", "Mine.", (HAND, NamedObject("puck", position)))


@pytest.mark.parametrize("names", [[], ["puck"], ["puck", GRIPPER], [GRIPPER, "puck", "puck"], [GRIPPER, GRIPPER]])
def test_a_task_has_the_gripper_first_and_different_names(names):
    with pytest.raises(ValueError, match="objects of 'mine'"):
        Task("mine", "Mine.", tuple(NamedObject(name, (4, 5, 6)) for name in names))


def test_a_task_has_at_most_64_objects():
    objects = {f"cup {number}": "obs[4:7]" for number in range(63)}
    task = Task.from_json("mine", {"description": "Mine.", "objects": objects})
    assert len(task.object_names) == 64
    assert str(nearest_query("cup 61 is abof cup 2", task).parts[0].query) == "the cup 61 is above the cup 2"
    with pytest.raises(TaskError, match=r"objects of 'mine' .*64"):
        Task.from_json("mine", {"description": "Mine.", "objects": objects | {"lid": "obs[4:7]"}})


PUSH = '[push]\ndescription = "Push the disc."\nobjects.disc = "obs[4:7]"\n'


def load(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text, "utf-8")
    return load_tasks(path)


def test_a_file_replaces_tasks_of_the_same_name(tmp_path):
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
    push = mine["push"]
    assert {**mine, "push": TASKS["push"]} == TASKS
    assert push.description == "Push the disc."
    assert push.published.object_names == (GRIPPER, "disc", "goal")
    assert push.objects[2:] == (
        NamedObject("goal", (0.1, 37, 0.0)),
        NamedObject("disc edge", (4, 5, 6), (0.03, 0, 0), ours=True),
        NamedObject("corner", (0.4, 0.9, 0.0), ours=True),
        NamedObject("shadow", (4, 5, 0.0), ours=True),
        NamedObject("gripper tip", (0, 1, 2), (0.0, 0.0, -0.04), ours=True),
    )
    with pytest.raises(TypeError):
        mine["push"] = push


def test_a_custom_task_is_accepted_wherever_a_task_is(tmp_path):
    push = load(tmp_path, PUSH)["push"]
    assert get_task(push) is push
    assert str(lw.parse_query("gripper above the disc", push)) == "the robot's gripper is above the disc"
    assert "the disc is touching the table" in lw.supported_queries(push)
    assert str(nearest_query("gripper abov the disk", push).query) == "the robot's gripper is above the disc"
    program = lw.QueryProgram({push: ["gripper near disc", "disc touching the table"]})
    assert program(torch.zeros(39), torch.tensor(task_id("push"))).tolist() == [True, True]


def test_a_file_adds_tasks_that_the_simulator_lacks(tmp_path):
    added = '[stack-blocks]\ndescription = "Stack them."\nobjects.block = "obs[4:7]"\nobjects.tower = "obs[11:14]"\n'
    mine = load(tmp_path, PUSH + added)
    assert list(mine) == sorted([*TASKS, "stack-blocks"])
    assert mine["stack-blocks"].object_names == (GRIPPER, "block", "tower")
    assert resolve_tasks(["stack-blocks", "push"], tasks=mine) == ("push", "stack-blocks")
    assert resolve_tasks("MT50", tasks=mine) == MT50
    with pytest.raises(ValueError, match="did you mean 'stack-blocks'"):
        resolve_tasks(["stack-block"], tasks=mine)
    with pytest.raises(ValueError, match="must be one of"):
        resolve_tasks(["stack-blocks"])


def test_tasks_are_the_same_read_from_json_and_from_a_file():
    assert {name: Task.from_json(name, json.loads(json.dumps(TASKS[name].to_json()))) for name in MT50} == TASKS
    assert load_tasks(files("lw_torchrl.language") / "data" / "tasks.toml") == TASKS


def test_a_task_that_a_row_cannot_hold_is_refused():
    edge = NamedObject("edge", (4, 5, 6), (0.1, 0.0, 0.0), ours=True)
    for objects in ((HAND, edge), (NamedObject(GRIPPER, (4, 5, 6)),)):
        with pytest.raises(TaskError, match="mine"):
            Task("mine", "Mine.", objects).to_json()


def test_a_point_on_an_object_at_fixed_coordinates_is_written_as_a_point_on_that():
    # Index 1 and 1.0 metres are equal numbers, but different places.
    puck, wall = NamedObject("puck", (0, 1, 2)), NamedObject("wall", (0.0, 1, 2))
    side = NamedObject("wall side", (0.0, 1, 2), offset=(0.1, 0.0, 0.0), ours=True)
    written = write_objects((HAND, puck, wall, side))
    assert written["points"]["wall side"]["object"] == "wall"
    assert read_objects(written)[1:] == (puck, wall, side)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        *((PUSH.replace(old, new, 1), words) for old, new, words in CASES["changed"]),
        *((PUSH + added, words) for added, words in CASES["added"]),
        ("[push", ["end of document"]),
        ('[psuh]\ndescription = "Push."', ["'psuh'", "objects", "did you mean 'push'"]),
        ("push = 3", ["'push'", "table", "3"]),
        ('[push]\nobjects.disc = "obs[4:7]"', ["'push'", "description"]),
        ("[push]\ndescription = 3", ["'push'", "description", "3"]),
        (PUSH.replace('"obs[4:7]"', f"[0.1, {10**400}, 0.2]"), ["'push'", "'disc'"]),
        ('[push]\ndescription = "Push."\nobjects = ["disc"]', ["'push'", "objects", "disc"]),
        (PUSH + "points.disc = " + "[" * 5000, ["mine.toml"]),
        (PUSH + "points.disc = " + "9" * 5000, ["4300 digits"]),
    ],
)
def test_a_faulty_file_of_tasks_names_the_fault_and_its_place(tmp_path, text, words):
    with pytest.raises(TaskError) as caught:
        load(tmp_path, text)
    assert all(word in str(caught.value) for word in ["mine.toml", *words]), str(caught.value)


def test_a_missing_or_unreadable_file_of_tasks(tmp_path):
    with pytest.raises(FileNotFoundError):
        load_tasks(tmp_path / "none.toml")
    (tmp_path / "latin.toml").write_bytes(b"# caf\xe9")
    with pytest.raises(TaskError, match=r"latin\.toml"):
        load_tasks(tmp_path / "latin.toml")


# ---- a 51st task, from its plan to an action


STACKING = Path(__file__).parent / "stack_blocks"


@pytest.fixture
def stacking():
    tasks = lw.load_tasks(STACKING / "tasks.toml")
    own = lw.load_plans(STACKING / "stack-blocks.plan", tasks=tasks)["stack-blocks"]
    return tasks, {"stack-blocks": own, "push": lw.load_plans("MT10")["push"]}


def states(plans):
    observation = torch.rand(4, 39, generator=torch.Generator().manual_seed(0)) * 0.1
    observation[0, 0:3] = observation[0, 4:7]  # the gripper at the block
    ids = torch.tensor([lw.task_id(task) for task in ("stack-blocks", "push", "stack-blocks", "push")])
    return lw.QAFTransform(plans)(TensorDict({"observation": observation, "task_id": ids}, [4]))


def test_plans_queries_and_actors_of_a_51st_task(stacking):
    tasks, plans = stacking
    assert plans["stack-blocks"].definition is tasks["stack-blocks"]
    assert lw.load_plans("MT50", tasks=tasks).keys() == set(lw.MT50)
    batch = states(plans)
    assert not batch["qaf"][0, 0]  # near
    assert batch["qaf"][2, 0] == (batch["observation"][2, :3] - batch["observation"][2, 4:7]).norm().ge(0.04)
    alone = lw.QueryProgram({"push": [step.condition for step in plans["push"].steps]})
    assert torch.equal(batch["qaf"][1], alone(batch["observation"][1], batch["task_id"][1]))
    actor = lw.PlanConditionedActor(plans, text_encoder=lambda texts: torch.eye(len(texts), 8))
    assert actor(batch.clone())["skill_weights"][0, 2:].tolist() == [0.0] * (batch["qaf"].shape[-1] - 2)
    without = actor.with_plans({"push": plans["push"]}).eval()
    with pytest.raises(ValueError, match=rf"without a plan.*{lw.task_id('stack-blocks')} \(not a Meta-World task\)"):
        without(batch.clone())


def test_scripted_skills_of_a_51st_task(stacking):
    tasks, plans = stacking
    own = {"stack-blocks": plans["stack-blocks"]}
    batch = states(plans)[[0, 2]]
    batch["qaf"] = batch["qaf"][:, :2]
    skills = lw.load_skills(STACKING / "skills.toml", tasks=tasks)
    action = lw.ScriptedSkillActor(own, skills=skills)(batch)["action"]
    error = batch["observation"][0, 11:14] + torch.tensor([0.0, 0.0, 0.1]) - batch["observation"][0, 4:7]
    torch.testing.assert_close(action[0], torch.cat([(10 * error).clamp(-1, 1), torch.ones(1)]))
    with pytest.raises(SkillError, match="stack-blocks"):
        lw.load_skills(STACKING / "skills.toml")


def test_a_plan_without_a_definition_is_for_one_of_the_50():
    steps = lw.load_plans("MT10")["push"].steps
    with pytest.raises(ValueError, match="did you mean 'push'"):
        lw.ConditionalPlan("pushh", steps)
    task = lw.Task("pushh", "Push.", lw.TASKS["push"].objects)
    assert lw.ConditionalPlan("pushh", steps, task).definition is task
