"""``--json``: one document on the standard output and nothing else there, as docs/cli.md says."""

from __future__ import annotations

import io
import json
import math
import re
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

import pytest
from commands import check_documented, document, documented

import lw_torchrl as lw
from lw_torchrl.cli.main import COMMANDS, GROUPS, main
from lw_torchrl.cli.output import Output
from lw_torchrl.language.nearest import nearest_query

PLAN = """def push(robot):
    if check("the gripper is near the puck"):
        robot.close("the gripper around the puck")
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A plan, a dataset and a policy."""
    made = tmp_path_factory.mktemp("json")
    (made / "push.plan").write_text(PLAN)
    with redirect_stdout(io.StringIO()):
        main(["collect", "push", "reach", "--out", str(made / "demos"), "--episodes", "1"])
        small = ("--steps", "3", "--width", "8", "--batch-size", "4")
        main(["train", str(made / "demos"), "--out", str(made / "policy.safetensors"), *small])
    return made


@pytest.fixture(autouse=True)
def there(folder, monkeypatch):
    monkeypatch.chdir(folder)
    monkeypatch.setattr(lw, "evaluate", partial(lw.evaluate, max_steps=5))


WORDS = {
    "tasks": "tasks MT10",
    "skills": "skills push",
    "skills --nearest": "skills --nearest grab",
    "plans": "plans reach",
    "plan read": "plan read MT10 --task reach",
    "queries": "queries push",
    "queries TASK TEXT": "queries push touching",
    "query": "query reach",
}


@pytest.mark.parametrize("row", WORDS)
def test_words(capsys, row):
    check_documented(row, document(capsys, *WORDS[row].split()))


def test_the_example_is_what_is_printed(capsys):
    text = (Path(__file__).parents[2] / "docs" / "cli.md").read_text("utf-8")
    ((command, printed),) = re.findall(r"```sh\nlw-torchrl (.*) --json\n```\n+```json\n(.*?)```", text, re.DOTALL)
    assert document(capsys, *command.split()) == json.loads(printed)


def test_numbers_are_those_of_the_library(capsys):
    task = document(capsys, "skills", "push")["skills"][0]
    skill = lw.load_skills()[task["skill"]].for_task("push")
    assert (task["offset"], task["gain"], task["gripper"]) == ([*skill.offset], [*skill.gain], skill.gripper)
    score = nearest_query("touching", "push").score
    assert document(capsys, "queries", "push", "touching")["nearest"]["similarity"] == score
    (told,) = document(capsys, "query", "reach", "is the gripper open?")["queries"]
    assert told == {"query": "the robot's gripper is open", "holds": True}


def test_a_step_that_cannot_be_read_has_nulls(capsys):
    Path("own").mkdir(exist_ok=True)
    Path("own/push.plan").write_text(
        PLAN.replace("near the puck", "open").replace("close", "ponder").replace("the gripper around the puck", "here")
    )
    found = document(capsys, "plan", "read", "own/push.plan")
    assert found["plans"] == [{"task": "push", "source": "default", "trust": 0.0}]
    *default, ponder = found["read"]
    assert {name: ponder[name] for name in ponder if name not in ("task", "source")} == {
        **dict.fromkeys(("skill", "verb", "moved", "target", "condition")),
        **{"written": "ponder here", "sure": 0.0, "seen": False},
    }
    assert [step["written"] for step in default] == [None] * 4


def test_check_tells_the_faults_and_ends_with_2(capsys):
    (row,) = document(capsys, "check", "push.plan")["files"]
    assert row == {"file": "push.plan", "steps": 1, "faults": [], "notes": []}
    assert [*row] == documented("check")["files"][:4]
    Path("bad.plan").write_text(PLAN.replace("puck", "pluck"))
    with pytest.raises(SystemExit) as caught:
        main(["check", "bad.plan", "--json"])
    printed = capsys.readouterr()
    assert caught.value.code == 2
    assert "pluck" in json.loads(printed.out)["files"][0]["faults"][0]
    assert printed.err == "lw-torchrl: error: 1 fault in 1 file\n"


