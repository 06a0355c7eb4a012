"""Plans as text: parsed line by line, never executed, written so that they read back; .plan files and JSON of pairs."""

import json

import pytest
from cases import read_cases
from hypothesis import given, settings
from hypothesis import strategies as st
from plan_texts import DRAWER, HEAD, conditional_plans, plan
from speed import within

from lw_torchrl.language import plan_files
from lw_torchrl.language.nearest import LIMIT, nearest_query
from lw_torchrl.language.plan_files import PLAN_LIMIT, check_plan, load_plans, parse_plan, save_plans
from lw_torchrl.language.plans import ConditionalPlan, PlanError, Plans, PlanStep
from lw_torchrl.language.queries import check_query, parse_query
from lw_torchrl.language.tasks import MT50, TASKS, Task

CASES = read_cases("language/plan_files.toml")

# ---- parsing


def test_a_plan_is_parsed_line_by_line():
    parsed = parse_plan(DRAWER)
    assert parsed.task == "drawer-open"
    assert [(str(step.condition), step.skill, step.reason) for step in parsed.steps] == [
        (
            "the robot's gripper is not vertically aligned with the drawer handle",
            "place the gripper above the drawer handle",
            "The gripper has to come from above.",
        ),
        (
            "the robot's gripper is open and the robot's gripper is above the drawer handle",
            "lower the gripper around the drawer handle",
            "Down, then hold on. Both in one.",
        ),
        ("the robot's gripper is closed", "pull back", ""),
    ]
    assert parse_plan(DRAWER, "drawer-open") == parsed


@pytest.mark.parametrize("end", ["\r\n", "\n\n", "   \n"])
def test_line_ends_and_blank_lines_are_ignored(end):
    assert parse_plan(DRAWER.replace("\n", end)) == parse_plan(DRAWER)


def test_indentation_and_spaces_are_ignored():
    text = 'def  push ( robot ) :\nif check ( "the gripper is open" ) :\n\trobot.push ( "puck" )'
    assert parse_plan(text).steps == plan().steps


@pytest.mark.parametrize(("task", "written", "skill"), CASES["articles"])
def test_articles_are_added_to_nouns(task, written, skill):
    text = f"def {task.replace('-', '_')}(robot):\n  if check('gripper open'):\n    {written}\n"
    assert parse_plan(text).steps[0].skill == skill
    assert plan(task, ("gripper open", skill)).steps[0].skill == skill


OPEN = "    if check('gripper open'):\n"


@pytest.mark.parametrize(("text", "line", "part"), CASES["faults"])
def test_an_error_names_the_source_the_line_and_the_fault(text, line, part):
    with pytest.raises(PlanError) as caught:
        parse_plan(text.replace("{HEAD}", HEAD), source="my.plan")
    assert str(caught.value).startswith(f"my.plan, line {line}: " if line else "my.plan: ")
    assert part in str(caught.value)


def test_a_plan_for_another_task_is_refused():
    with pytest.raises(PlanError, match=r"line 2: .*'push'.*'drawer-open'"):
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
        f"{HEAD}{OPEN}        robot.push({attack})\n",
        f'{HEAD}{OPEN}        robot.push("puck") or {attack}\n',
        f'{HEAD}{OPEN}        robot.push("puck"); {attack}\n',
        f"{HEAD}{OPEN}        {attack}\n",
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


LINES = [*DRAWER.splitlines(), *HEAD.splitlines(), "", "else:", "robot.x(", "if check(", "\ufeff", '"', "\\"]
plan_lines = st.lists(st.sampled_from([*LINES, "robot.a()"]) | st.text(max_size=40), max_size=12).map("\n".join)


@settings(max_examples=120, deadline=None)
@given(plan_lines | st.text(st.characters()))
def test_any_text_is_a_plan_or_a_plan_error(text):
    try:
        parsed = parse_plan(text)
    except PlanError:
        return
    assert parse_plan(str(parsed)) == parsed


def test_all_faults_come_in_one_pass(monkeypatch):
    parsed = []
    monkeypatch.setattr(plan_files, "check_query", lambda text, task: parsed.append(text) or check_query(text, task))
    step = "    if check('the gripper is near the pluck'):\n        robot.wait()\n"
    result, faults = check_plan("def push(robot):\n" + step * 50, source="my.plan")
    assert result is None
    assert [fault.split(":")[0] for fault in faults] == [f"my.plan, line {2 * k}" for k in range(1, 51)]
    assert len(parsed) == 50
    assert check_plan(DRAWER) == (parse_plan(DRAWER), [])


def test_every_kind_of_fault_is_reported_once_and_reading_continues():
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
    for stops in ("def push(robot):\ndef push(robot):\nnonsense", "def pushh(robot):\nnonsense"):
        assert len(check_plan(stops)[1]) == 1


