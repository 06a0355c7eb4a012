"""python -m benchmarks.argument_checks: count the lines that check arguments or build error messages, by folder."""

from __future__ import annotations

import ast
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

PACKAGE = Path(__file__).resolve().parents[1] / "lw_torchrl"


@dataclass(frozen=True)
class Arguments:
    """Count lines that check arguments or build error messages: ``raise``, ``if`` blocks that only raise, functions and
    statements named check..., decorators that check annotations, and all lines of checks.py."""

    package: Path = PACKAGE
    """Folder of a package."""


def checking_nodes(tree: ast.AST) -> Iterator[ast.stmt | ast.expr]:
    """Yield the parts of a file that only check or raise."""
    for node in ast.walk(tree):
        only_raises = isinstance(node, ast.If) and not node.orelse and all(isinstance(b, ast.Raise) for b in node.body)
        if isinstance(node, ast.Raise) or only_raises:
            yield node
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            if isinstance(node, ast.FunctionDef) and re.match("_?check(?!sum|point)", node.name):
                yield node
            yield from (d for d in node.decorator_list if ast.unparse(d).startswith(("typed", "checked", "beartype")))
        elif isinstance(node, ast.Expr) and re.match(r"(\w+\.)*_?check\w*\(", ast.unparse(node)):
            yield node


def checking_lines(path: Path) -> int:
    """Return the number of lines of a file that check arguments or build error messages."""
    text = path.read_text("utf-8")
    if path.name.endswith("checks.py"):
        return len(text.splitlines())
    spans = [range(node.lineno, (node.end_lineno or node.lineno) + 1) for node in checking_nodes(ast.parse(text))]
    return len({line for span in spans for line in span})


def main(args: Arguments) -> None:
    checking: Counter[str] = Counter()
    lines: Counter[str] = Counter()
    for path in sorted(args.package.rglob("*.py")):
        folder = path.relative_to(args.package).parts[0]
        checking[folder] += checking_lines(path)
        lines[folder] += len(path.read_text("utf-8").splitlines())
    for folder, count in [*checking.most_common(), ("total", checking.total())]:
        total = lines[folder] if folder != "total" else lines.total()
        print(f"{folder:20} {count:6} of {total:6} lines {count / max(total, 1):6.1%}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
