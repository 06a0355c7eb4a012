"""The examples run; programs on one part are short."""

import ast
import json
import re
import runpy
import shlex
import shutil
import sys
import tempfile
from functools import partial
from pathlib import Path

import pytest
from cases import read_cases
from commands import python_process
from rerun.chunk import RrdReader

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.modules import METHODS
from lw_torchrl.suites import SUITES

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
TOUR = EXAMPLES / "tour.ipynb"
PARTS = sorted((EXAMPLES / "parts").glob("*.py"))
EXTENDING = sorted((EXAMPLES / "extending").glob("my_*.py"))
RUNS = read_cases("examples.toml")
PRINTS, SAYS = RUNS.pop("parts"), RUNS.pop("extending")
LESS = {"train": ["--batch-size", "20"], "evaluate": ["--max-steps", "20"]}
TABLES = (METHODS, RELATIONS, SUITES, lw.PLAN_FORMATS)


def names(path):
    """Return every name and attribute in a file, and every module and name that it imports."""
    nodes = list(ast.walk(ast.parse(path.read_text("utf-8"))))
    return {getattr(node, name) for node in nodes for name in ("attr", "id", "module", "name") if hasattr(node, name)}


def run(folder, *command):
    """Run Python in a folder and return its standard output."""
    # Ray's sockets need short paths.
    variables = {"TMPDIR": str(folder), "RAY_TMPDIR": tempfile.gettempdir()}
    done = python_process(*command, cwd=folder, **variables)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr.replace("UserWarning: \x1b", "")  # Gymnasium's, about Meta-World's spaces
    return done.stdout


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")
def test_the_training_loop_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(sys, "argv", ["train_bc.py", *RUNS["train_bc.py"]["options"].split()])
    for name, steps in (("collect_demonstrations", 200), ("evaluate", 40)):
        monkeypatch.setattr(lw, name, partial(getattr(lw, name), max_steps=steps))
    runpy.run_path(str(EXAMPLES / "train_bc.py"), run_name="__main__")
    output = capsys.readouterr().out
    assert [pattern for pattern in RUNS["train_bc.py"]["output"] if not re.search(pattern, output, re.MULTILINE)] == []
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in RUNS if name != "train_bc.py"])
def test_example_runs(name, tmp_path):
    if name in ("any_environment.py", "fetch_few_shot.py"):
        pytest.importorskip("gymnasium_robotics")
    output = run(tmp_path, EXAMPLES / name, *RUNS[name]["options"].split())
    assert [pattern for pattern in RUNS[name]["output"] if not re.search(pattern, output, re.MULTILINE)] == []
    if (file := RUNS[name].get("files")) == "nothing":
        assert not [path for path in tmp_path.iterdir() if not path.name.startswith("torchinductor")]
    elif file is not None:
        assert lw.load_actor(tmp_path / file).tasks


@pytest.mark.slow
def test_training_is_recorded(tmp_path):
    options = ["--steps", 20, "--demonstrations", 1, "--rollouts", 2, "--length", 30]
    output = run(tmp_path, EXAMPLES / "rerun_training.py", *options)
    assert re.findall(r"^step +(\d+)", output, re.MULTILINE) == ["10", "20"]
    recording = RrdReader(tmp_path / "runs" / "rerun_training" / "training.rrd")
    entities = {chunk.entity_path for chunk in recording.stream()}
    assert {"/metrics/loss/bc", "/metrics/success/mean", "/histograms/action", "/hparams"} <= entities
    tasks = ("drawer-open", "window-open")
    assert {f"/{task}\\ after\\ {step}/action" for task in tasks for step in (10, 20)} <= entities


@pytest.mark.slow
def test_policy_is_exported(tmp_path):
    lw.save_actor(lw.PlanConditionedActor(lw.load_plans("MT10")), tmp_path / "policy.safetensors")
    output = run(tmp_path, EXAMPLES / "export_policy.py", "policy.safetensors", "policy.pt2")
    assert output.count("at most 0.0e+00 ") == 3
    assert (tmp_path / "policy.pt2").is_file()


