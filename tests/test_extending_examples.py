"""The pages link to the examples and show their commands, and the commands run."""

from __future__ import annotations

import ast
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

import lw_torchrl as lw
from lw_torchrl.cli.main import main
from lw_torchrl.language.relations import RELATIONS
from lw_torchrl.modules import METHODS
from lw_torchrl.suites import SUITES

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "examples" / "extending"
FILES = sorted(FOLDER.glob("my_*.py"))
TABLES = (METHODS, RELATIONS, SUITES, lw.PLAN_FORMATS)
SAYS = {
    "my_method.py": ("trained to step 3", "reach"),
    "my_evaluator.py": ("trained to step 3", "window-open"),
    "my_relation.py": ("reach.plan: 2 steps, valid", "is far from"),
    "my_format.py": ("condition -> skill", "no step: Good luck!"),
    "my_suite.py": ("ok   desk/hover", "trained to step 3"),
}
FASTER = {"--steps": 3, "--episodes": 1}
MORE = {"train": ("--batch-size", "20")}


def commands(path):
    """The command lines in an example's docstring."""
    said = ast.get_docstring(ast.parse(path.read_text("utf-8")))
    return [line for line in said.splitlines() if line.startswith("lw-torchrl ")]


@pytest.fixture
def tables(monkeypatch):
    before = [dict(table.data) for table in TABLES]
    yield
    for table, was in zip(TABLES, before, strict=True):
        table.data = was
    for path in FILES:
        sys.modules.pop(path.stem, None)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_page_links_to_the_example_and_shows_its_commands(path):
    page = "your-robot" if path.name == "my_suite.py" else "custom-networks"
    text = (ROOT / "docs" / f"{page}.md").read_text("utf-8")
    assert f"](../examples/extending/{path.name})" in text
    assert "\n".join(commands(path)) in text
    assert len(path.read_text("utf-8").splitlines()) <= 120


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_commands_of_examples_run(path, tables, tmp_path, monkeypatch, capsys):
    for file in FOLDER.iterdir():
        if file.is_file():
            shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    for line in commands(path):
        words = shlex.split(line)[1:]
        for option, least in FASTER.items():
            if option in words:
                words[words.index(option) + 1] = str(least)
        main([*words, *MORE.get(words[0], ())])
    said = capsys.readouterr()
    for part in SAYS[path.name]:
        assert part in said.out + said.err
