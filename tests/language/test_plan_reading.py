"""The text of a plan: read line by line, faults named by their lines, nothing executed."""

from time import thread_time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_texts import DRAWER, HEAD, plan

from lw_torchrl.language import plan_text
from lw_torchrl.language.plan_files import load_plans
from lw_torchrl.language.plan_text import MOST_STEPS, PLAN_LIMIT
from lw_torchrl.language.plans import ConditionalPlan, PlanError, check_plan, parse_plan
from lw_torchrl.language.queries import check_query


def test_a_plan_is_read_line_by_line():
    found = parse_plan(DRAWER)
    assert found.task == "drawer-open"
    assert [str(step.condition) for step in found.steps] == [
        "the robot's gripper is not vertically aligned with the drawer handle",
        "the robot's gripper is open and the robot's gripper is above the drawer handle",
        "the robot's gripper is closed",
    ]
    assert [step.skill for step in found.steps] == [
        "place the gripper above the drawer handle",
        "lower the gripper around the drawer handle",
        "pull back",
    ]
    assert [step.reason for step in found.steps] == [
        "The gripper has to come from above.",
        "Down, then hold on. Both in one.",
        "",
    ]
    assert parse_plan(DRAWER, "drawer-open") == found


@pytest.mark.parametrize("end", ["\r\n", "\n\n", "   \n"])
def test_line_ends_and_blank_lines_play_no_part(end):
    assert parse_plan(DRAWER.replace("\n", end)) == parse_plan(DRAWER)


def test_indentation_and_spaces_play_no_part():
    text = 'def  push ( robot ) :\nif check ( "the gripper is open" ) :\n\trobot.push ( "puck" )'
    assert parse_plan(text).steps == plan().steps