@pytest.mark.slow
def test_torchrls_trainer_runs(tmp_path):
    output = run(tmp_path, EXAMPLES / "torchrl_trainer.py", "--updates", 3, "--rows", 4, "--horizon", 25)
    assert len(output.split("update:")[1].splitlines()[0].split()) == 3
    logged = tmp_path / "runs" / "torchrl_trainer" / "ppo" / "scalars"
    for name in ("reward", "success", "loss_objective"):
        lines = (logged / f"{name}.csv").read_text("utf-8").splitlines()
        assert [line.split(",")[0] for line in lines] == ["100", "200", "300"]
    assert lw.load_actor(tmp_path / "runs" / "torchrl_trainer" / "policy.safetensors").distribution == "normal"


def outputs(notebook):
    """Return the kinds of a notebook's outputs, and their text."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    shown = [output for cell in cells for output in cell.get("outputs", ())]
    return [kind for output in shown for kind in output.get("data", [output["output_type"]])], str(shown)


@pytest.mark.slow
def test_tour_runs_from_top_to_bottom(tmp_path):
    pytest.importorskip("nbclient")
    done = python_process(ROOT / "docs" / "hooks" / "tour.py", "shown.ipynb", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert outputs(tmp_path / "shown.ipynb")[0] == outputs(TOUR)[0]


def statements(path):
    """Return the statements of a program, without its docstring."""
    return ast.parse(path.read_text("utf-8")).body[1:]


@pytest.mark.filterwarnings("ignore:.*WARN:UserWarning")  # gymnasium warns of its own environment
@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.stem)
def test_programs_have_at_most_15_lines_use_public_names_and_run(path, tmp_path, monkeypatch, capsys):
    lines = "\n".join(map(ast.unparse, statements(path))).splitlines()
    written = [line for line in path.read_text("utf-8").splitlines()[1:] if line.strip()]
    assert max(len(lines), len(written)) <= 15
    assert {name for name in names(path) if name and name.startswith("lw_torchrl")} == {"lw_torchrl"}
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
    assert PRINTS[path.stem] in capsys.readouterr().out
    if path.stem == "custom_decoder":  # its policy is loaded by another program, with a class of its own
        loads = [text for text in map(ast.unparse, statements(path)) if "save_actor(" not in text]
        assert len(loads) == len(statements(path)) - 1
        Path("loads.py").write_text("\n".join(loads), "utf-8")
        decoder = runpy.run_path("loads.py", run_name="__main__")["Decoder"]
        assert PRINTS[path.stem] in capsys.readouterr().out
        assert type(lw.load_actor("custom_decoder.safetensors", parts=[decoder]).decoder.network) is decoder


def commands(path):
    """Return the command lines in an example's docstring."""
    docstring = ast.get_docstring(ast.parse(path.read_text("utf-8")))
    return [line for line in docstring.splitlines() if line.startswith("lw-torchrl ")]


@pytest.fixture
def tables():
    before = [dict(table.data) for table in TABLES]
    yield
    for table, entries in zip(TABLES, before, strict=True):
        table.data = entries
    for path in EXTENDING:
        sys.modules.pop(path.stem, None)


@pytest.mark.parametrize("path", EXTENDING, ids=lambda path: path.stem)
def test_a_page_links_to_the_example_and_shows_its_commands(path):
    name = "your-robot" if path.name == "my_suite.py" else "custom-networks"
    page = (ROOT / "docs" / f"{name}.md").read_text("utf-8")
    assert f"](../examples/extending/{path.name})" in page
    assert "\n".join(commands(path)) in page
    assert len(path.read_text("utf-8").splitlines()) <= 120


@pytest.mark.parametrize("path", EXTENDING, ids=lambda path: path.stem)
def test_commands_of_examples_run(path, tables, tmp_path, monkeypatch, capsys):
    for file in path.parent.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(lw, "collect_demonstrations", partial(lw.collect_demonstrations, max_steps=120))
    for line in commands(path):
        words = shlex.split(line)[1:]
        for option, least in {"--steps": 3, "--episodes": 1}.items():
            if option in words:
                words[words.index(option) + 1] = str(least)
        main([*words, *LESS.get(words[0], [])])
    printed = capsys.readouterr()
    for part in SAYS[path.name]:
        assert part in printed.out + printed.err
