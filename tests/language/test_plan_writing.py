"""The text of a plan: one for each plan, which reads back as the same."""

from hypothesis import given, settings
from plan_texts import conditional_plans, plan

from lw_torchrl.language.plans import ConditionalPlan, PlanStep, parse_plan
from lw_torchrl.language.queries import parse_query
from lw_torchrl.language.tasks import TASKS, Task


@settings(max_examples=120, deadline=None)
@given(conditional_plans())
def test_the_text_of_a_plan_reads_back_as_the_same_plan(given):
    text = str(given)
    found = parse_plan(text, given.task)
    assert found == given
    assert [step.skill for step in found.steps] == [step.skill for step in given.steps]
    assert str(found) == text
    assert str(given) == text


def test_reasons_are_kept_and_cannot_add_lines():
    reason = "because\n    if check('gripper closed'):\n        robot.fling('the puck')\u2028x"
    given = ConditionalPlan("push", (PlanStep(parse_query("gripper open", "push"), "push the puck", reason),))
    found = parse_plan(str(given))
    assert found == given
    assert found.steps[0].reason == " ".join(reason.split())


def test_the_text_names_the_task_and_its_description():
    assert str(plan()) == (
        f"# push: {TASKS['push'].description}\n"
        "def push(robot):\n"
        '    if check("the robot\'s gripper is open"):\n'
        '        robot.push("the puck")\n'
    )


def test_the_text_of_a_plan_is_python_too():
    # People's editors colour and indent it as Python.
    compile(str(plan("push", ("gripper open", "say \"a\" \\ 'b' 手"))), "push.plan", "exec")


def test_a_description_of_several_lines_writes_no_second_plan():
    lines = Task("push", "Push.\ndef reach(robot):\u2028import os", TASKS["push"].objects)
    written = ConditionalPlan("push", ConditionalPlan.from_pairs("push", [("gripper open", "wait")]).steps, lines)
    assert str(written).splitlines()[0] == "# push: Push. def reach(robot): import os"
    assert parse_plan(str(written), tasks={"push": lines}) == written
