"""Conditional plans: one text for each plan and one plan for each text, nothing executed, nothing lost."""

import os
import re
import time
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lw_torchrl.language.formats import chain_py
from lw_torchrl.language.formats.chain_py import check_plan, format_plan, parse_plan
from lw_torchrl.language.named_objects import GRIPPER
from lw_torchrl.language.plan_files import load_plans, save_plans
from lw_torchrl.language.plans import (
    ConditionalPlan,
    PlanError,
    Plans,
    PlanStep,
    as_plans,
)
from lw_torchrl.language.queries import Clause, Query, QueryError, check_query, parse_query, supported_queries
from lw_torchrl.language.tasks import MT50, TASKS, Task

DRAWER = """\
# drawer-open: Take hold of the drawer handle and pull the drawer open.
def drawer_open(robot):
    # The gripper has to come from above.
    if check("the robot's gripper is not vertically aligned with the drawer handle"):
        robot.place("the gripper above the drawer handle")
    if check("Is gripper open and above drawer handle?"):
        # Down, then hold on.
        # Both in one.
        robot.lower("gripper around drawer handle")
    if check('the gripper is closed'):
        robot.pull_back('')
"""


def plan(task="push", *pairs):
    return ConditionalPlan.from_pairs(task, pairs or [("the gripper is open", "push the puck")])


@st.composite
def queries(draw, task):
    texts = st.sampled_from(supported_queries(task))
    return parse_query(" and ".join(draw(st.lists(texts, min_size=1, max_size=3))), task)


verbs = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}", fullmatch=True)
tricky = st.sampled_from(
    ['"', "'", "\\", '\\"', "\\n", "\\\\", "#", '"):', "robot.x()",
     "puck", "gripper", "the", "robot's", "box", "lid", "above", "an", "its", "and", "door's", "lock",
     "ß", "手", "🤖", "é", "\n", "\u2028", "\x85", "\x0b", "\t", "\ufeff"]
)  # fmt: skip
details = st.lists(tricky | st.text(max_size=6), max_size=8).map(" ".join) | st.text(max_size=30)
skills = st.builds("{} {}".format, verbs, details)
reasons = st.just("") | st.lists(tricky | st.text(max_size=8), max_size=6).map(" ".join)


@st.composite
def conditional_plans(draw, task=None):
    task = task or draw(st.sampled_from(MT50))
    steps = st.builds(PlanStep, queries(task), skills, reasons)
    return ConditionalPlan(task, tuple(draw(st.lists(steps, min_size=1, max_size=4))))


# Reading


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


def test_comments_play_no_part_in_what_a_plan_does():
    bare = "\n".join(line for line in DRAWER.splitlines() if not line.strip().startswith("#"))
    assert parse_plan(bare) == parse_plan(DRAWER)


