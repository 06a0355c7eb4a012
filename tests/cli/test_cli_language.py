"""The subcommands about words: what they print, and every fault of a file at once."""

import json
import re
import sys

import pytest
from commands import fails, run

import lw_torchrl as lw

PLAN = """# push: anything
def push(robot):
    # Far away.
    if check("the gripper is not near the puck"):
        robot.place("the gripper above the puck")
    if check("the gripper is near the puck"):
        robot.shove("the puck over there")
"""


def test_tasks_lists_the_objects(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    out = run(capsys, "tasks", "MT10")
    assert "10 tasks" in out
    for task in lw.MT10:
        assert task in out
        assert lw.TASKS[task].description in out
    assert "window handle" in out
    assert "50 tasks" in run(capsys, "tasks")


def test_skills_of_a_task_and_the_nearest(capsys):
    out = run(capsys, "skills", "push")
    assert "place the gripper above the puck" in out
    assert "drawer" not in out
    assert run(capsys, "skills", "push", "--nearest", "put gripper above puck").startswith(
        "place the gripper above the puck   (similarity 0."
    )
    assert "did you mean 'push'" in fails(capsys, "skills", "pusch")


def test_plans_are_printed_as_they_are_written(capsys):
    assert run(capsys, "plans", "drawer-open").strip() == str(lw.load_plans("MT10")["drawer-open"]).strip()
    assert "50 plans" in run(capsys, "plans")
    assert "robot." in run(capsys, "plans", "hammer", "--skill-set", "MT10")


def test_queries_and_the_nearest(capsys):
    out = run(capsys, "queries", "push")
    assert f"{len(lw.supported_queries('push'))} base queries" in out
    assert "the robot's gripper is near the puck" in out
    assert "the robot's gripper is near the puck" in run(capsys, "queries", "push", "gripper is nearly at the puck")


def test_a_sound_plan_is_checked(capsys, tmp_path):
    path = tmp_path / "push.plan"
    path.write_text(PLAN)
    out = run(capsys, "check", path)
    assert "push.plan: 2 steps, valid" in out
    assert "no scripted skill 'shove the puck over there' suits push; the nearest is" in out


def test_every_fault_of_a_plan_is_named(capsys, tmp_path):
    path = tmp_path / "push.plan"
    faulty = PLAN.replace("is not near the puck", "is not near the pluck").replace("robot.shove(", "robott.shove(")
    path.write_text(faulty + "import os\n")
    with pytest.raises(SystemExit):
        run(capsys, "check", path)
    printed = capsys.readouterr()
    assert "push.plan, line 4" in printed.out
    assert "puck" in printed.out
    assert "push.plan, line 7" in printed.out
    assert "push.plan, line 8" in printed.out
    assert "Traceback" not in printed.err
    assert "faults in 1 file" in printed.err


def test_faults_without_a_sound_step_left(capsys, tmp_path):
    path = tmp_path / "push.plan"
    path.write_text(PLAN.replace("puck", "pluck").replace("if check", "if chek", 1))
    with pytest.raises(SystemExit):
        run(capsys, "check", path)
    printed = capsys.readouterr()
    assert [line.split(":")[0] for line in printed.out.splitlines()] == [
        "push.plan, line 4",
        "push.plan, line 6",
        "push.plan",
    ]
    assert "2 faults in 1 file" in printed.err


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no plan found"),
        ("def psh(robot):\n", "did you mean 'push'"),
        ("def push(robot):\n", "at least one step"),
        ("nonsense", "expected 'def task_name"),
    ],
)
def test_a_plan_beyond_repair(capsys, tmp_path, text, message):
    path = tmp_path / "push.plan"
    path.write_text(text)
    with pytest.raises(SystemExit) as caught:
        run(capsys, "check", path)
    assert caught.value.code == 2
    assert message in capsys.readouterr().out


def test_the_shipped_files_are_valid(capsys, request):
    data = request.config.rootpath / "lw_torchrl" / "language" / "data"
    out = run(capsys, "check", data / "plans")
    assert out.count("valid") == 50
    assert "note" not in out
    assert "skills, valid" in run(capsys, "check", data / "skills.toml")
    assert "50 tasks, valid" in run(capsys, "check", data / "tasks.toml")