def test_steps_and_characters_are_limited():
    def text(steps):
        return "def push(robot):\n" + 'if check("gripper is open"):\nrobot.push("the puck")\n' * steps

    assert len(parse_plan(text(1_000)).steps) == 1_000
    assert "1000 steps" in check_plan(text(1_001))[1][0]
    with pytest.raises(PlanError, match=f"{PLAN_LIMIT} characters"):
        parse_plan("#" * 10**7)


@pytest.mark.usefixtures("in_time")
@pytest.mark.parametrize(
    "line",
    ["robot.place(" + " " * 10**5, 'robot.place("a"' + " " * 10**5 + "x", "if check(" + " " * 10**5, "\n" * 10**5],
    ids=["skill", "goal", "condition", "lines"],
)
def test_a_line_takes_no_more_time_than_its_length(line):
    with within(1):
        assert check_plan(f"def push(robot):\n{line}")[0] is None


# ---- writing


@settings(max_examples=120, deadline=None)
@given(conditional_plans())
def test_the_text_of_a_plan_reads_back_as_the_same_plan(drawn):
    text = str(drawn)
    parsed = parse_plan(text, drawn.task)
    assert parsed == drawn
    assert [step.skill for step in parsed.steps] == [step.skill for step in drawn.steps]
    assert str(parsed) == text


def test_reasons_are_kept_and_cannot_add_lines():
    reason = "because\n    if check('gripper closed'):\n        robot.fling('the puck')\u2028x"
    written = ConditionalPlan("push", (PlanStep(parse_query("gripper open", "push"), "push the puck", reason),))
    parsed = parse_plan(str(written))
    assert parsed == written
    assert parsed.steps[0].reason == " ".join(reason.split())


def test_the_text_names_the_task_and_its_description():
    assert str(plan()) == (
        f"# push: {TASKS['push'].description}\n"
        "def push(robot):\n"
        '    if check("the robot\'s gripper is open"):\n'
        '        robot.push("the puck")\n'
    )


def test_the_text_of_a_plan_is_valid_python():
    # Editors colour and indent it as Python.
    compile(str(plan("push", ("gripper open", "say \"a\" \\ 'b' 手"))), "push.plan", "exec")


def test_a_description_of_several_lines_cannot_add_a_plan():
    task = Task("push", "Push.\ndef reach(robot):\u2028import os", TASKS["push"].objects)
    written = ConditionalPlan("push", plan("push", ("gripper open", "wait")).steps, task)
    assert str(written).splitlines()[0] == "# push: Push. def reach(robot): import os"
    assert parse_plan(str(written), tasks={"push": task}) == written


# ---- .plan files


@settings(max_examples=25, deadline=None)
@given(st.sets(st.sampled_from(MT50), min_size=1, max_size=4).flatmap(
    lambda tasks: st.tuples(*(conditional_plans(task) for task in sorted(tasks)))
))  # fmt: skip
def test_saved_plans_load_as_the_same_plans(tmp_path_factory, drawn):
    folder = tmp_path_factory.mktemp("plans") / "new" / "folder"
    try:
        written = save_plans(Plans(drawn), folder)
    except UnicodeEncodeError:
        # A file cannot hold a lone surrogate; no half-written file stays.
        assert all(load_plans(path) for path in folder.iterdir())
        return
    assert [path.name for path in written] == [f"{plan.task}.plan" for plan in drawn]
    assert load_plans(folder) == load_plans(str(folder)) == Plans(drawn)
    assert load_plans(written[0]) == Plans(drawn[:1])


def test_saving_replaces_only_the_named_plans(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    other = plan("push", ("gripper closed", "wait"))
    save_plans({"push": other}, tmp_path)
    assert load_plans(tmp_path) == {"push": other, "drawer-open": parse_plan(DRAWER)}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawer-open.plan", "notes.txt", "push.plan"]


@pytest.mark.parametrize("wrong", [None, "push", plan(), {"reach": plan()}, {}])
def test_saving_something_else_writes_nothing(tmp_path, wrong):
    with pytest.raises((TypeError, PlanError)):
        save_plans(wrong, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_missing_path_or_an_empty_folder_is_an_error(tmp_path):
    for missing in (tmp_path / "absent", str(tmp_path / "absent.plan"), "MT5"):
        with pytest.raises(FileNotFoundError, match="'MT10' and 'MT50'"):
            load_plans(missing)
    (tmp_path / "push.txt").write_text(HEAD)
    with pytest.raises(FileNotFoundError, match=r"\.plan files"):
        load_plans(tmp_path)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["reach.plan"], r"^reach\.plan, line 1: .*'reach'.*'push'"),
        (["mine.plan", "push.plan"], r"^push\.plan: 'push' already has a plan in mine\.plan"),
    ],
)
def test_a_file_of_another_task_and_a_second_plan_are_refused(tmp_path, names, message):
    for name in names:
        (tmp_path / name).write_text(HEAD)
    with pytest.raises(PlanError, match=message):
        load_plans(tmp_path)