@pytest.mark.parametrize(
    ("task", "written", "skill"),
    [
        ("push", 'robot.place("gripper above puck")', "place the gripper above the puck"),  # the paper's example
        ("push", 'robot.place("the gripper above the puck")', "place the gripper above the puck"),
        ("push", 'robot.place("the robot\'s gripper above the  puck")', "place the robot's gripper above the puck"),
        ("push", 'robot.move("its gripper to an open pose")', "move its gripper to an open pose"),
        ("push", 'robot.slide("puck to target location")', "slide the puck to the target location"),
        ("push", 'robot.move("puckish things")', "move puckish things"),
        ("push", 'robot.let_go("puck")', "let go the puck"),
        ("push", 'robot.place_gripper("above puck")', "place the gripper above the puck"),
        ("push", "robot.wait()", "wait"),
        ("door-lock", 'robot.turn("door\'s lock")', "turn the door's lock"),
        ("window-open", "robot.push('window handle')", "push the window handle"),
        ("drawer-open", 'robot.pull("drawer handle")', "pull the drawer handle"),
        # No article in the middle of a longer noun.
        ("coffee-push", 'robot.grab("the coffee mug")', "grab the coffee mug"),
        ("coffee-push", 'robot.grab("the white coffee mug")', "grab the white coffee mug"),
        ("box-close", 'robot.put("gripper above box lid")', "put the gripper above the box lid"),
        ("soccer", 'robot.move("the soccer ball to goal")', "move the soccer ball to the goal"),
    ],
)
def test_articles_go_before_the_nouns_that_lack_one(task, written, skill):
    text = f"def {task.replace('-', '_')}(robot):\n  if check('gripper open'):\n    {written}\n"
    assert parse_plan(text).steps[0].skill == skill
    assert plan(task, ("gripper open", skill)).steps[0].skill == skill


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("", None, "no plan found"),
        ("# only a comment\n\n", None, "no plan found"),
        ("def push(robot):\n", None, "at least one step"),
        ('if check("the gripper is open"):\n    robot.push("puck")\n', 1, "def task_name(robot):"),
        ("Sure, here is a plan:\n" + HEAD, 1, "def task_name(robot):"),
        (HEAD.replace("push(robot)", "pusch(robot)"), 1, "did you mean 'push'?"),
        (HEAD.replace("push(robot)", "zzzzzzzz(robot)"), 1, "not a task"),
        (HEAD.replace("push(robot)", "push()"), 1, "def task_name(robot):"),
        (HEAD + HEAD, 4, "second plan"),
        (HEAD + "    robot.push('puck')\n", 4, "the skill has no condition"),
        (HEAD + "    if check('gripper closed'):\n", None, "the last condition has no skill"),
        (HEAD + "    if check('gripper closed'):\n    if check('gripper open'):\n", 5, "has no skill"),
        (HEAD + "    if check('the gripper is happy'):\n        robot.push('puck')\n", 4, "nearest query"),
        (HEAD + "    if check('gripper above drawer handle'):\n        robot.push('puck')\n", 4, "'drawer'"),
        (HEAD + "    if check(''):\n        robot.push('puck')\n", 4, "a condition"),
        (HEAD + "    else:\n        robot.push('puck')\n", 4, "'else:'"),
        (HEAD + "    while True:\n", 4, "'while True:'"),
        (HEAD + "    if check(gripper_open):\n", 4, "if check"),
        (HEAD + "    if check('gripper open') and True:\n", 4, "if check"),
        (HEAD + "    if check('gripper open'): robot.push('puck')\n", 4, "if check"),
        (HEAD + "    if check('gripper open\"):\n", 4, "if check"),
        (HEAD + "    if check('gripper open'):\n        robot.push('puck', 3)\n", 5, "robot.verb"),
        (HEAD + "    if check('gripper open'):\n        robot._push('puck')\n", 5, "robot.verb"),
        (HEAD + "    if check('gripper open'):\n        human.push('puck')\n", 5, "robot.verb"),
        (HEAD + "    if check('gripper open'):\n        robot.push('puck').pull('puck')\n", 5, "robot.verb"),
        (HEAD + "    return\n", 4, "'return'"),
    ],
)
def test_an_error_names_the_source_and_the_line(text, line, says):
    with pytest.raises(PlanError) as caught:
        parse_plan(text, source="my.plan")
    message = str(caught.value)
    assert isinstance(caught.value, ValueError)
    assert says in message
    if line is not None:
        assert message.startswith(f"my.plan, line {line}: ")
    elif says != "at least one step":
        assert message.startswith("my.plan: ")


def test_a_plan_for_another_task_is_refused():
    with pytest.raises(PlanError, match=r"line 2: this is a plan for 'drawer-open', expected one for 'push'"):
        parse_plan(DRAWER, "push")


def test_a_text_is_never_executed(tmp_path):
    mark = tmp_path / "executed"
    attack = f"__import__('pathlib').Path({str(mark)!r}).touch()"
    for text in (
        attack,
        f"def push(robot):\n    {attack}\n",
        f"def push(robot={attack}):\n    pass\n",
        f"{HEAD}    if check({attack}):\n        robot.push('puck')\n",
        f'{HEAD}    if check(f"{{{attack}}}"):\n        robot.push("puck")\n',
        f'{HEAD}    if check("gripper open" + {attack}):\n        robot.push("puck")\n',
        f'{HEAD}    if check("gripper open"):\n        robot.push({attack})\n',
        f'{HEAD}    if check("gripper open"):\n        robot.push("puck") or {attack}\n',
        f'{HEAD}    if check("gripper open"):\n        robot.push("puck"); {attack}\n',
        f'{HEAD}    if check("gripper open"):\n        {attack}\n',
        f"@{attack}\n{HEAD}",
        f"# -*- coding: x -*-\nimport os\n{HEAD}",
    ):
        with pytest.raises(PlanError):
            parse_plan(text)
        (tmp_path / "push.plan").write_text(text, "utf-8")
        with pytest.raises(PlanError):
            load_plans(tmp_path)
    # In quotes it is a skill like any other, and stays words.
    quoted = plan("push", ("gripper open", f"push {attack}"))
    assert parse_plan(str(quoted)) == quoted
    assert not mark.exists()


