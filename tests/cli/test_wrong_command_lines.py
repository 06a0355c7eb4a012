"""What words alone tell is refused at once, without torch: every command wrong in every way, in a fresh process."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys

import pytest

from lw_torchrl.cli import exchange, options
from lw_torchrl.cli.main import COMMANDS, GROUPS

HEAVY = ("torch", "torchrl", "mujoco", "metaworld", "rerun", "matplotlib")
PROGRAM = f"""
import contextlib, io, json, sys, time
from lw_torchrl.cli.main import main

found = []
for arguments in json.load(sys.stdin):
    out, err, code = io.StringIO(), io.StringIO(), 0
    started = time.process_time()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main(arguments)
        except SystemExit as error:
            code = error.code
    heavy = [name for name in {HEAVY!r} if name in sys.modules]
    found.append([code, out.getvalue(), err.getvalue(), heavy, time.process_time() - started])
print(json.dumps(found))
"""

MODEL = "--model m --base-url http://127.0.0.1:1/v1"
WRONG = {
    # verbs, options, numbers
    "": "a command must come first, one of demo, collect,",
    "--quick demo": "a command must come first, one of demo, collect,",
    "evalute": "there is no command 'evalute'; did you mean 'evaluate'?",
    "generate": "there is no command 'generate'; did you mean 'plan generate'?",
    "plan": "a command must come first, one of prompt, generate,",
    "plan promt": "there is no command 'promt'; did you mean 'prompt'?",
    "data": "a command must come first, one of show, export, import",
    "data shw demos": "there is no command 'shw'; did you mean 'show'?",
    "data show demos --chek": "there is no option --chek; did you mean --check?",
    "evaluate x --episode 3": "there is no option --episode; did you mean --episodes? `lw-torchrl evaluate --help`",
    "collect reach --out o --tsks 3": "there is no option --tsks",
    "evaluate x --no-atribute": "there is no option --no-atribute; did you mean --no-attribute?",
    "train demos --outt o": "there is no option --outt; did you mean --out?",
    "train": "DATA and --out must be given",
    "plan generate push": "--model must be given",
    "evaluate x y": "there is one argument too many, 'y'",
    "evaluate -x": "there is no option -x",
    "evaluate x --episodes": "--episodes must be given a value",
    "evaluate x --episodes many": "--episodes must be an integer, got 'many'",
    "evaluate x --noise loud": "--noise must be a number, got 'loud'",
    "evaluate x --noise nan": "--noise must be finite",
    "collect reach --out o --noise 0 -1": "--noise must be finite and at least 0, got -1.0",
    "collect reach --out o --num-envs none": "--num-envs must be an integer, got 'none'",
    "collect reach --out o --num-envs 0": "--num-envs must be at least 1, got 0",
    # every verb: names, choices, files, places
    "demo --out file": "--out must be a folder, 'file' is none",
    "demo --qick": "there is no option --qick; did you mean --quick?",
    "collect raech --out o": "TASKS must be one of 'MT10', 'MT50', 'assembly', ",
    "collect reach --out file": "--out must be a folder, 'file' is none",
    "collect reach --out o --policy expret": "--policy must be one of 'expert', 'scripted', ",
    "collect reach --out o --policy nowhere.safetensors": "--policy: no file 'nowhere.safetensors'; `lw-torchrl train`",
    "collect reach --out o --policy demos": "--policy: 'demos' is a folder; a policy is one file",
    "data export nowhere --to lerobot --out o": "FOLDER: no dataset folder 'nowhere'",
    "data export demos --to lerobt --out o": "--to must be one of 'lerobot', 'minari', got 'lerobt'",
    "data export demos --to lerobot --out .": "--out must be a new folder, or an empty one, '.' holds files",
    "data import nowhere --out o": "SOURCE: there is no file or folder 'nowhere'",
    "data import demos --out o --episodes 0": "--episodes must be at least 1, got 0",
    "data show nowhere": "FOLDERS: no dataset folder 'nowhere'; make one with `lw-torchrl collect`",
    "train nowhere --out o.safetensors": "DATA: no dataset folder 'nowhere'; make one with `lw-torchrl collect`",
    "train demos --out demos": "--out must be a file, 'demos' is a folder",
    "train demos --out o.safetensors --method pcb": "--method must be one of 'pcbc', 'dc', 'one-hot', got 'pcb'",
    "train demos --out o.safetensors --tasks raech": "did you mean 'reach'",
    "train demos --out o.safetensors --plans nowhere": "--plans nowhere: no plan file or folder 'nowhere'; 'MT10'",
    "train demos --out o.safetensors --plans push.plan": "--plans push.plan: push.plan, line 2: ",
    "train demos --out o.safetensors --begin nowhere.safetensors": "--begin: no file 'nowhere.safetensors'",
    "train demos --out o.safetensors --evaluator nowhere.safetensors": "--evaluator: no file 'nowhere.safetensors'",
    "train demos --out o.safetensors --evaluator Softtruth": "--evaluator must be one of 'new', got 'Softtruth'",
    "train demos --out o.safetensors --task-file bad.toml": "--task-file bad.toml: ",
    "train demos --out o.safetensors --text-encoder mine": "--text-encoder must be like my_texts:encode",
    "train-evaluator raech --out o": "TASKS must be one of",
    "train-evaluator reach --out o --behaviours expret": "--behaviours must be one of 'expert'",
    "train-evaluator reach --out o --cameras cornr": "--cameras must be one of 'corner2', ",
    "train-evaluator reach --out o --data nowhere": "--data: no dataset folder 'nowhere'",
    "train-evaluator reach --out o --held-out-tasks push": "--held-out-tasks must be one of 'reach', got 'push'",
    "evaluate nowhere.safetensors": "CHECKPOINT: no file 'nowhere.safetensors'",
    "evaluate my.safetensors --tasks raech": "did you mean 'reach'",
    "evaluate my.safetensors --plans push.plan": "--plans push.plan: push.plan, line 2: ",
    "evaluate my.safetensors --evaluator nowhere.safetensors": "--evaluator: no file 'nowhere.safetensors'",
    "evaluate my.safetensors --attribute --reference nowhere": "--reference: no plan file or folder 'nowhere'",
    "evaluate my.safetensors --out file": "--out must be a folder, 'file' is none",
    "card few-shot-mt5": "POLICY: no file 'few-shot-mt5'; `lw-torchrl train` writes one; did you mean the",
    "card nowhere.safetensors": "POLICY: no file 'nowhere.safetensors'",
    "card my.safetensors --result nowhere.json": "--result: no file 'nowhere.json'",
    "record raech": "NAMES must be one of",
    "record reach --policy expret": "--policy must be one of 'expert', ",
    "record reach --compare nowhere.safetensors": "--compare: no file 'nowhere.safetensors'",
    "record reach --out o.txt": "--out must end in '.rrd', got 'o.txt'",
    "record push --plans push.plan": "--plans push.plan: push.plan, line 2: ",
    "view nowhere": "RECORDINGS: there is no file or folder 'nowhere'",
    "view a b c d e": "RECORDINGS must be 1 to 4 files or folders, got 5",
    "view demos": "RECORDINGS: the folder 'demos' holds no recording (*.rrd)",
    "view my.safetensors --screenshot o.jpg": "--screenshot must end in '.png', got 'o.jpg'",
    "view my.safetensors --html o.txt": "--html must end in '.html', got 'o.txt'",
    "view my.safetensors --window-size big": "--window-size must be like '1400x900', got 'big'",
    "query raech": "TASK must be one of",
    "query reach 'the gripper is purple'": "at 'purple' (word 4)",
    "query reach --step 501": "--step must be at most 500, got 501",
    "scripted raech": "NAMES must be one of",
    "scripted push --plans push.plan": "--plans push.plan: push.plan, line 2: ",
    "scripted push --select frist": "--select must be one of 'first', 'random', 'mix', got 'frist'",
    "scripted push --skill-file bad.toml": "--skill-file bad.toml: ",
    "scripted push --out file": "--out must be a folder, 'file' is none",
    "tasks raech": "NAMES must be one of",
    "tasks --task-file nowhere.toml": "--task-file: there is no file 'nowhere.toml'",
    "queries raech": "TASK must be one of",
    "queries push x --by spelling": "--by must be one of 'edit', 'embedding', got 'spelling'",
    "skills pusch": "did you mean 'push'",
    "skills --skill-file nowhere.toml": "--skill-file: there is no file 'nowhere.toml'",
    "plans raech": "NAMES must be one of",
    "plans --plans nowhere": "--plans nowhere: no plan file or folder 'nowhere'",
    "plan prompt raech": "TASK must be one of",
    "plan prompt reach --format chain": "--format must be one of 'basic_py', ",
    f"plan generate psuh {MODEL}": "TASKS must be one of",
    f"plan generate push {MODEL} --format chain": "--format must be one of",
    f"plan generate push {MODEL} --out file": "--out must be a folder, 'file' is none",
    "plan check nowhere.plan": "FILE: there is no file 'nowhere.plan'",
    "plan check push.plan --task pusch": "--task must be one of",
    "plan check push.plan --format chain": "--format must be one of",
    "plan read nowhere": "FILE nowhere: no plan file or folder 'nowhere'",
    "plan read push.plan": "push.plan, line 2: ",
    "plan read MT10 --task pusch": "--task must be one of",
    "plan read MT10 --task soccer": "--task soccer: MT10 has no plan for it",
    "plan read bad.toml --task push": "--format must be given, one of basic_py, ",
    f"plan repair raech {MODEL}": "TASKS must be one of",
    f"plan repair reach {MODEL} --format chain": "--format must be one of",
    "check nowhere": "FILE: there is no 'nowhere'",
    "check push.plan": "1 fault in 1 file",
    "check bad.toml": "bad.toml: ",
}


def in_a_fresh_process(commands, folder):
    """(status, standard output, standard error, heavy packages that are loaded, CPU seconds) of each."""
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        input=json.dumps(commands),
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def refused(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrong")
    (folder / "demos").mkdir()
    (folder / "file").write_text("mine")
    (folder / "my.safetensors").write_text("mine")
    (folder / "bad.toml").write_text("[")
    text = 'def push(robot):\n    if check("the gripper is near the pluck"):\n        robot.place("the gripper")\n'
    (folder / "push.plan").write_text(text)
    there = sorted(folder.iterdir())
    found = in_a_fresh_process([shlex.split(line) for line in WRONG], folder)
    assert sorted(folder.iterdir()) == there, "nothing is made"
    return dict(zip(WRONG, found, strict=True))


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_command_line_is_refused_in_one_line_without_torch(refused, line):
    code, out, err, heavy, seconds = refused[line]
    assert code == 2
    assert err.startswith("lw-torchrl: error: ")
    assert WRONG[line] in err
    assert err.count("\n") == 1
    assert (out == "") == (line != "check push.plan")
    assert heavy == []
    assert seconds < 0.5


def test_these_are_all_commands():
    tried = {line.split()[0] for line in WRONG if line} | {" ".join(line.split()[:2]) for line in WRONG}
    assert {*COMMANDS, *(f"{group} {name}" for group, names in GROUPS.items() for name in names)} <= tried


def test_help_of_every_command_comes_without_torch(tmp_path):
    commands = [["--help"], *([name, "--help"] for name in COMMANDS)]
    commands += [[group, name, "--help"] for group, names in GROUPS.items() for name in names]
    for command, (code, out, err, heavy, seconds) in zip(commands, in_a_fresh_process(commands, tmp_path), strict=True):
        assert (code, err, heavy) == (0, "", []), command
        assert out.startswith("usage: lw-torchrl"), command
        assert all(line == line.rstrip() for line in out.splitlines()), command
        assert seconds < 0.5, command


def test_words_are_listed_without_torch(tmp_path):
    lines = ("tasks", "skills push", "plans", "queries push", "queries push touching", "check FILE")
    (tmp_path / "FILE").write_text(
        'def push(robot):\n    if check("the gripper is open"):\n        robot.wait("here")\n'
    )
    for code, out, _, heavy, _ in in_a_fresh_process([line.split() for line in lines], tmp_path):
        assert (code, heavy) == (0, [])
        assert out


def test_an_argument_may_begin_with_a_dash_or_hold_spaces(tmp_path):
    lines = (
        ["check", "--", "-my plan é.plan"],
        ["check", "-my.plan"],
        ["query", "reach", "--seed", "-1", "--step", "-1"],
    )
    text = 'def push(robot):\n    if check("the gripper is open"):\n        robot.wait("here")\n'
    (tmp_path / "-my plan é.plan").write_text(text)
    (sound, unknown, negative) = in_a_fresh_process(lines, tmp_path)
    assert "-my plan é.plan: 1 step, valid" in sound[1]
    assert "there is no option -my.plan" in unknown[2]
    assert "--step must be at least 0, got -1" in negative[2]


def test_the_words_of_the_command_line_are_those_of_the_library():
    from typing import get_args

    from lw_torchrl.data import BEHAVIOURS
    from lw_torchrl.data.exchange import FORMATS
    from lw_torchrl.modules import METHODS

    assert tuple(BEHAVIOURS) == options.ACTORS
    assert get_args(exchange.ExportFormat) == FORMATS
    assert tuple(METHODS) == options.CONDITIONS