def test_a_file_may_have_any_name_but_that_of_another_task(tmp_path):
    (tmp_path / "mine.plan").write_text(HEAD)
    assert list(load_plans(tmp_path / "mine.plan")) == list(load_plans(tmp_path)) == ["push"]


def test_an_error_names_the_file_and_its_line(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "reach.plan").write_text(HEAD.replace("push(robot)", "reach(robot)").replace("is open", "is opne"))
    with pytest.raises(PlanError, match=r"^reach\.plan, line 2: .*at 'opne'"):
        load_plans(tmp_path)


@pytest.mark.parametrize("encode", [lambda t: t.encode("utf-8-sig"), lambda t: t.replace("\n", "\r\n").encode()])
def test_a_file_from_another_editor_loads(tmp_path, encode):
    (tmp_path / "push.plan").write_bytes(encode(HEAD))
    assert load_plans(tmp_path) == Plans([plan()])


# ---- JSON of pairs

PAIRS = {
    "push": [
        ["the robot's gripper is not above the puck", "put gripper above puck"],
        ["the gripper isn't touching the puck", "let_go the puck"],
    ],
    "reach": [["the robot's gripper is open", "move gripper to target location"]],
}


@pytest.fixture
def write(tmp_path):
    def write(value):
        path = tmp_path / "plans.json"
        path.write_text(value if isinstance(value, str) else json.dumps(value))
        return path

    return write


@pytest.mark.parametrize("value", [PAIRS, {"what": "written by a model", "plans": PAIRS}])
def test_pairs_become_plans_and_plan_files(write, tmp_path, value):
    plans = load_plans(write(value))
    assert list(plans) == ["push", "reach"]
    assert [(str(step.condition), step.skill, step.reason) for step in plans["push"].steps] == [
        ("the robot's gripper is not above the puck", "put the gripper above the puck", ""),
        (
            "the robot's gripper is not around the puck",
            "let go the puck",
            "nearest to: the gripper isn't touching the puck",
        ),
    ]
    save_plans(plans, tmp_path / "folder")
    again = load_plans(tmp_path / "folder")
    assert again == plans
    assert again["push"].steps[1].reason == plans["push"].steps[1].reason


@given(condition=st.text(max_size=60), skill=st.from_regex(r"[a-z]{1,8}( [a-z]{1,8}){0,3}", fullmatch=True))
def test_a_condition_of_a_pair_becomes_the_nearest_query_or_is_refused(tmp_path_factory, condition, skill):
    path = tmp_path_factory.mktemp("any") / "plans.json"
    path.write_text(json.dumps({"push": [[condition, skill]]}))
    match = nearest_query(condition, "push")
    if match.least_score < 1.0 - LIMIT:
        with pytest.raises(PlanError, match="no query is near enough to the condition"):
            load_plans(path)
        return
    (step,) = load_plans(path)["push"].steps
    assert step.condition == match.query


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("{", "expected JSON"),
        ("[" * 100_000, "nested too deeply"),
        ([], "must be an object, got list"),
        ({"plans": 3}, "plans must be a dict, got 3"),
        ({"pusch": []}, "'pusch' is not a task; did you mean 'push'"),
        ({"push": {}}, "push, step 1"),
        ({"push": [["gripper is open"]]}, "push, step 1"),
        ({"push": [["gripper is open", 3]]}, "push, step 1"),
        ({"push": [["gripper is open", "7"]]}, "skill must begin"),
        ({"push": []}, "got 0"),
        ({}, "at least one plan"),
        ('{"push": ' + "[" * 900 + "]" * 900 + "}", "nested too deeply"),
        ('{"push": [[' + "9" * 5000 + ", 3]]}", "expected JSON"),
        ('{"push": [["gripper is open", "wait"]], "push": [["gripper is closed", "wait"]]}', "'push' more than once"),
        (" " * 2**18 + "{}", f"at most {PLAN_LIMIT} bytes"),
        ({"push": [["open and " * 256 + "closed", "wait"]]}, "push, step 1: .*256 clauses"),
    ],
)
def test_a_faulty_json_file_is_refused(write, value, message):
    with pytest.raises(PlanError, match=message):
        load_plans(write(value))


def test_skills_selects_among_the_shipped_plans_only(write):
    with pytest.raises(ValueError, match="skills"):
        load_plans(write(PAIRS), skills="MT10")
    assert set(load_plans("MT50", skills="MT10")) == set(MT50)