plan_lines = st.lists(
    st.sampled_from(
        [
            *DRAWER.splitlines(),
            *HEAD.splitlines(),
            "",
            "else:",
            "robot.x(",
            "if check(",
            "\ufeff",
            '"',
            "\\",
            "robot.a()",
        ]
    )
    | st.text(max_size=40),
    max_size=12,
).map("\n".join)


@settings(max_examples=120, deadline=None)
@given(plan_lines | st.text(st.characters()))
def test_any_text_is_a_plan_or_a_plan_error(text):
    try:
        found = parse_plan(text)
    except PlanError:
        return
    assert parse_plan(str(found)) == found


def test_all_faults_come_in_one_pass(monkeypatch):
    asked = []
    monkeypatch.setattr(plan_text, "check_query", lambda text, task: asked.append(text) or check_query(text, task))
    step = "    if check('the gripper is {} the pluck'):\n        robot.wait()\n"
    found, faults = check_plan("def push(robot):\n" + "".join(step.format("near") for _ in range(50)), source="my.plan")
    assert found is None
    assert [fault.split(":")[0] for fault in faults] == [f"my.plan, line {2 * k}" for k in range(1, 51)]
    assert len(asked) == 50
    assert check_plan(DRAWER) == (parse_plan(DRAWER), [])


def test_every_kind_of_fault_is_told_once_and_the_sound_steps_are_read_on():
    text = """nonsense
def push(robot):
    robot.place("first")
    if check("gripper is open"):
    if check("gripper is closed"):
        robot.place("the puck")
    if chek("gripper is open"):
        robot.place("the puck")
    import os
    if check("gripper flies"):
"""
    assert [fault.split(":")[0] for fault in check_plan(text)[1]] == [f"plan, line {k}" for k in (1, 3, 5, 7, 9, 10)]
    assert "the last condition has no skill" in check_plan("def push(robot):\n if check('gripper is open'):")[1][0]
    for stops in ("def push(robot):\ndef push(robot):\nnonsense", "def pushh(robot):\nnonsense"):
        assert len(check_plan(stops)[1]) == 1
    with pytest.raises(PlanError) as caught:
        parse_plan(text)
    assert str(caught.value) == check_plan(text)[1][0]


def asking(steps):
    return "def push(robot):\n" + 'if check("gripper is open"):\nrobot.push("the puck")\n' * steps


def test_a_plan_has_at_most_a_thousand_steps_and_its_text_an_end():
    assert len(parse_plan(asking(MOST_STEPS)).steps) == MOST_STEPS
    assert check_plan(asking(20_000), source="my.plan") == (None, ["my.plan must have at most 1000 steps, got 20000"])
    with pytest.raises(PlanError, match=f"plan: a plan's text must have at most {PLAN_LIMIT} characters, got {10**7}"):
        parse_plan("#" * 10**7)
    pairs = [("gripper is open", "push the puck")]
    with pytest.raises(PlanError, match="plan of task 'push' must have at most 1000 steps, got 1001"):
        ConditionalPlan.from_pairs("push", pairs * 1001)
    with pytest.raises(PlanError, match="plan of task 'push' must have at most 1000 steps, got 1001"):
        ConditionalPlan("push", plan().steps * 1001)


@pytest.mark.usefixtures("in_time")
@pytest.mark.parametrize(
    "line",
    ["robot.place(" + " " * 10**5, 'robot.place("a"' + " " * 10**5 + "x", "if check(" + " " * 10**5, "\n" * 10**5],
    ids=["skill", "goal", "condition", "lines"],
)
def test_a_line_takes_no_more_time_than_its_length(line):
    start = thread_time()
    assert check_plan(f"def push(robot):\n{line}")[0] is None
    assert thread_time() - start < 1.0
