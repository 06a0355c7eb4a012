"""examples/parts: short programs, each of which uses one part of the library alone."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

PARTS = sorted((Path(__file__).parent.parent / "examples" / "parts").glob("*.py"))
PRINTS = {
    "custom_decoder": "Linear(in_features=120, out_features=32",
    "custom_skill_encoder": "torch.Size([1, 3, 16])",
    "learned_evaluator": "['observation', 'task_id']",
    "losses": "IQLLoss",
    "plan_attention": "1.000  lower the gripper around the puck",
    "qaf_transform": "False",
    "rerun_logger": "swing",
    "samplers": "TaskBalancedSampler 10 of 20 rows push",
}


def code(path):
    """The statements of a program, without its docstring."""
    return ast.parse(path.read_text("utf-8")).body[1:]


def run(source, folder):
    done = subprocess.run(
        [sys.executable, "-c", source], cwd=folder, env=dict(os.environ), capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.stem)
def test_programs_have_at_most_15_lines_and_use_public_names(path):
    lines = "\n".join(ast.unparse(statement) for statement in code(path)).splitlines()
    written = [line for line in path.read_text("utf-8").splitlines()[1:] if line.strip()]
    assert max(len(lines), len(written)) <= 15
    modules = [node.module or "" for node in ast.walk(ast.parse(path.read_text("utf-8"))) if hasattr(node, "module")]
    names = [alias.name for statement in code(path) if isinstance(statement, ast.Import) for alias in statement.names]
    ours = {name for name in [*modules, *names] if name.partition(".")[0] == "lw_torchrl"}
    assert ours == {"lw_torchrl"}


@pytest.mark.parametrize("path", PARTS, ids=lambda path: path.stem)
def test_programs_run_in_an_empty_folder(path, tmp_path):
    assert PRINTS[path.stem] in run(path.read_text("utf-8"), tmp_path)


def test_custom_decoder_is_loaded_in_a_new_process(tmp_path):
    path = next(path for path in PARTS if path.stem == "custom_decoder")
    run(path.read_text("utf-8"), tmp_path)
    loads = [ast.unparse(statement) for statement in code(path) if "save_actor(" not in ast.unparse(statement)]
    assert len(loads) == len(code(path)) - 1
    assert PRINTS["custom_decoder"] in run("\n".join(loads), tmp_path)
