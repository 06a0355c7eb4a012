"""SkillProgram: the batched controller against the formula, row by row."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import ScriptedSkill, SkillError

PLANS = lw.load_plans("MT50")
PROGRAM = SkillProgram({task: [step.skill for step in plan.steps] for task, plan in PLANS.items()})


def by_hand(skill, task, observation):
    """One skill in one state, as its definition says."""
    found = lw.load_skills()[skill].for_task(task)
    places = {name: p.double().numpy() for name, p in lw.TASKS[task].positions(observation.double()).items()}
    error = places[found.target] + np.array(found.offset) - places[found.moved]
    return [*np.clip(np.array(found.gain) * error, -1, 1), found.gripper]


@given(st.lists(st.sampled_from(lw.MT50), min_size=1, max_size=12), st.integers(0, 2**31))
def test_every_skill_of_every_row_is_the_formula(tasks, seed):
    generator = torch.Generator().manual_seed(seed)
    observation = torch.rand(len(tasks), 39, generator=generator, dtype=torch.float64) - 0.3
    actions = PROGRAM(observation, torch.tensor([lw.task_id(task) for task in tasks]))
    assert actions.shape == (len(tasks), PLANS.num_steps, 4)
    for row, task in enumerate(tasks):
        for s, step in enumerate(PLANS[task].steps):
            assert actions[row, s].tolist() == pytest.approx(by_hand(step.skill, task, observation[row]), abs=1e-12)
        assert not actions[row, len(PLANS[task].steps) :].any()


def test_any_leading_shape_and_precision():
    observation, ids = torch.rand(2, 3, 39), torch.randint(50, (2, 3))
    whole = PROGRAM(observation, ids)
    assert whole.shape == (2, 3, PLANS.num_steps, 4)
    assert whole.dtype == torch.float32
    assert torch.equal(PROGRAM(observation[0, 1], ids[0, 1]), whole[0, 1])


def test_an_object_moved_and_an_axis_left_alone():
    carry = ScriptedSkill("carry", "target location", moved="puck", gain=(10.0, 0.0, 100.0), gripper=1.0)
    observation = torch.zeros(1, 39)
    observation[0, 4:7] = torch.tensor([0.1, 0.5, 0.0])
    observation[0, 36:39] = torch.tensor([0.13, 0.9, 0.2])
    action = SkillProgram({"push": [carry]})(observation, torch.tensor([lw.task_id("push")]))
    assert action[0, 0].tolist() == pytest.approx([0.3, 0.0, 1.0, 1.0])


@pytest.mark.parametrize(
    ("skills", "error", "message"),
    [
        ({"push": ["place the griper above the puck"]}, ValueError, "did you mean 'place the gripper above the puck'"),
        ({"reach": ["place the gripper above the puck"]}, SkillError, "needs 'puck', which task 'reach' lacks"),
        ({"rech": ["place the gripper above the puck"]}, ValueError, "did you mean 'reach'"),
        ({}, ValueError, "skills must name at least one task"),
        ({"push": []}, ValueError, r"skills\['push'\] must be a list of at least one"),
    ],
)
def test_what_cannot_be_compiled(skills, error, message):
    with pytest.raises(error, match=message):
        SkillProgram(skills)


def test_what_cannot_be_run():
    program = SkillProgram({"push": ["place the gripper above the puck"]})
    with pytest.raises(ValueError, match="task_id names tasks without skills: assembly"):
        program(torch.zeros(2, 39), torch.tensor([lw.task_id("push"), 0]))
    with pytest.raises(ValueError, match="task_id names tasks without skills: 50"):
        program(torch.zeros(1, 39), torch.tensor([50]))
    with pytest.raises(ValueError, match="observation must be of shape"):
        program(torch.zeros(2, 38), torch.zeros(2, dtype=torch.int64))
