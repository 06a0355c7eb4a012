"""The scripted skills: the shipped table, files of one's own, and the nearest to a text."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.language.nearest import nearest_skill
from lw_torchrl.language.objects import GRIPPER
from lw_torchrl.language.skills import SkillError, load_skills, skills_for


def written(tmp_path, text):
    path = tmp_path / "skills.toml"
    path.write_text(text, "utf-8")
    return path


def test_shipped_skills_are_plain_english_and_each_suits_a_task():
    skills = load_skills()
    assert len(skills) >= 80
    assert list(skills) == sorted(skills)
    for text, skill in skills.items():
        assert skill.text == text
        assert text[0].islower()
        assert not text.endswith(".")
        assert any(skill.suits(task) for task in lw.MT50), text
        for task in skill.variants:
            assert skill.for_task(task).text.startswith(text.split()[0])


def test_no_shipped_skill_is_idle():
    used = set(lw.load_plans("MT50").skills)
    assert set(load_skills()) == used


def test_a_variant_changes_only_what_it_says():
    skill = load_skills()["lower the gripper beside the window handle"]
    here, there = skill.for_task("window-open"), skill.for_task("window-close")
    assert here.offset[0] == -there.offset[0]
    assert (here.gain, here.gripper, here.target) == (there.gain, there.gripper, there.target)


def test_a_file_of_ones_own_joins_and_replaces(tmp_path):
    path = written(
        tmp_path,
        '["wave the gripper"]\ntarget = "robot\'s gripper"\noffset = [0.1, 0, 0]\ngain = [1, 0, 0]\n'
        '["place the gripper above the puck"]\ntarget = "puck"\ngripper = -0.5\n',
    )
    skills = load_skills(path)
    assert skills["wave the gripper"].gain == (1, 0, 0)
    assert skills["wave the gripper"].target == GRIPPER
    assert skills["place the gripper above the puck"].gripper == -0.5
    assert load_skills()["place the gripper above the puck"].gripper == -1.0
    assert len(skills) == len(load_skills()) + 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[a", "skills.toml"),
        ('["push it"]\ngripper = 1.0\n', "'push it' must name a target"),
        ('["push it"]\ntarget = "puck"\ngriper = 1.0\n', "did you mean 'gripper'"),
        ('["push it"]\ntarget = "puck"\ngripper = 2.0\n', r"gripper of skill 'push it' must lie in \[-1, 1\], got 2.0"),
        ('["push it"]\ntarget = "puck"\noffset = [0, 1]\n', "offset of skill 'push it' must be three numbers"),
        ('["push it"]\ntarget = "puck"\ngain = -1\n', "gain of skill 'push it' must not be negative"),
        ('["push it"]\ntarget = "puck"\ngain = "much"\n', "gain of skill 'push it' must be three numbers"),
        ('["push it"]\ntarget = "puck"\noffset = [0, 0, inf]\n', "offset of skill 'push it' must be three numbers"),
        ('["push it".for.pusch]\ntarget = "puck"\n', "did you mean 'push'"),
        ('"push it" = 3\n', "skill 'push it' must be a table, got 3"),
        ('["push it"]\ntarget = "puck"\nfor = 3\n', "for of skill 'push it' must map"),
        ('["push it"]\ntarget = 3\n', "target of skill 'push it' must be the name of an object"),
    ],
)
def test_a_faulty_file_is_refused(tmp_path, text, message):
    with pytest.raises(SkillError, match=message):
        load_skills(written(tmp_path, text))


def test_a_skill_for_objects_that_a_task_lacks():
    with pytest.raises(SkillError, match=r"needs 'puck', which task 'drawer-open' lacks; it has .*drawer handle"):
        load_skills()["place the gripper above the puck"].for_task("drawer-open")


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


def test_nearest_skill_wants_words():
    with pytest.raises(TypeError, match=r"text must be a string, got 3 \(int\)"):
        nearest_skill(3)
    with pytest.raises(SkillError, match="no scripted skill suits task 'push'"):
        nearest_skill("push", "push", {})


def test_a_task_can_use_the_skills_of_its_shipped_plan():
    """Also those whose texts say "front" or "hole", which are things of other tasks."""
    for name, plan in lw.load_plans("MT50").items():
        assert {step.skill for step in plan.steps} <= set(skills_for(lw.TASKS[name])), name
    assert "place the gripper above the wrench" not in skills_for(lw.TASKS["push"])
    assert "lower the puck into the hole" not in skills_for(lw.TASKS["push"])
