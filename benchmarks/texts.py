"""python -m benchmarks.texts: draw docstrings, error messages and help texts at random, for a reader to judge."""

from __future__ import annotations

import ast
import random
import subprocess
from dataclasses import dataclass
from pathlib import Path

import tyro

PACKAGE = Path(__file__).resolve().parents[1] / "lw_torchrl"


@dataclass(frozen=True)
class Arguments:
    """Print texts of the package, drawn at random."""

    count: int = 100
    """Number of texts."""
    seed: str = ""
    """Seed of the draw; the hash of the current commit by default."""


def texts_of(path: Path) -> list[tuple[int, str, str]]:
    """Return (line, kind, text) of each docstring, text under a field, and raised message of a file."""
    tree = ast.parse(path.read_text("utf-8"))
    texts = []
    for node in ast.walk(tree):
        if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
            if docstring := ast.get_docstring(node):
                texts.append((node.body[0].lineno, "docstring", docstring.partition("Example:")[0].strip()))
            for field, text in zip(node.body, node.body[1:], strict=False):
                described = isinstance(field, (ast.AnnAssign, ast.Assign)) and isinstance(text, ast.Expr)
                if described and isinstance(text.value, ast.Constant) and isinstance(text.value.value, str):
                    texts.append((text.lineno, "help", text.value.value))
        elif isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call) and node.exc.args:
            texts.append((node.lineno, "message", ast.unparse(node.exc.args[0])))
    return texts


def main(args: Arguments) -> None:
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=PACKAGE, capture_output=True, text=True, check=True)
    texts = [(path, *text) for path in sorted(PACKAGE.rglob("*.py")) for text in texts_of(path)]
    for number, (path, line, kind, text) in enumerate(
        random.Random(args.seed or commit.stdout.strip()).sample(texts, args.count), 1
    ):
        print(f"[{number}] {kind}, {path.relative_to(PACKAGE.parent)}:{line}\n{text}\n")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
