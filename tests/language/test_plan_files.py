"""JSON files of pairs as language models wrote them; folders of .plan files are tested in test_plan_folders.py."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lw_torchrl.language.nearest import nearest_query
from lw_torchrl.language.plan_files import load_plans, save_plans
from lw_torchrl.language.plans import PlanError
from lw_torchrl.language.tasks import MT50

PAIRS = {
    "push": [
        ["the robot's gripper is not above the puck", "put gripper above puck"],
        ["the gripper isn't touching the puck", "let_go the puck"],
    ],
    "reach": [["the robot's gripper is open", "move gripper to target location"]],
}


@pytest.fixture
def write(tmp_path):
    def written(value):
        path = tmp_path / "plans.json"
        path.write_text(value if isinstance(value, str) else json.dumps(value))
        return path

    return written


@pytest.mark.parametrize("value", [PAIRS, {"what": "written by a model", "plans": PAIRS}])
def test_pairs_become_plans(write, value):
    plans = load_plans(write(value))
    assert list(plans) == ["push", "reach"]
    first, second = plans["push"].steps
    assert (str(first.condition), first.skill) == (
        "the robot's gripper is not above the puck",
        "put the gripper above the puck",
    )
    assert first.reason == ""
    assert str(second.condition) == "the robot's gripper is not around the puck"
    assert second.reason == "nearest to: the gripper isn't touching the puck"
    assert second.skill == "let go the puck"


def test_they_are_the_same_when_saved_as_plan_files(write, tmp_path):
    plans = load_plans(write(PAIRS))
    save_plans(plans, tmp_path / "folder")
    again = load_plans(tmp_path / "folder")
    assert again == plans
    assert again["push"].steps[1].reason == plans["push"].steps[1].reason


@given(condition=st.text(max_size=60), skill=st.from_regex(r"[a-z]{1,8}( [a-z]{1,8}){0,3}", fullmatch=True))
def test_any_condition_becomes_the_nearest_query(tmp_path_factory, condition, skill):
    path = tmp_path_factory.mktemp("any") / "plans.json"
    path.write_text(json.dumps({"push": [[condition, skill]]}))
    (step,) = load_plans(path)["push"].steps
    assert step.condition == nearest_query(condition, "push").query


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("{", "expected JSON"),
        ("[" * 100_000, "nested too deeply"),
        ([], "task names with lists of pairs: it must be an object, got list"),
        ({"plans": 3}, "expected task names with lists"),
        ({"pusch": []}, "'pusch' is not a task; did you mean 'push'"),
        ({"push": {}}, "push: expected a list of"),
        ({"push": [["gripper is open"]]}, "push, step 1: expected a condition and a skill, two strings"),
        ({"push": [["gripper is open", 3]]}, "push, step 1: expected a condition and a skill, two strings"),
        ({"push": [["gripper is open", "7"]]}, "skill must begin with a plain word"),
        ({"push": []}, "must have at least one step"),
        ({}, "at least one plan"),
        ("[" * 900 + "]" * 900, "it must be an object, got list"),
        ('{"push": ' + "[" * 900 + "]" * 900 + "}", "push, step 1: expected a condition"),
        ('{"push": [[' + "9" * 5000 + ", 3]]}", "expected JSON"),
        ('{"push": [["gripper is open", "wait"]], "push": [["gripper is closed", "wait"]]}', "'push' more than once"),
        ({"push": [["gripper is open", "wait"]] * 1001}, r"plans.json, push must have at most 1000 steps, got 1001"),
        (
            dict.fromkeys(("push", "reach", "door-open"), [["open", "wait"]] * 999),
            "at most 2000 pairs in all, got 2997",
        ),
        (" " * 2**18 + "{}", "must have at most 262144 bytes"),
        ({"push": [["open and " * 64 + "closed", "wait"]]}, "push, step 1: query .* must have at most 64 clauses"),
    ],
)
def test_what_is_no_plan_is_named(write, value, message):
    with pytest.raises(PlanError, match=message):
        load_plans(write(value))


def test_the_shipped_plans_have_no_rival_in_skills(write):
    with pytest.raises(ValueError, match="skills='MT10' is for the shipped plans"):
        load_plans(write(PAIRS), skills="MT10")
    assert set(load_plans("MT50", skills="MT10")) == set(MT50)
