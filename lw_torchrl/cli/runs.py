"""Experiments from the command line: run by run, here, in several processes or on a Ray cluster, then a summary."""

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
from typing import Annotated, Any, Literal

from tyro.conf import OmitArgPrefixes

import lw_torchrl as lw
from lw_torchrl._checks import check_choice
from lw_torchrl.cli.options import check_folder, use_one_thread
from lw_torchrl.cli.output import Output
from lw_torchrl.cli.parsing import IMPORTED

Job = Callable[[], Any]
"""Does a run, whose :class:`EvaluationResult` it returns, or makes what several runs share."""
Launcher = Literal["local", "ray"]


@dataclass(frozen=True)
class Schedule:
    """Which runs are done, and where."""

    launcher: Launcher = "local"  # local, on this machine; ray, on a Ray cluster, or on all cores of this machine.
    jobs: int = 1  # runs at a time, by the launcher local.
    run: str | None = None  # do this run alone, of the names that --list prints.
    list: bool = False  # print the names of the runs and do nothing.

    def check(self, out: Path) -> None:
        """Raise :class:`ValueError` for options that exclude each other, or where nothing can be written."""
        if not self.list:
            check_folder("--out", out)
        elif self.run is not None:
            raise ValueError("--list names the runs and does none, --run does one: give one of them")

    def execute(
        self,
        output: Output,
        shared: Sequence[Mapping[str, Job]],
        runs: Sequence[Mapping[str, Job]],
        command: Sequence[str],
        summarize: Callable[[], Mapping[str, Any]],
        told: Callable[[lw.EvaluationResult], str] = lambda result: "",
    ) -> Output:
        """Do what is asked for; the summary is written when all runs are done.

        ``shared`` are stages of jobs, by their names, that runs share; a run does what it lacks of them itself.
        ``command`` lists the same runs in another process; ``told`` makes more lines of a run's result.
        """
        every = {name: job for stage in (*shared, *runs) for name, job in stage.items()}
        names = [name for stage in runs for name in stage]
        if self.list:
            return output.show("runs", [*every], "\n".join(every))
        use_one_thread()

        def line(name: str) -> tuple[lw.EvaluationResult | None, str]:
            result = every[name]()
            if name not in names:
                return None, name
            said = f"{name}: mean success {result.mean_success:.3f}, {result.config['seconds']:.0f} s"
            return result, "\n".join(filter(None, (said, told(result))))

        if self.run is not None:
            result, said = line(check_choice("run", self.run, every))
            output.show("run", self.run)
            if result is not None:
                print(said)
                if output.as_json:
                    output.result(result)
            return output
        if self.launcher == "local" and self.jobs == 1:
            _report(len(names), (line(name)[1] for name in names))
        else:
            for stage in map(list, (*shared, *runs)):
                commands = [[*command, "--run", name] for name in stage]
                ended = run_commands(commands, self.launcher, self.jobs)
                _report(len(stage), (printed.strip() or stage[index] for index, printed in ended))
        return output.show("summaries", summarize())


Scheduled = Annotated[Schedule, OmitArgPrefixes]
"""The options of a :class:`Schedule`, of a command."""


def command_line(*words: str, **options: Any) -> list[str]:
    """A command as it is typed; options that are None, or lists of nothing, are left out."""
    found = [*words, *(word for name in IMPORTED for word in ("--import", name))]
    for name, value in options.items():
        values = value if isinstance(value, tuple) else () if value is None else (value,)
        found += [f"--{name.replace('_', '-')}", *map(str, values)] if values else []
    return found


def _report(total: int, lines: Iterator[str]) -> None:
    """Print what each run says as it ends, and how long the others will take."""
    started = time.perf_counter()
    for number, line in enumerate(lines, 1):
        left = (time.perf_counter() - started) / number * (total - number)
        print(f"[{number}/{total}] {line}; about {left / 60:.0f} min left", flush=True)


def run_command(arguments: Sequence[str]) -> str:
    """Run ``lw-torchrl`` with these arguments in a process of its own, on one core; return what it printed."""
    command, env = [sys.executable, "-m", "lw_torchrl", *arguments], os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        said = "\n".join(done.stderr.splitlines()[-5:])
        raise RuntimeError(f"lw-torchrl {' '.join(arguments)} failed:\n{said}")
    return done.stdout


def run_commands(commands: Sequence[Sequence[str]], launcher: Launcher, jobs: int) -> Iterator[tuple[int, str]]:
    """Run commands, several at a time; yield the index and the output of each as it ends, then raise the first error.

    Launcher "local" has ``jobs`` processes; "ray" a task of one core each, on the cluster that RAY_ADDRESS names, whose
    machines must see the same files, or on this machine.
    """
    failed: Exception | None = None
    for index, outcome in _ray(commands) if launcher == "ray" else _local(commands, jobs):
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
        raise ImportError("launcher 'ray' needs the extra [ray]: pip install 'lw_torchrl[ray]'") from error
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
                yield index, getattr(error, "cause", None) or error  # what the task raised, without Ray's traceback
    finally:
        if started:
            ray.shutdown()
