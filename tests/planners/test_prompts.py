"""Prompts: three other tasks' plans, then the task; never its own plan, and not too long."""

import math

import pytest
from rapidfuzz.distance import Levenshtein

import lw_torchrl as lw
from lw_torchrl.planners import prompt_examples

MOST_TOKENS = 2_200  # a token for every three characters
PLANS = {skills: lw.load_plans("MT50", skills=skills) for skills in ("own", "MT10")}


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_a_prompt_is_short_and_lacks_the_task_s_own_plan(format):
    for number, task in enumerate(lw.MT50):
        vocabulary = number % 2 == 0
        prompt = lw.planners.plan_prompt(task, format, vocabulary=vocabulary)
        assert math.ceil(len(lw.planners.plan_prompt(task, format, vocabulary=True)) / 3) <= MOST_TOKENS
        assert lw.decode_plan(prompt, task, format).plan is None
        assert all(lw.encode_plan(plans[task], format) not in prompt for plans in PLANS.values())
        name = task if format.endswith("_md") and not format.endswith("py_md") else task.replace("-", "_")
        assert lw.TASKS[task].description in prompt[prompt.rindex(name) - 300 :]
        assert ("almost vertically aligned with, mostly below" in prompt) == vocabulary


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_a_prompt_contains_the_plans_of_its_examples(format):
    for task in ("pick-place", "stick-pull", "handle-press-side"):
        for example in prompt_examples(task):
            assert lw.decode_plan(lw.planners.plan_prompt(task, format), example.task, format).plan == example


@pytest.mark.parametrize("format", lw.PLAN_FORMATS)
def test_a_continuation_of_a_prompt_is_an_answer(format):
    """A model that completes texts answers with the rest of the plan, without its first lines."""
    plan = PLANS["own"]["drawer-open"]
    whole = lw.encode_plan(plan, format)
    start = whole.index("    if") if "py" in format else whole.index("- When")
    assert lw.decode_plan(whole[start:], "drawer-open", format).plan.steps[0].condition == plan.steps[0].condition
    if not format.endswith("py_md"):
        answer = lw.planners.plan_prompt("drawer-open", format) + whole[start:]
        assert lw.decode_plan(answer, "drawer-open", format).plan


def test_the_examples_are_pick_place_and_the_nearest_two():
    for task in lw.MT50:
        examples = [plan.task for plan in prompt_examples(task)]
        others = set(lw.MT10) - {task, "pick-place"}

        def far(name, task=task):
            return Levenshtein.distance(lw.TASKS[name].description, lw.TASKS[task].description)

        nearest = examples if task == "pick-place" else examples[1:]
        assert task == "pick-place" or examples[0] == "pick-place"
        assert len(set(examples)) == 3
        assert set(examples) <= set(lw.MT10) - {task}
        assert max(map(far, nearest)) <= min(far(name) for name in others - set(nearest))
        assert [far(name) for name in nearest] == sorted(map(far, nearest), reverse=True)


def test_the_task_comes_last_in_the_format():
    head = "# drawer-open: Take hold of the drawer handle and pull the drawer open.\ndef drawer_open(robot):\n"
    assert lw.planners.plan_prompt("drawer-open", "chain_py").endswith("\n\n" + head)
    assert lw.planners.plan_prompt("drawer-open", "chain_py_md").endswith(f"```python\n{head}```\n")
    last = lw.planners.plan_prompt("drawer-open", "chain_md").splitlines()[-2]
    assert last == "The task `drawer-open`: Take hold of the drawer handle and pull the drawer open."


def test_custom_plans_and_tasks():
    tasks = {"stack": lw.Task.from_json("stack", {"description": "Stack it.", "objects": {"brick": "obs[4:7]"}})}
    mine = lw.Plans([PLANS["own"]["hammer"]])
    prompt = lw.planners.plan_prompt("stack", "basic_py", plans=mine, tasks=tasks, vocabulary=True)
    assert "def hammer(robot):" in prompt
    assert "# The things in stack are: the robot's gripper, the brick." in prompt
    assert prompt.endswith("# stack: Stack it.\ndef stack(robot):\n")
    with pytest.raises(ValueError, match=r"plans .*'hammer'"):
        lw.planners.plan_prompt("hammer", "basic_py", plans=mine)