def test_ones_own_skills_and_tasks(capsys, tmp_path):
    skills = tmp_path / "skills.toml"
    skills.write_text('["shove the puck over there"]\ntarget = "puck"\n["juggle"]\ntarget = "balls"\n')
    out = run(capsys, "check", skills)
    assert "skills.toml: note: skill 'juggle' suits no task; it needs 'balls'" in out
    assert "tasks of yours come by --task-file" in out
    assert "2 skills, valid" in out
    plan = tmp_path / "push.plan"
    plan.write_text(PLAN)
    assert "note" not in run(capsys, "check", plan, "--skill-file", skills)
    tasks = tmp_path / "tasks.toml"
    tasks.write_text('[push]\ndescription = "Push the disc."\nobjects.disc = "obs[4:7]"\n')
    assert "1 task, valid" in run(capsys, "check", tasks)
    plan.write_text(PLAN.replace("puck", "disc"))
    assert "push.plan: 2 steps, valid" in run(capsys, "check", plan, "--task-file", tasks)
    skills.write_text('["wipe it"]\ntarget = "rag"\nfor.wipe.gripper = 1.0\n')
    tasks.write_text(
        '[wipe]\ndescription = "Wipe."\nobjects.rag = "obs[4:7]"\n[psh]\ndescription = "Push."\nobjects.a = "obs[4:7]"'
    )
    out = run(capsys, "check", tasks)
    assert "note: task 'psh' is none of the simulator's; did you mean 'push'?" in out
    assert "2 tasks, valid" in out
    assert run(capsys, "check", skills, "--task-file", tasks) == "skills.toml: 1 skill, valid\n"
    assert "'wipe'" in fails(capsys, "check", skills)
    tasks.write_text('[psh]\ndescription = "Push the disc."\n')
    assert "did you mean" in fails(capsys, "check", tasks)
    assert "there is no" in fails(capsys, "check", tmp_path / "none.plan")


def test_a_plan_for_a_task_of_ones_own(capsys, tmp_path):
    (tmp_path / "tasks.toml").write_text('[stack-cup]\ndescription = "Stack."\nobjects.cup = "obs[4:7]"\n')
    plan = tmp_path / "stack-cup.plan"
    plan.write_text('def stack_cup(robot):\n    if check("the gripper is open"):\n        robot.lift("the cup")\n')
    with pytest.raises(SystemExit):
        run(capsys, "check", plan)
    assert "1 fault in 1 file; tasks of yours come by --task-file" in capsys.readouterr().err
    out = run(capsys, "check", plan, "--task-file", tmp_path / "tasks.toml")
    assert "no scripted skill 'lift the cup' suits stack-cup; " in out
    assert "wrench" not in out
    assert "stack-cup.plan: 1 step, valid" in out


@pytest.mark.parametrize("width", [10, 60, 140])
def test_tables_are_as_wide_as_the_terminal(capsys, monkeypatch, width):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(width))
    shown = re.sub(r"\x1b\[[\d;]*m", "", run(capsys, "tasks"))
    assert max(map(len, shown.splitlines())) <= width


@pytest.mark.parametrize(
    "command", [["tasks"], ["skills", "push"], ["plans"], ["plan", "read", "MT50"], ["queries", "push"]]
)
def test_a_pipe_gets_whole_lines_without_padding(capsys, monkeypatch, command):
    whole = run(capsys, *command)
    for width in ("10", "400"):
        monkeypatch.setenv("COLUMNS", width)
        assert run(capsys, *command) == whole
    assert all(line == line.rstrip() for line in whole.splitlines())
    assert whole.isascii(), "no lines are drawn, no word is cut"
    if command == ["tasks"]:
        assert all(task.description in whole for task in lw.TASKS.values())


def test_scripted_writes_what_it_found(capsys, tmp_path):
    out = run(capsys, "scripted", "reach", "push", "--episodes", 3, "--out", tmp_path / "scripted")
    assert "push: success 1.00" in out
    assert "close the gripper around the puck" in out
    result = lw.EvaluationResult.load(tmp_path / "scripted" / "results.json")
    assert result.success_once == {"push": 1.0, "reach": 1.0}
    use = json.loads((tmp_path / "scripted" / "plan_use.json").read_text())
    assert len(use["push"]["chosen"]) == len(lw.load_plans("MT10")["push"].steps)
    assert (tmp_path / "scripted" / "success.png").read_bytes().startswith(b"\x89PNG")


def test_plans_of_two_suites_are_not_checked_together(capsys, tmp_path):
    (tmp_path / "a.plan").write_text("def reach(robot):\n")
    (tmp_path / "b.plan").write_text("def fetch__push(robot):\n")
    said = fails(capsys, "check", tmp_path)
    assert "FILE must be of one suite, got plans of metaworld (a.plan) and fetch (b.plan); give each" in said
