"""python -m benchmarks.mutants BEFORE AFTER: check that the tests of two checkouts find the same planted errors."""

from __future__ import annotations

import ast
import os
import random
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import tyro

from lw_torchrl._util.files import write_json

PACKAGE = "lw_torchrl"
OPERATORS: dict[type[ast.AST], str] = {
    ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.In: "not in",
    ast.And: "or", ast.Or: "and", ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*",
}  # fmt: skip


TOP = ("test_checks.py", "test_files.py", "test_importing.py", "test_progress.py", "test_registry.py")
"""The tests of modules that all folders use."""


class Mutant(NamedTuple):
    """A mutant: one changed line of a function."""

    folder: str
    function: str
    line: str
    changed: str


@dataclass(frozen=True)
class Arguments:
    """Change one line of the package at a time, and report which changes the tests of two checkouts find."""

    before: tyro.conf.Positional[Path]
    """Folder of the earlier checkout."""
    after: tyro.conf.Positional[Path]
    """Folder of the later checkout. Only lines that both have, in functions with the same name, are changed."""
    seed: int = 0
    """Seed that chooses the lines."""
    count: int = 20
    """Number of lines, spread evenly over the folders of the package."""
    timeout: int = 900
    """Time limit in seconds for the tests of one folder; a test that hangs counts as finding the mutant."""
    out: Path = Path("runs/mutants.json")
    """File for the results."""


def mutants_of(root: Path) -> dict[Mutant, tuple[Path, int]]:
    """Return every mutant of a checkout with its file and line number, if its line is unique in its function."""
    places: dict[Mutant, list[tuple[Path, int]]] = {}
    for path in sorted((root / PACKAGE).rglob("*.py")):
        parts = path.relative_to(root / PACKAGE).parts
        folder = parts[0] if len(parts) > 1 and not parts[0].startswith("_") else ""
        text = path.read_text("utf-8")
        lines = text.splitlines()
        for function in ast.walk(ast.parse(text)):
            if isinstance(function, ast.FunctionDef):
                for number, changed in _changes(function, lines):
                    mutant = Mutant(folder, function.name, lines[number].strip(), changed.strip())
                    places.setdefault(mutant, []).append((path, number))
    return {mutant: found[0] for mutant, found in places.items() if len(found) == 1}


def _operands(node: ast.AST) -> tuple[ast.AST, ast.expr, ast.expr] | None:
    """Return the first operator of an expression and its left and right operands."""
    if isinstance(node, ast.Compare):
        return node.ops[0], node.left, node.comparators[0]
    if isinstance(node, ast.BoolOp):
        return node.op, node.values[0], node.values[1]
    if isinstance(node, ast.BinOp):
        return node.op, node.left, node.right
    return None


def _changes(function: ast.FunctionDef, lines: list[str]) -> Iterator[tuple[int, str]]:
    """Yield (number, line) for lines of a function's body with one operator, number or truth value changed."""
    for node in (inner for statement in function.body for inner in ast.walk(statement)):
        number = getattr(node, "lineno", 0) - 1
        line = lines[number]
        if not line.isascii():  # ast counts bytes
            continue
        if (operands := _operands(node)) is not None:
            operator, left, right = operands
            between = line[left.end_col_offset : right.col_offset]
            if type(operator) in OPERATORS and left.end_lineno == right.lineno == node.end_lineno:  # type: ignore[attr-defined]
                changed = between.replace(between.strip(" ()"), OPERATORS[type(operator)])
                yield number, line[: left.end_col_offset] + changed + line[right.col_offset :]
        elif isinstance(node, ast.Constant) and isinstance(node.value, int):
            changed = str(not node.value) if isinstance(node.value, bool) else str(node.value + 1)
            yield number, line[: node.col_offset] + changed + line[node.end_col_offset :]


def choose(before: Path, after: Path, seed: int, count: int) -> list[Mutant]:
    """Return mutants of lines that both checkouts have, cycling over the folders, in a random order."""
    places = mutants_of(after)
    common = sorted(set(mutants_of(before)) & set(places))
    draws = random.Random(seed)
    draws.shuffle(common)
    by_folder: dict[str, list[Mutant]] = {}
    for mutant in common:
        by_folder.setdefault(mutant.folder, []).append(mutant)
    chosen: list[Mutant] = []
    while len(chosen) < count and any(by_folder.values()):
        for folder in sorted(by_folder):
            if by_folder[folder] and len(chosen) < count:
                mutant = by_folder[folder].pop()
                with suppress(SyntaxError):  # before Python 3.12 the positions within f-strings are wrong
                    ast.parse("".join(_with(mutant, *places[mutant])))
                    chosen.append(mutant)
    return chosen


def _with(mutant: Mutant, path: Path, number: int) -> list[str]:
    """Return the lines of a file with the mutant's line changed."""
    lines = path.read_text("utf-8").splitlines(keepends=True)
    indent = lines[number][: len(lines[number]) - len(lines[number].lstrip())]
    lines[number] = indent + mutant.changed + "\n"
    return lines


def finding_test(root: Path, mutant: Mutant, timeout: int) -> str:
    """Return the first test of the mutant's folder, or of the modules that all use, that fails, or an empty string."""
    path, number = mutants_of(root)[mutant]
    text = path.read_text("utf-8")
    path.write_text("".join(_with(mutant, path, number)), "utf-8")
    tests = (
        [f"tests/{mutant.folder}"]
        if mutant.folder
        else [f"tests/{name}" for name in TOP if (root / "tests" / name).is_file()]
    )
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-m", "not slow", "-p", "no:cacheprovider", *tests]
    environment = os.environ | {"PYTHONPATH": str(root.resolve()), "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=timeout)
    except subprocess.TimeoutExpired:
        return "time limit"
    finally:
        path.write_text(text, "utf-8")
        for cache in Path(root, PACKAGE).rglob("__pycache__"):
            shutil.rmtree(cache, ignore_errors=True)
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return "" if done.returncode == 0 else failed[1] if failed else f"exit status {done.returncode}"


def main(args: Arguments) -> int:
    chosen = choose(args.before, args.after, args.seed, args.count)
    rows, different = [], 0
    checkouts = {"before": args.before, "after": args.after}
    for mutant in chosen:
        with ThreadPoolExecutor() as pool:
            runs = {name: pool.submit(finding_test, root, mutant, args.timeout) for name, root in checkouts.items()}
        found = {name: run.result() for name, run in runs.items()}
        different += bool(found["before"]) != bool(found["after"])
        print(f"{mutant.folder or '_util'}: {mutant.function}: {mutant.line}  ->  {mutant.changed}")
        for name, test in found.items():
            print(f"    {name:6} {'found by ' + test if test else 'not found'}", flush=True)
        rows.append({**mutant._asdict(), **found})
        write_json(args.out, {"seed": args.seed, "mutants": rows})
    print(f"{len(chosen)} mutants, found by only one of the two: {different}")
    return int(different > 0)


if __name__ == "__main__":
    raise SystemExit(main(tyro.cli(Arguments)))
