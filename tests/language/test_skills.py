"""Scripted skills: the shipped table, custom files, the nearest to a text, and the batched controller."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.skill_program import SkillProgram
from lw_torchrl.language.skills import SkillError, load_skills, skills_for


def written(tmp_path, text):
    path = tmp_path / "skills.toml"
    path.write_text(text, "utf-8")
    return path


def test_shipped_skills_are_plain_english_and_each_suits_a_task():
    skills = load_skills()
    assert list(skills) == sorted(skills)
    assert set(skills) == set(lw.load_plans("MT50").skills), "every skill is used"
    for text, skill in skills.items():
        assert skill.text == text
        assert text[0].islower()
        assert not text.endswith(".")
        assert any(skill.suits(task) for task in lw.MT50), text
        for task in skill.variants:
            assert skill.for_task(task).text.startswith(text.split()[0])


def test_a_variant_changes_only_what_it_says():
    skill = load_skills()["lower the gripper beside the window handle"]
    here, there = skill.for_task("window-open"), skill.for_task("window-close")
    assert here.offset[0] == -there.offset[0]
    assert (here.gain, here.gripper, here.target) == (there.gain, there.gripper, there.target)


def test_a_custom_file_adds_and_replaces_skills(tmp_path):
    path = written(
        tmp_path,
        '["wave the gripper"]\ntarget = "robot\'s gripper"\noffset = [0.1, 0, 0]\ngain = [1, 0, 0]\n'
        '["place the gripper above the puck"]\ntarget = "puck"\ngripper = -0.5\ngoal = "the gripper is open"\n',
    )
    skills = load_skills(path)
    assert (skills["wave the gripper"].gain, skills["wave the gripper"].target) == ((1, 0, 0), GRIPPER)
    replaced = skills["place the gripper above the puck"]
    assert (replaced.gripper, replaced.goal) == (-0.5, "the gripper is open")
    assert load_skills()["place the gripper above the puck"].gripper == -1.0
    assert len(skills) == len(load_skills()) + 1


PUSH = '["push it"]\ntarget = "puck"\n'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a", "skills.toml"),
        ('["push it"]\ngripper = 1.0\n', "'push it': the skill must have target"),
        (PUSH + "griper = 1.0", "did you mean 'gripper'"),
        (PUSH + "gripper = 2.0", "'push it': gripper .* 2.0"),
        (PUSH + "for = 3", "'push it': 'for'"),
        (PUSH + 'for.pusch.target = "puck"', "did you mean 'push'"),
        ('"push it" = 3\n', "'push it': .*table, got 3"),
        ('["push it"]\ntarget = 3\n', "'push it': target"),
        *((PUSH + f"offset = {wrong}", "'push it': offset") for wrong in ("[0, 1]", "[0, 0, inf]", "3")),
        *((PUSH + f"gain = {wrong}", "'push it': gain") for wrong in ("-1", '"much"')),
    ],
)
def test_a_faulty_file_is_refused(tmp_path, text, message):
    with pytest.raises(SkillError, match=message):
        load_skills(written(tmp_path, text))


@pytest.mark.parametrize(
    ("text", "task", "expected"),
    [
        ("place the gripper above the puck", None, "place the gripper above the puck"),
        ("Place_the gripper   above the PUCK", "push", "place the gripper above the puck"),
        ("put gripper above puck", "push", "place the gripper above the puck"),
        ("pull drawer handle toward robot", "drawer-open", "pull the drawer handle toward the robot"),
    ],
)
def test_nearest_skill(text, task, expected):
    skill, score = nearest_skill(text, task)
    assert skill.text == expected
    assert (score == 1.0) == (text.lower().replace("_", " ").split() == expected.split())


@given(st.text(max_size=80), st.sampled_from(lw.MT50))
def test_any_text_has_a_nearest_skill_that_the_task_can_use(text, task):
    skill, score = nearest_skill(text, task)
    assert skill.suits(task)
    assert 0.0 <= score <= 1.0
    with pytest.raises(SkillError, match=f"'{task}'"):
        nearest_skill(text, task, {})


def test_a_task_can_use_the_skills_of_its_shipped_plan():
    # Also those with "front" or "hole" in their texts, which are objects of other tasks.
    for name, plan in lw.load_plans("MT50").items():
        assert {step.skill for step in plan.steps} <= set(skills_for(lw.TASKS[name])), name
    assert "place the gripper above the wrench" not in skills_for(lw.TASKS["push"])
    assert "lower the puck into the hole" not in skills_for(lw.TASKS["push"])


# ---- SkillProgram

PLANS = lw.load_plans("MT50")
PROGRAM = SkillProgram({task: [step.skill for step in plan.steps] for task, plan in PLANS.items()})


def by_hand(skill, task, observation):
    """Return the action of one skill in one state, by its definition."""
    scripted = lw.load_skills()[skill].for_task(task)
    places = {name: p.double().numpy() for name, p in lw.TASKS[task].positions(observation.double()).items()}
    error = places[scripted.target] + np.array(scripted.offset) - places[scripted.moved]
    return [*np.clip(np.array(scripted.gain) * error, -1, 1), scripted.gripper]


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
    state, ids = torch.rand(2, 3, 39), torch.randint(50, (2, 3))
    actions = PROGRAM(state, ids)
    assert (actions.shape, actions.dtype) == ((2, 3, PLANS.num_steps, 4), torch.float32)
    assert torch.equal(PROGRAM(state[0, 1], ids[0, 1]), actions[0, 1])


@pytest.mark.parametrize(
    ("skills", "message"),
    [
        ({"push": ["place the griper above the puck"]}, "did you mean 'place the gripper above the puck'"),
        ({"reach": ["place the gripper above the puck"]}, "'puck', which task 'reach' lacks"),
        ({}, "skills"),
        ({"push": []}, "'push'"),
    ],
)
def test_a_program_of_faulty_skills_is_refused(skills, message):
    with pytest.raises(ValueError, match=message):
        SkillProgram(skills)


@pytest.mark.parametrize(("size", "task", "message"), [(39, 0, "assembly"), (39, 50, "50"), (38, 37, "observation")])
def test_a_wrong_batch_is_refused(size, task, message):
    program = SkillProgram({"push": ["place the gripper above the puck"]})
    with pytest.raises(ValueError, match=message):
        program(torch.zeros(1, size), torch.tensor([task]))
