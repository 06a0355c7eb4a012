"""python -m benchmarks [NAMES...] [--quick] [--compile] [--out runs/benchmarks] [--markdown], or scaling [--gpu]"""

from __future__ import annotations

import gc
import json
import os
import platform
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter, strftime
from typing import Annotated, Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # otherwise torch and the simulation would compete for the cores

import torch
import tyro

from benchmarks import (
    environment,
    language,
    large,
    pipelines,
    recording,
    sampling,
    scaling,
    scaling_threads,
    simulation,
    training,
)
from benchmarks.report import Row, Settings, Skipped, as_markdown, as_text
from lw_torchrl._util.files import write_json, write_text
from lw_torchrl.suites.metaworld.simulated_rows import available_cores

BENCHMARKS: dict[str, Callable[[Settings], list[Row]]] = {
    "steps": simulation.steps,
    "threads": scaling_threads.threads,
    "gym_wrapper": environment.gym_wrapper,
    "envpool": environment.envpool,
    "overhead": environment.overhead,
    "reset": environment.reset,
    "construction": environment.construction,
    "large": large.large,
    "queries": language.queries,
    "branches": language.branches,
    "skills": language.skills,
    "samplers": sampling.samplers,
    "train_step": training.train_step,
    "evaluation": pipelines.evaluation,
    "collection": pipelines.collection,
    "recording": recording.recording,
}
PACKAGES = ("lw_torchrl", "metaworld", "mujoco", "numpy", "torch", "torchrl", "tensordict", "envpool")
FORMAT_VERSION = 1


@dataclass(frozen=True)
class Arguments:
    """Measure speed and memory against alternatives in the same run; see benchmarks/results/performance.md."""

    names: tyro.conf.Positional[tuple[str, ...]] = ()
    """Benchmarks to run, all by default; see benchmarks/results/performance.md for their names."""
    quick: bool = False
    """Run a small version as a test; its numbers are meaningless."""
    compiled: Annotated[bool, tyro.conf.arg(name="compile")] = False
    """Also measure torch.compile."""
    out: Path = Path("runs/benchmarks")
    """Folder for results.json and table.md."""
    markdown: bool = False
    """Print the table of existing results as Markdown instead of running benchmarks."""


def _machine() -> dict[str, Any]:
    found: dict[str, Any] = {
        "python": platform.python_version(),
        "system": platform.system(),
        "cores": available_cores(),
    }
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        models = [
            line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if line[:10] == "model name"
        ]
        found["processor"] = models[0] if models else platform.machine()
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = None
    if hasattr(os, "getloadavg"):
        found["load"] = round(os.getloadavg()[0], 2)
    return found


def _run(name: str, settings: Settings) -> dict[str, Any]:
    """Run one benchmark; report an error instead of raising it, so that the others run."""
    start = perf_counter()
    result: dict[str, Any] = {"status": "done", "message": "", "rows": []}
    try:
        rows = BENCHMARKS[name](settings)
        # After a quick run, it is meaningless whether a target is met.
        result["rows"] = [(replace(row, met=None) if settings.quick else row).to_json() for row in rows]
    except Skipped as reason:
        result.update(status="skipped", message=str(reason))
    except Exception as error:
        traceback.print_exc()
        result.update(status="failed", message=f"{type(error).__name__}: {error}")
    result["seconds"] = round(perf_counter() - start, 2)
    gc.collect()
    return result


def _rows(report: dict[str, Any]) -> list[Row]:
    return [Row(**row) for result in report["benchmarks"].values() for row in result["rows"]]


def main(arguments: list[str] | None = None) -> int:
    """Run benchmarks; return 1 if one raised an error. A missed target is not a failure."""
    given = sys.argv[1:] if arguments is None else arguments
    if given[:1] == ["scaling"]:
        return scaling.main(given[1:])
    args = tyro.cli(Arguments, args=arguments, prog="python -m benchmarks")
    results = args.out / "results.json"
    if args.markdown:
        if not results.is_file():
            print(f"no results in {str(args.out)!r}: run the benchmarks first", file=sys.stderr)
            return 2
        print(as_markdown(_rows(json.loads(results.read_text("utf-8")))), end="")
        return 0
    if unknown := [name for name in args.names if name not in BENCHMARKS]:
        print(f"no benchmark {', '.join(unknown)}; there are {', '.join(BENCHMARKS)}", file=sys.stderr)
        return 2
    torch.set_num_threads(1)
    warnings.filterwarnings("ignore", message="Constant\\(s\\) may be too high")
    settings = Settings(args.quick, args.compiled, args.out)
    report: dict[str, Any] = {
        "format_version": FORMAT_VERSION,
        "when": strftime("%Y-%m-%dT%H:%M:%S%z"),
        "quick": args.quick,
        "machine": _machine(),
        "benchmarks": {},
    }
    names = list(args.names or BENCHMARKS)
    for number, name in enumerate(names, 1):
        print(f"[{number}/{len(names)}] {name} ...", file=sys.stderr, flush=True)
        result = report["benchmarks"][name] = _run(name, settings)
        told = f": {result['message']}" if result["message"] else ""
        print(f"[{number}/{len(names)}] {name} {result['status']}, {result['seconds']} s{told}", file=sys.stderr)
        write_json(results, report)  # after each benchmark, so that a killed process loses only one
        write_text(args.out / "table.md", as_markdown(_rows(report)))
    print(as_text(_rows(report)))
    print(f"\nwritten to {results} and {args.out / 'table.md'}")
    return int(any(result["status"] == "failed" for result in report["benchmarks"].values()))


if __name__ == "__main__":
    sys.exit(main())
