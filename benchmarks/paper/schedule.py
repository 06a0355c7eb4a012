"""Execute the runs of an experiment: one by one, in several processes, or as tasks of a Ray cluster."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch

from lw_torchrl._util.checks import check_choice
from lw_torchrl.evaluation import EvaluationResult

Job = Callable[[], Any]
"""A function that executes a run and returns its :class:`EvaluationResult`, or makes data that several runs share."""
Launcher = Literal["local", "ray"]
ROOT = Path(__file__).parents[2]


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """Options that all experiments share."""

    out: Path
    """Folder for all results. If the command is stopped, run it again to resume."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Random seeds of the data, the initial weights and the minibatches."""
    episodes: int = 20
    """Number of evaluation episodes per task, on seeds that no training used, with action noise 0.1."""
    list: bool = False
    """Print the names of the runs and stop."""
    run: str | None = None
    """Execute only the run with this name (see --list)."""
    jobs: int = 1
    """Number of simultaneous runs with --launcher local."""
    launcher: Launcher = "local"
    """Where to execute runs: local (processes on this machine), or ray (a Ray cluster whose machines share --out, or
    all cores of this machine)."""


def execute(
    schedule: Schedule,
    arguments: Sequence[str],
    shared: Sequence[Mapping[str, Job]],
    runs: Mapping[str, Job],
    summarize: Callable[[], None],
) -> None:
    """Execute all runs and write the summary; with ``--list``, print the runs; with ``--run``, execute a single run.

    Args:
        schedule: which runs to execute, and where.
        arguments: the command line; other processes get it with ``--run NAME`` added.
        shared: stages of jobs, by name, that make data for several runs. A run makes missing data itself.
        runs: the runs by name.
        summarize: a function that writes the summary, called after all runs.
    """
    jobs = {name: job for stage in (*shared, runs) for name, job in stage.items()}
    if schedule.list:
        print("\n".join(jobs))
        return
    torch.set_num_threads(1)

    def line(name: str) -> str:
        result = jobs[name]()
        if not isinstance(result, EvaluationResult):
            return name
        return f"{name}: mean success {result.mean_success:.3f}, {result.config['seconds']:.0f} s"

    if schedule.run is not None:
        print(line(check_choice("--run", schedule.run, jobs)))
        return
    if schedule.launcher == "local" and schedule.jobs == 1:
        _report(len(runs), map(line, runs))
    else:
        for stage in map(list, (*shared, runs)):
            commands = [[*arguments, "--run", name] for name in stage]
            ended = run_commands(commands, schedule.launcher, schedule.jobs)
            _report(len(stage), (printed.strip() for _, printed in ended))
    summarize()


def _report(total: int, lines: Iterator[str]) -> None:
    """Print a line when a run ends, with an estimate of the remaining time."""
    started = time.perf_counter()
    for number, line in enumerate(lines, 1):
        left = (time.perf_counter() - started) / number * (total - number)
        print(f"[{number}/{total}] {line}; about {left / 60:.0f} min left", flush=True)


def run_command(arguments: Sequence[str]) -> str:
    """Run ``python -m benchmarks.paper`` in a process on one core and return what it printed."""
    path = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    command = [sys.executable, "-m", "benchmarks.paper", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(f"{' '.join(command[2:])} failed:\n{done.stderr.strip()}")
    return done.stdout


def run_commands(commands: Sequence[Sequence[str]], launcher: Launcher, jobs: int) -> Iterator[tuple[int, str]]:
    """Run commands; yield the index and output of each when it ends. If one fails, raise an error at the end."""
    failed: Exception | None = None
    for index, outcome in _local(commands, jobs) if launcher == "local" else _ray(commands):
        if isinstance(outcome, Exception):
            failed = failed or outcome
        else:
            yield index, outcome
    if failed is not None:
        raise RuntimeError(str(failed)) from failed


def _local(commands: Sequence[Sequence[str]], jobs: int) -> Iterator[tuple[int, str | Exception]]:
    with ThreadPoolExecutor(jobs) as pool:
        futures = {pool.submit(run_command, command): index for index, command in enumerate(commands)}
        try:
            for future in as_completed(futures):
                yield futures[future], future.exception() or future.result()  # type: ignore[misc]
        finally:
            pool.shutdown(cancel_futures=True)


def _ray(commands: Sequence[Sequence[str]]) -> Iterator[tuple[int, str | Exception]]:
    try:
        import ray
    except ImportError as error:
        raise ImportError("--launcher ray needs Ray: pip install 'lw_torchrl[ray]'") from error
    started = not ray.is_initialized()
    if started:
        ray.init(log_to_driver=False, include_dashboard=False, logging_level=logging.WARNING)
    try:
        task = ray.remote(num_cpus=1, max_retries=3)(run_command)
        waiting = {task.remote(list(command)): index for index, command in enumerate(commands)}
        while waiting:
            (done,), _ = ray.wait(list(waiting), num_returns=1)
            index = waiting.pop(done)
            try:
                yield index, ray.get(done)
            except ray.exceptions.RayError as error:
                yield index, getattr(error, "cause", None) or error  # the task's own error, without Ray's traceback
    finally:
        if started:
            ray.shutdown()