@pytest.mark.parametrize(
    ("task", "written", "skill"),
    [
        (
            "push",
            'robot.place("gripper above puck")',
            "place the gripper above the puck",
        ),  # the paper's example
        ("push", 'robot.place("the gripper above the puck")', "place the gripper above the puck"),
        (
            "push",
            'robot.place("the robot\'s gripper above the  puck")',
            "place the robot's gripper above the puck",
        ),
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


HEAD = 'def push(robot):\n    if check("the gripper is open"):\n        robot.push("the puck")\n'


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("", None, "no plan found"),
        ("# only a comment\n\n", None, "no plan found"),
        ("def push(robot):\n", None, "at least one step"),
        ('if check("the gripper is open"):\n    robot.push("puck")\n', 1, "def task_name(robot):"),
        ("Sure, here is a plan:\n" + HEAD, 1, "def task_name(robot):"),
        (HEAD.replace("push(robot)", "pusch(robot)"), 1, "did you mean 'push'?"),
        (HEAD.replace("push(robot)", "zzzzzzzz(robot)"), 1, "no task"),
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


@pytest.mark.parametrize("text", [None, 3, DRAWER.encode(), DRAWER.splitlines(), parse_query("gripper open", "push")])
def test_a_text_of_another_type_is_a_type_error(text):
    with pytest.raises(TypeError, match="text must be a string"):
        parse_plan(text)


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
    assert parse_plan(format_plan(quoted)) == quoted
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


@settings(max_examples=300, deadline=None)
@given(plan_lines | st.text(st.characters()))
def test_any_text_is_a_plan_or_a_plan_error(text):
    try:
        found = parse_plan(text)
    except PlanError:
        return
    assert parse_plan(format_plan(found)) == found


# Writing and reading back


@settings(max_examples=300, deadline=None)
@given(conditional_plans())
def test_the_text_of_a_plan_reads_back_as_the_same_plan(given):
    text = format_plan(given)
    found = parse_plan(text, given.task)
    assert found == given
    assert [step.skill for step in found.steps] == [step.skill for step in given.steps]
    assert format_plan(found) == text
    assert str(given) == text


@settings(deadline=None)
@given(conditional_plans())
def test_a_plan_is_in_canonical_spelling(given):
    assert ConditionalPlan(given.task, given.steps) == given
    for step in given.steps:
        assert step.skill == " ".join(step.skill.split())
        assert isinstance(step.condition, Query)


@pytest.mark.parametrize(
    ("given", "skill"),
    [
        ("push the puck", "push the puck"),
        ("push puck", "push the puck"),
        ("  push\n the   puck ", "push the puck"),
        ("let_go the puck", "let go the puck"),
        ("let_go puck", "let go the puck"),
        ("_let__go_ puck", "let go the puck"),
        ('say "hello" to the \\ puck', 'say "hello" to the \\ puck'),
        ("don't", None),
        ("pick-up the puck", None),
        ("3 steps forward", None),
        ("", None),
        (" \n", None),
        ("_", None),
        ("(push)", None),
        ("# push", None),
    ],
)
def test_a_skill_is_kept_in_canonical_spelling_or_refused(given, skill):
    if skill is None:
        with pytest.raises(PlanError, match="step 1 of plan 'push': skill must begin with a plain word"):
            plan("push", ("gripper open", given))
    else:
        kept = plan("push", ("gripper open", given))
        assert kept.steps[0].skill == skill
        assert parse_plan(format_plan(kept)) == kept


def test_a_condition_is_kept_in_canonical_spelling():
    for condition in (
        "Gripper open?",
        Query((Clause("gripper", "open"),)),
        Query((Clause(GRIPPER, "open"),)),
    ):
        step = ConditionalPlan("push", (PlanStep(condition, "push the puck"),)).steps[0]
        assert step.condition == Query((Clause(GRIPPER, "open"),))


def test_reasons_are_kept_and_cannot_add_lines():
    reason = "because\n    if check('gripper closed'):\n        robot.fling('the puck')\u2028x"
    given = ConditionalPlan("push", (PlanStep(parse_query("gripper open", "push"), "push the puck", reason),))
    found = parse_plan(format_plan(given))
    assert found == given
    assert found.steps[0].reason == " ".join(reason.split())


def test_reasons_play_no_part_in_equality():
    step = PlanStep(parse_query("gripper open", "push"), "push the puck", "so")
    assert ConditionalPlan("push", (step,)) == plan()
    assert hash(ConditionalPlan("push", (step,))) == hash(plan())


def test_the_text_names_the_task_and_its_description():
    assert format_plan(plan()) == (
        f"# push: {TASKS['push'].description}\n"
        "def push(robot):\n"
        '    if check("the robot\'s gripper is open"):\n'
        '        robot.push("the puck")\n'
    )


def test_the_text_of_a_plan_is_python_too():
    # People's editors colour and indent it as Python.
    compile(format_plan(plan("push", ("gripper open", "say \"a\" \\ 'b' 手"))), "push.plan", "exec")


# Plans by hand


@pytest.mark.parametrize(
    ("task", "steps", "error", "says"),
    [
        ("push", (), PlanError, "at least one step"),
        ("psuh", (PlanStep("gripper open", "push"),), ValueError, "'push'"),
        (3, (PlanStep("gripper open", "push"),), TypeError, "task"),
        ("push", (("gripper open", "push"),), TypeError, "step 1"),
        ("push", (PlanStep("gripper open", "push"), None), TypeError, "step 2"),
        ("push", (PlanStep("gripper open", None),), TypeError, "step 1"),
        ("push", (PlanStep(None, "push"),), TypeError, "string"),
        ("push", (PlanStep("gripper open", "push"), PlanStep("gripper flies", "push")), PlanError, "step 2"),
        (
            "push",
            (PlanStep(parse_query("gripper near drawer handle", "drawer-open"), "x"),),
            PlanError,
            "step 1",
        ),
        ("push", (PlanStep(Query(()), "push"),), PlanError, "step 1"),
    ],
)
def test_a_plan_by_hand_is_checked(task, steps, error, says):
    with pytest.raises(error, match=says):
        ConditionalPlan(task, steps)


def test_from_pairs_takes_any_spelling_and_refuses_the_rest():
    assert plan("push", ("Is the gripper open?", "push puck")) == plan("push", ("gripper open", "push the puck"))
    with pytest.raises(PlanError, match="at least one step"):
        ConditionalPlan.from_pairs("push", [])
    with pytest.raises(QueryError, match="nearest query"):
        plan("push", ("the gripper flies", "push"))
    with pytest.raises(ValueError, match="did you mean 'push'"):
        ConditionalPlan.from_pairs("psuh", [("gripper open", "push")])


def test_steps_in_a_list_make_the_same_plan():
    assert ConditionalPlan("push", list(plan().steps)) == plan()
    assert {ConditionalPlan("push", list(plan().steps)), plan()} == {plan()}


def test_plans_are_a_sorted_mapping():
    drawer = parse_plan(DRAWER)
    found = Plans([plan(), drawer])
    assert list(found) == ["drawer-open", "push"]
    assert len(found) == 2
    assert found["push"] == plan()
    assert found == {"push": plan(), "drawer-open": drawer}
    assert found.num_steps == 3
    assert found.skills == (
        "lower the gripper around the drawer handle",
        "place the gripper above the drawer handle",
        "pull back",
        "push the puck",
    )
    assert as_plans(found) is found
    assert as_plans(dict(found)) == found
    with pytest.raises(TypeError):
        found["reach"] = plan("reach", ("gripper open", "reach"))


def test_plans_name_what_is_wrong():
    with pytest.raises(PlanError, match="at least one plan"):
        Plans({})
    with pytest.raises(PlanError, match=r"plans\['reach'\] is a plan for another task, 'push'"):
        Plans({"reach": plan()})
    with pytest.raises(PlanError, match="one plan for each task"):
        Plans([plan(), plan()])
    with pytest.raises(TypeError, match="ConditionalPlan"):
        Plans({"push": "def push(robot):"})
    for wrong in (plan(), [plan()], "push", None):
        with pytest.raises(TypeError, match="plans must map"):
            as_plans(wrong)
    with pytest.raises(PlanError, match="plans lack reach, soccer; they cover push"):
        Plans([plan()]).require(["reach", "push", "soccer"])
    Plans([plan()]).require(["push"])


# Files


@settings(max_examples=25, deadline=None)
@given(st.sets(st.sampled_from(MT50), min_size=1, max_size=4).flatmap(
    lambda tasks: st.tuples(*(conditional_plans(task) for task in sorted(tasks)))
))  # fmt: skip
def test_saved_plans_load_as_the_same_plans(tmp_path_factory, given):
    folder = tmp_path_factory.mktemp("plans") / "new" / "folder"
    try:
        written = save_plans(Plans(given), folder)
    except UnicodeEncodeError:
        # A lone surrogate is no text of a file; nothing half-written stays.
        assert all(load_plans(path) for path in folder.iterdir())
        return
    assert [path.name for path in written] == [f"{plan.task}.plan" for plan in given]
    assert load_plans(folder) == Plans(given)
    assert load_plans(str(folder)) == Plans(given)
    assert load_plans(written[0]) == Plans(given[:1])


def test_saving_replaces_the_plans_it_names_alone(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    other = plan("push", ("gripper closed", "wait"))
    save_plans({"push": other}, tmp_path)
    assert load_plans(tmp_path) == {"push": other, "drawer-open": parse_plan(DRAWER)}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["drawer-open.plan", "notes.txt", "push.plan"]


def refuse(*args, **kwargs):
    raise OSError(28, "No space left on device")


def write_half(self, data, *args, **kwargs):
    with open(self, "w", encoding="utf-8") as file:
        file.write(data[: len(data) // 2])
    refuse()


@pytest.mark.parametrize(
    ("owner", "name", "failing"),
    [(os, "replace", refuse), (Path, "write_text", refuse), (Path, "write_text", write_half)],
    ids=["replace", "write", "half"],
)
def test_a_failure_leaves_the_old_file_whole(tmp_path, monkeypatch, owner, name, failing):
    save_plans(Plans([plan()]), tmp_path)
    before = (tmp_path / "push.plan").read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, failing)
        with pytest.raises(OSError, match="No space"):
            save_plans(Plans([plan("push", ("gripper closed", "wait"))]), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["push.plan"], "no temporary file stays"
    assert (tmp_path / "push.plan").read_bytes() == before


def test_a_failure_between_two_files_leaves_each_old_or_new(tmp_path, monkeypatch):
    old = [plan(), parse_plan(DRAWER)]
    new = [plan("push", ("gripper closed", "wait")), plan("drawer-open", ("gripper closed", "wait"))]
    save_plans(Plans(old), tmp_path)
    done = []
    replace = os.replace

    def once(*args):
        if done:
            refuse()
        done.append(replace(*args))

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", once)
        with pytest.raises(OSError, match="No space"):
            save_plans(Plans(new), tmp_path)
    assert load_plans(tmp_path) == {"drawer-open": new[1], "push": old[0]}
    save_plans(Plans(new), tmp_path)
    assert load_plans(tmp_path) == Plans(new)


def test_what_a_killed_save_leaves_does_not_spoil_the_folder(tmp_path, monkeypatch):
    save_plans(Plans([plan()]), tmp_path)
    before = (tmp_path / "push.plan").read_bytes()
    # A kill runs no clean-up: the half-written file stays.
    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_text", write_half)
        patch.setattr(Path, "unlink", lambda self, missing_ok=False: None)
        with pytest.raises(OSError, match="No space"):
            save_plans(Plans([plan("push", ("gripper closed", "wait"))]), tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    assert (tmp_path / "push.plan").read_bytes() == before
    assert load_plans(tmp_path) == Plans([plan()])


@pytest.mark.parametrize("wrong", [None, "push", [plan()], plan(), {"reach": plan()}, {}])
def test_saving_something_else_writes_nothing(tmp_path, wrong):
    with pytest.raises((TypeError, PlanError)):
        save_plans(wrong, tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_missing_folder_or_file_says_what_there_is(tmp_path):
    for missing in (tmp_path / "absent", str(tmp_path / "absent.plan"), "MT5"):
        with pytest.raises(FileNotFoundError, match="'MT10' and 'MT50' name the shipped plans") as caught:
            load_plans(missing)
        assert str(missing) in str(caught.value)


def test_a_folder_without_plans_is_an_error(tmp_path):
    (tmp_path / "push.txt").write_text(HEAD)
    with pytest.raises(FileNotFoundError, match=r"holds no \.plan files"):
        load_plans(tmp_path)


def test_a_file_named_after_another_task_is_an_error(tmp_path):
    (tmp_path / "reach.plan").write_text(HEAD)
    with pytest.raises(PlanError, match=r"reach\.plan, line 1: this is a plan for 'push', expected one for 'reach'"):
        load_plans(tmp_path)


def test_one_bad_file_names_itself_and_its_line(tmp_path):
    save_plans(Plans([plan(), parse_plan(DRAWER)]), tmp_path)
    (tmp_path / "reach.plan").write_text(HEAD.replace("push(robot)", "reach(robot)").replace("is open", "is opne"))
    with pytest.raises(PlanError, match=r"^reach\.plan, line 2: .*at 'opne'"):
        load_plans(tmp_path)


def test_an_empty_file_is_an_error(tmp_path):
    (tmp_path / "push.plan").touch()
    with pytest.raises(PlanError, match=r"push\.plan: no plan found"):
        load_plans(tmp_path)


def test_a_file_that_is_no_utf8_text_names_itself(tmp_path):
    (tmp_path / "push.plan").write_bytes(b"\xff\xfe" + HEAD.encode())
    with pytest.raises(PlanError, match=re.escape("push.plan")):
        load_plans(tmp_path)


@pytest.mark.parametrize("encode", [lambda t: t.encode("utf-8-sig"), lambda t: t.replace("\n", "\r\n").encode()])
def test_a_file_from_another_editor_loads(tmp_path, encode):
    (tmp_path / "push.plan").write_bytes(encode(HEAD))
    assert load_plans(tmp_path) == Plans([plan()])


@pytest.mark.parametrize("source", [None, 3, ["MT10"]])
def test_a_source_of_another_type_is_a_type_error(source):
    with pytest.raises(TypeError):
        load_plans(source)


def test_all_faults_come_in_one_pass(monkeypatch):
    asked = []
    monkeypatch.setattr(chain_py, "check_query", lambda text, task: asked.append(text) or check_query(text, task))
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


@pytest.mark.parametrize("unit", ["puck ", "puck, ", "puck,", "a-very-long-word puck ", "above the puck "])
def test_long_texts_take_time_in_proportion(unit):
    skill = "place " + unit * (500_000 // len(unit))
    start = time.process_time()
    found = ConditionalPlan.from_pairs("push", [("the gripper is open", skill)]).steps[0].skill
    assert time.process_time() - start < 5
    few = ConditionalPlan.from_pairs("push", [("the gripper is open", "place " + unit * 20)]).steps[0].skill
    assert found.startswith(few.rstrip(","))


def test_a_description_of_several_lines_writes_no_second_plan():
    lines = Task("push", "Push.\ndef reach(robot):\u2028import os", TASKS["push"].objects)
    written = ConditionalPlan("push", ConditionalPlan.from_pairs("push", [("gripper open", "wait")]).steps, lines)
    assert str(written).splitlines()[0] == "# push: Push. def reach(robot): import os"
    assert parse_plan(str(written), tasks={"push": lines}) == written
