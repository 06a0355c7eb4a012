"""``lw-torchrl tasks``, ``query`` and ``check``, with shipped and custom tasks, skills and plans."""

import json
import re
import sys

import pytest
from cases import read_cases
from commands import document, fails, run

import lw_torchrl as lw

PLAN = read_cases("cli/texts.toml")["push"]


def test_tasks_are_listed(capsys, monkeypatch):
    printed = run(capsys, "tasks", "MT10")
    assert "10 tasks" in printed
    assert all(task in printed and lw.TASKS[task].description in printed for task in lw.MT10)
    assert "50 tasks" in (whole := run(capsys, "tasks"))
    monkeypatch.setenv("COLUMNS", "20")
    assert run(capsys, "tasks") == whole, "lines in a pipe are not wrapped"
    assert [row["task"] for row in document(capsys, "tasks MT10")["tasks"]] == list(lw.MT10)


@pytest.mark.parametrize("width", [20, 100])
def test_a_table_is_as_wide_as_the_terminal(capsys, monkeypatch, width):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", str(width))
    assert max(map(len, re.sub(r"\x1b\[[\d;]*m", "", run(capsys, "tasks")).splitlines())) <= width


def test_a_task_is_shown_with_its_plan_queries_and_skills(capsys):
    printed = run(capsys, "tasks", "drawer-open")
    assert str(lw.load_plans("MT10")["drawer-open"]).strip() in printed
    assert "place the gripper above the drawer handle" in printed
    assert "\n  the robot's gripper is near the drawer handle\n" in printed
    shown = document(capsys, "tasks drawer-open")
    assert [row["query"] for row in shown["task"]["queries"]] == list(lw.supported_queries("drawer-open"))
    skill = lw.load_skills()[shown["skills"][0]["skill"]].for_task("drawer-open")
    assert shown["skills"][0]["offset"] == [*skill.offset]


def state_after(task, step, seed=0):
    env = lw.LanguageWorldEnv(task, seed=seed)
    state = env.reset()
    expert = lw.ExpertActor(task)
    for _ in range(step):
        state = env.step(expert(state))["next"]
    env.close()
    return state


@pytest.mark.parametrize(("step", "seed"), [(0, 0), (40, 3)])
def test_a_query_is_answered_in_a_state(capsys, step, seed):
    state = state_after("pick-place", step, seed)
    for text in ("Is the gripper open?", "the gripper is not near the puck and above the target location"):
        parsed = lw.parse_query(text, "pick-place")
        truth = lw.QueryProgram({"pick-place": [parsed]})(state["observation"], state["task_id"]).item()
        printed = run(capsys, "query", "pick-place", text, "--step", step, "--seed", seed)
        assert printed.splitlines()[-1] == f"{'yes' if truth else 'no'}: {parsed}"
    hand = tuple(f"{number:.3f}" for number in state["observation"][0, :3].tolist())
    assert re.search(r"the robot's gripper +at +(\S+) +(\S+) +(\S+) m", printed).groups() == hand


def test_without_a_text_all_queries_that_hold_are_listed(capsys):
    listed = run(capsys, "query", "reach", "--step", 30).split("\n\n")[1].strip().splitlines()
    queries = [lw.parse_query(text, "reach") for text in lw.supported_queries("reach")]
    state = state_after("reach", 30)
    truths = lw.QueryProgram({"reach": queries})(state["observation"], state["task_id"])[0].tolist()
    assert listed == [str(query) for query, truth in zip(queries, truths, strict=True) if truth]
    (answer,) = document(capsys, "query reach", "is the gripper open?")["queries"]
    assert answer == {"query": "the robot's gripper is open", "holds": True}
    assert "teapot" in fails(capsys, "query", "reach", "the gripper is near the teapot")
    assert "--step must be at most 500" in fails(capsys, "query", "reach", "--step", 501)


def test_a_valid_plan_passes_the_check(capsys, tmp_path):
    path = tmp_path / "push.plan"
    path.write_text(PLAN)
    printed = run(capsys, "check", path)
    assert "push.plan: 2 steps, valid" in printed
    assert "no scripted skill 'shove the puck over there' for push; the closest is" in printed
    (row,) = document(capsys, "check", path)["files"]
    assert (row["steps"], row["faults"], len(row["notes"])) == (2, [], 1)


def test_every_fault_of_a_plan_is_reported(capsys, tmp_path):
    path = tmp_path / "push.plan"
    faulty = PLAN.replace("is not near the puck", "is not near the pluck").replace("robot.shove(", "robott.shove(")
    path.write_text(faulty + "import os\n")
    with pytest.raises(SystemExit) as caught:
        run(capsys, "check", path)
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert [line for line in (4, 7, 8) if f"push.plan, line {line}" in printed.out] == [4, 7, 8]
    assert "faults in 1 file" in printed.err
    with pytest.raises(SystemExit):
        run(capsys, "check", path, "--json")
    assert "pluck" in json.loads(capsys.readouterr().out)["files"][0]["faults"][0]


def test_the_shipped_files_are_valid(capsys, request):
    data = request.config.rootpath / "lw_torchrl" / "language" / "data"
    printed = run(capsys, "check", data / "plans")
    assert printed.count("valid") == 50
    assert "note" not in printed
    assert "skills, valid" in run(capsys, "check", data / "skills.toml")
    assert "50 tasks, valid" in run(capsys, "check", data / "tasks.toml")


def test_custom_tasks_skills_and_plans_are_checked(capsys, tmp_path):
    tasks, skills, plan = tmp_path / "tasks.toml", tmp_path / "skills.toml", tmp_path / "stack-cup.plan"
    tasks.write_text('[stack-cup]\ndescription = "Stack the cup."\nobjects.cup = "obs[4:7]"\n')
    skills.write_text('["lift the cup"]\ntarget = "cup"\n')
    plan.write_text('def stack_cup(robot):\n    if check("the gripper is open"):\n        robot.lift("the cup")\n')
    assert "task 'stack-cup' is not a task of the simulator" in run(capsys, "check", tasks)
    assert "skill 'lift the cup' suits no task" in run(capsys, "check", skills)
    own = ("--task-file", tasks, "--skill-file", skills)
    assert run(capsys, "check", plan, *own) == "stack-cup.plan: 1 step, valid\n"
    assert "no scripted skill 'lift the cup'" in run(capsys, "check", plan, "--task-file", tasks)
    with pytest.raises(SystemExit):
        run(capsys, "check", plan)
    capsys.readouterr()
    printed = run(capsys, "tasks", "stack-cup", "--plans", plan, *own)
    assert "Stack the cup." in printed
    assert 'robot.lift("the cup")' in printed
    assert "did you mean 'push'" in fails(capsys, "tasks", "psh", "--task-file", tasks)


def test_the_last_of_several_plans_for_a_task_is_used(capsys, tmp_path):
    (tmp_path / "push.plan").write_text(str(lw.load_plans("MT10")["push"]).replace("robot.place", "robot.bring"))
    assert "robot.bring" in run(capsys, "tasks", "push", "--plans", "MT10", tmp_path)
    assert "robot.bring" not in run(capsys, "tasks", "push", "--plans", tmp_path, "MT10")
    assert "robot.bring" not in run(capsys, "tasks", "push", "--plans", tmp_path, "metaworld")
    task = tmp_path / "tasks.toml"
    task.write_text('[reach]\ndescription = "Bring the hand to the ball."\nobjects.ball = "obs[36:39]"\n')
    assert "--plans: the shipped plan does not fit" in fails(capsys, "tasks", "reach", "--task-file", task)
