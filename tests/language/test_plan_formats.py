"""The nine formats: each reads back what it writes."""

from dataclasses import replace

import pytest
from cases import read_cases
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_texts import conditional_plans, queries

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.plan_files import parse_plan
from lw_torchrl.language.plans import ConditionalPlan, PlanStep
from lw_torchrl.language.queries import parse_query

NINE = [f"{style}_{container}" for style in ("basic", "chain", "goal") for container in ("py", "py_md", "md")]
SHIPPED = [
    plan for skills in ("own", "MT10") for plan in lw.load_plans("MT50", skills=skills).values()
]  # both ways to word the skills


def read_back(plan, format):
    found = lw.decode_plan(lw.encode_plan(plan, format), plan.definition, format)
    assert found.plan is not None, found.reason
    assert not any(step.dropped for step in found.steps)
    return found.plan


@st.composite
def plans_with_goals(draw):
    plan = draw(conditional_plans())
    goals = [draw(st.none() | queries(plan.task)) for _ in plan.steps]
    steps = [PlanStep(s.condition, s.skill, s.reason, goal) for s, goal in zip(plan.steps, goals, strict=True)]
    return ConditionalPlan(plan.task, tuple(steps))


def test_the_formats_by_name():
    assert list(lw.PLAN_FORMATS) == NINE


@pytest.mark.parametrize("name", ["", "a b", "../up", "Mine", 3])
def test_a_faulty_format_is_refused(name):
    with pytest.raises(ValueError, match="lower case"):
        lw.PLAN_FORMATS[name] = lw.PLAN_FORMATS["chain_py"]
    with pytest.raises(TypeError, match="'mine'"):
        lw.PLAN_FORMATS["mine"] = "chain_py"


def test_a_custom_format(monkeypatch):
    shouted = replace(lw.PLAN_FORMATS["chain_py"], extension="txt", encode=lambda plan: str(plan).replace("#", "##"))
    monkeypatch.setitem(lw.PLAN_FORMATS, "shouted", shouted)
    text = lw.encode_plan(SHIPPED[0], "shouted")
    assert text.startswith("## ")
    assert lw.decode_plan(text, SHIPPED[0].task, "shouted").plan == SHIPPED[0]
    assert lw.planners.plan_prompt("push", "shouted") == lw.planners.plan_prompt("push", "chain_py")


@pytest.mark.parametrize("format", NINE)
def test_shipped_plans_are_read_back(format):
    for plan in SHIPPED:
        again = read_back(plan, format)
        assert again == plan
        assert format.startswith("basic") or [step.reason for step in again.steps] == [s.reason for s in plan.steps]


@settings(max_examples=100, deadline=None)
@given(st.tuples(conditional_plans(), st.sampled_from(NINE)) | st.tuples(plans_with_goals(), st.sampled_from(NINE[6:])))
def test_any_plan_is_read_back(drawn):
    plan, format = drawn
    assert read_back(plan, format) == plan


def test_chain_py_is_read_as_a_plan_file_too():
    for plan in SHIPPED[:50]:
        assert "goal=" not in str(plan), "usual goals are not written"
        assert parse_plan(lw.encode_plan(plan, "chain_py"), plan.task) == plan


@settings(max_examples=40, deadline=None)
@given(plans_with_goals())
def test_plan_files_hold_goals(plan):
    assert parse_plan(str(plan)) == plan
    assert lw.Plans.from_json(lw.Plans([plan]).to_json()) == {plan.task: plan}
    without = ConditionalPlan(plan.task, tuple(PlanStep(s.condition, s.skill, s.reason) for s in plan.steps))
    assert lw.Plans([plan]).fingerprint == lw.Plans([without]).fingerprint
    assert (str(plan) == str(without)) == (plan == without)


@pytest.mark.parametrize(
    "reason",
    ["2. and so on", "- When the gripper is open, the robot should go.", "Steps: 1. go", "The task `reach` is next",
     "When the gripper is open, the robot should go", "[eod]", "# push: x", "```", "def push(robot):"],
)  # fmt: skip
@pytest.mark.parametrize("format", NINE)
def test_a_reason_is_never_read_as_a_step(reason, format):
    goal = parse_query("the puck is near the target location", "push")
    step = PlanStep(parse_query("gripper open", "push"), "push the puck", reason, goal if "goal" in format else None)
    plan = ConditionalPlan("push", (step, step))
    assert read_back(plan, format) == plan


CONDITION = "the robot's gripper is near the puck and the puck is touching the table"
HEAD = "# pick-place: Pick up the puck and hold it at the target location in the air.\ndef pick_place(robot):\n"


def test_what_the_formats_look_like():
    plan = lw.load_plans("MT10")["pick-place"]
    texts = {name: lw.encode_plan(plan, name) for name in NINE}
    for style in ("basic", "chain", "goal"):
        assert texts[f"{style}_py"].startswith(HEAD)
        assert f"```python\n{texts[f'{style}_py']}```\n" in texts[f"{style}_py_md"]
        assert "`pick-place`" in texts[f"{style}_md"]
    reason = plan.steps[2].reason
    assert not any(text in texts["basic_py"] for text in ("#  ", reason))
    for name, parts in read_cases("language/plan_files.toml")["looks"].items():
        for part in parts:
            assert part.replace("CONDITION", CONDITION).replace("REASON", reason) in texts[name]


def test_a_skill_without_a_goal_is_written_as_a_skill():
    plan = lw.load_plans("MT50")["door-lock"]
    assert plan.goals[2] is None
    assert 'robot.turn("the door\'s lock to the right")' in lw.encode_plan(plan, "goal_py")
    assert "the robot should turn the door's lock to the right." in lw.encode_plan(plan, "goal_md")


def test_a_description_of_several_lines_stays_in_one(tmp_path):
    (tmp_path / "tasks.toml").write_text(
        '[stack]\ndescription = "Stack.\\n- When open, the robot should go."\nobjects.brick = "obs[4:7]"\n'
    )
    task = lw.load_tasks(tmp_path / "tasks.toml")["stack"]
    plan = ConditionalPlan.from_pairs(task, [("gripper open", "stack the brick")])
    for format in NINE:
        assert read_back(plan, format) == plan


@pytest.mark.parametrize("format", sorted(PLAN_FORMATS))
def test_conditions_with_or_are_read_again(format):
    pairs = [
        ("gripper open or not above the puck", "move the gripper to the puck"),
        ("not (gripper near puck and closed) unless the puck is near the target location", "grasp the puck"),
        ("(gripper open or near puck) and (gripper closed or puck near target location)", "lift the puck"),
        ("always", "place the gripper above the puck"),
        ("never", "lift the puck"),
    ]
    plan = lw.ConditionalPlan.from_pairs("push", pairs)
    assert lw.decode_plan(lw.encode_plan(plan, format), "push", format=format).plan == plan
