"""Tasks that the simulator does not have, from their plan to an action."""

import pytest
import torch
from tensordict import TensorDict

import lw_torchrl as lw
from lw_torchrl.language.objects import GRIPPER, NamedObject, read_objects, write_objects
from lw_torchrl.language.skills import SkillError

FILE = """
[stack-blocks]
description = "Put the block on the tower."
objects.block = "obs[4:7]"
objects.tower = "obs[11:14]"
points."tower top" = { object = "tower", offset = [0.0, 0.0, 0.1] }
"""
PLAN = """def stack_blocks(robot):
    if check("the gripper is not near the block"):
        robot.place("the gripper around the block")
    if check("the block is not above the tower top"):
        robot.move("the block above the tower top")
"""
SKILLS = """
["place the gripper around the block"]
target = "block"
["move the block above the tower top"]
target = "tower top"
moved = "block"
for.stack-blocks.gripper = 1.0
"""


@pytest.fixture
def mine(tmp_path):
    (tmp_path / "tasks.toml").write_text(FILE)
    (tmp_path / "stack-blocks.plan").write_text(PLAN)
    (tmp_path / "skills.toml").write_text(SKILLS)
    tasks = lw.load_tasks(tmp_path / "tasks.toml")
    own = lw.load_plans(tmp_path / "stack-blocks.plan", tasks=tasks)["stack-blocks"]
    return tasks, {"stack-blocks": own, "push": lw.load_plans("MT10")["push"]}


def states(plans):
    observation = torch.rand(4, 39, generator=torch.Generator().manual_seed(0)) * 0.1
    observation[0, 0:3] = observation[0, 4:7]  # the gripper at the block
    task_id = torch.tensor([lw.task_id(task) for task in ("stack-blocks", "push", "stack-blocks", "push")])
    return lw.QAFTransform(plans)(TensorDict({"observation": observation, "task_id": task_id}, [4]))


def test_plans_queries_and_actors_of_a_51st_task(mine):
    tasks, plans = mine
    assert plans["stack-blocks"].definition is tasks["stack-blocks"]
    assert lw.load_plans("MT50", tasks=tasks).keys() == set(lw.MT50)
    batch = states(plans)
    assert not batch["qaf"][0, 0]  # near
    assert batch["qaf"][2, 0] == (batch["observation"][2, :3] - batch["observation"][2, 4:7]).norm().ge(0.04)
    alone = lw.QueryProgram({"push": [step.condition for step in plans["push"].steps]})
    assert torch.equal(batch["qaf"][1], alone(batch["observation"][1], batch["task_id"][1]))
    torch.manual_seed(0)
    actor = lw.PlanConditionedActor(plans, text_encoder=lambda texts: torch.eye(len(texts), 8))
    assert actor(batch.clone())["skill_weights"][0, 2:].tolist() == [0.0] * (batch["qaf"].shape[-1] - 2)
    with_51, without = actor.eval()(batch.clone())["action"], actor.with_plans({"push": plans["push"]}).eval()
    # Texts of one plan alone are other rows of the encoder's input, but the weights' shape says who is who.
    assert with_51.shape == (4, 4)
    with pytest.raises(ValueError, match=rf"without a plan.*{lw.task_id('stack-blocks')} \(none of the 50\)"):
        without(batch.clone())


def test_scripted_skills_of_a_51st_task(mine, tmp_path):
    tasks, plans = mine
    own = {"stack-blocks": plans["stack-blocks"]}
    batch = states(plans)[[0, 2]]
    batch["qaf"] = batch["qaf"][:, :2]
    skills = lw.load_skills(tmp_path / "skills.toml", tasks=tasks)
    action = lw.ScriptedSkillActor(own, skills=skills)(batch)["action"]
    way = batch["observation"][0, 11:14] + torch.tensor([0.0, 0.0, 0.1]) - batch["observation"][0, 4:7]
    torch.testing.assert_close(action[0], torch.cat([(10 * way).clamp(-1, 1), torch.ones(1)]))
    with pytest.raises(SkillError, match="stack-blocks"):
        lw.load_skills(tmp_path / "skills.toml")


def test_a_plan_without_a_definition_is_of_one_of_the_50():
    steps = lw.load_plans("MT10")["push"].steps
    with pytest.raises(ValueError, match="did you mean 'push'"):
        lw.ConditionalPlan("pushh", steps)
    stranger = lw.Task("pushh", "Push.", lw.TASKS["push"].objects)
    assert lw.ConditionalPlan("pushh", steps, stranger).definition is stranger
    assert lw.Plans([lw.ConditionalPlan("pushh", steps, stranger)]).num_steps == len(steps)


def test_a_point_beside_a_place_in_metres_is_written_as_one_beside_that():
    """Index 1 and metre 1.0 are equal numbers, and other places."""
    puck, wall = NamedObject("puck", (0, 1, 2)), NamedObject("wall", (0.0, 1, 2))
    beside = NamedObject("wall side", (0.0, 1, 2), offset=(0.1, 0.0, 0.0), ours=True)
    written = write_objects((NamedObject(GRIPPER, (0, 1, 2)), puck, wall, beside))
    assert written["points"]["wall side"]["object"] == "wall"
    assert read_objects(written)[1:] == (puck, wall, beside)