def test_check_of_a_broken_table_leaves_a_document(capsys):
    Path("bad.toml").write_text("[")
    with pytest.raises(SystemExit) as caught:
        main(["check", "bad.toml", "--json"])
    printed = capsys.readouterr()
    assert caught.value.code == 2
    (row,) = json.loads(printed.out)["files"]
    assert [*row] == documented("check")["files"][:4]
    assert "bad.toml: " in row["faults"][0]
    assert "bad.toml: " in printed.err


def test_an_error_leaves_no_document(capsys):
    with pytest.raises(SystemExit):
        main(["tasks", "raech", "--json"])
    assert capsys.readouterr().out == ""


def test_data(capsys, folder):
    check_documented("collect", document(capsys, "collect", "push", "reach", "--out", "demos", "--episodes", 1))
    found = document(capsys, "data", "show", "demos")
    check_documented("data show", found)
    assert [row["label"] for row in found["tasks"]] == ["push", "reach"]
    assert (found["all"]["episodes"], found["all"]["steps"], found["all"]["success"]) == (2, 1000, 1.0)
    assert found["datasets"][0]["config"]["seed"] == 0
    assert document(capsys, "data", "show", "demos", "--check")["damaged"] == []
    check_documented("data export", document(capsys, "data", "export", "demos", "--to", "lerobot", "--out", "others"))
    found = document(capsys, "data", "import", "others", "--out", "back")
    check_documented("data import", found)
    assert (found["steps"], found["lacking"], found["tasks"][0]["success"]) == (1000, [], 1.0)
    path = folder / "demos" / "data" / "action.memmap"
    content = path.read_bytes()
    path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    try:
        with pytest.raises(SystemExit) as caught:
            main(["data", "show", "demos", "--check", "--json"])
    finally:
        path.write_bytes(content)
    assert caught.value.code == 2
    assert json.loads(capsys.readouterr().out)["damaged"] == [{"folder": "demos", "episodes": 1}]


def test_policies(capsys):
    small = ("--steps", 3, "--width", 8, "--batch-size", 4)
    check_documented("train", document(capsys, "train", "demos", "--out", "policy.safetensors", *small))
    main(["evaluate", "policy.safetensors", "--episodes", "1", "--json"])
    printed = capsys.readouterr()
    found = json.loads(printed.out)
    check_documented("evaluate", found)
    assert printed.err.startswith("on the 2 tasks that it was trained on")
    assert found["config"]["max_steps"] == 5
    assert found["tasks"][0] | {"mean_return": 0.0} == {
        "task": "push", "success_once": 0.0, "success_at_end": 0.0, "first_success": None, "mean_return": 0.0
    }  # fmt: skip
    failed = document(capsys, "evaluate", "policy.safetensors", "--tasks", "push", "--episodes", 1, "--attribute")
    check_documented("evaluate", failed, also=["failures"])
    assert failed["failures"][0]["task"] == "push"


def test_scripted_and_recorded(capsys):
    found = document(capsys, "scripted", "reach", "--episodes", 1)
    assert [*found] == [*documented("evaluate")]
    assert [*found["tasks"][0]["steps"][0]] == ["skill", "true", "chosen", "stuck"]
    found = document(capsys, "record", "reach", "--max-steps", 5, "--out", "o.rrd")
    check_documented("record", found)
    assert found["episodes"][0]["first_success"] is None


def test_a_plan_that_is_checked(capsys):
    found = document(capsys, "plan", "check", "push.plan", "--episodes", 1)
    check_documented("plan check", found)
    assert found["steps"][0]["expert"] > 0


def test_all_that_print_a_table_have_it():
    every = {**COMMANDS, **{f"{group} {name}": one for group, names in GROUPS.items() for name, one in names.items()}}
    without = {name for name, function in every.items() if "json" not in function.__annotations__}
    assert without == {"view", "data", "plan", "plan prompt"}


def test_what_json_cannot_hold_is_null_or_text():
    output = Output(as_json=True)
    output.show("found", {"nan": math.nan, "far": (math.inf, 1), 3: Path("a/b"), "no": False, "none": None})
    found = json.loads(output.document(), parse_constant=pytest.fail)
    assert found == {"found": {"nan": None, "far": [None, 1], "3": "a/b", "no": False, "none": None}}
