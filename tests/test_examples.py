"""The examples: short, composed by hand from the library's parts, and they run."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = sorted((Path(__file__).parent.parent / "examples").glob("*.py"))
TRAIN_BC = Path(__file__).parent.parent / "examples" / "train_bc.py"


def names(path):
    """Every name and attribute a file mentions, and every module it imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.Name):
            found.add(node.id)
        elif isinstance(node, ast.ImportFrom):
            found |= {node.module or "", *(alias.name for alias in node.names)}
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_an_example_is_one_page(path):
    lines = path.read_text("utf-8").splitlines()
    assert len(lines) <= 80
    assert max(map(len, lines)) <= 120


def test_train_bc_is_composed_by_hand():
    found = names(TRAIN_BC)
    assert {"BCLoss", "PlanConditionedActor", "LanguageWorldExperienceReplay", "QAFTransform"} <= found
    assert not any("Trainer" in name or "trainers" in name for name in found)
    assert not any(name.startswith("lw_torchrl.") for name in found), "the public names are enough"


def test_train_bc_runs(tmp_path):
    options = ["--steps", "20", "--demonstrations", "1", "--episodes", "1"]
    done = subprocess.run(
        [sys.executable, str(TRAIN_BC), *options],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    assert "step     0  loss" in done.stdout
    for task in ("drawer-open", "window-open"):
        assert any(line.startswith(f"{task} ") for line in done.stdout.splitlines()), "the table"
        assert any(line.startswith(f"{task}: ") for line in done.stdout.splitlines()), "the skills"
    assert not list(tmp_path.iterdir()), "it leaves nothing behind"
