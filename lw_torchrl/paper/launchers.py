"""Where commands run: in processes of this machine, or as tasks of a Ray cluster."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Literal

Launcher = Literal["local", "ray"]


def run_command(arguments: Sequence[str]) -> str:
    """Run ``lw-torchrl`` with these arguments in a process of its own, on one core; return what it printed.

    Raises:
        RuntimeError: it failed, with the end of what it said.
    """
    done = subprocess.run(
        [sys.executable, "-m", "lw_torchrl", *arguments],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        said = "\n".join(done.stderr.splitlines()[-5:])
        raise RuntimeError(f"lw-torchrl {' '.join(arguments)} failed:\n{said}")
    return done.stdout


def run_commands(commands: Sequence[Sequence[str]], launcher: Launcher, jobs: int) -> Iterator[tuple[int, str]]:
    """Run commands, several at a time; yield the index and the output of each as it ends.

    A command that fails does not stop the others that run; once they have ended, the first error is raised.

    Args:
        commands: arguments of ``lw-torchrl`` each.
        launcher: "local", ``jobs`` processes; "ray", a task of one core each, on the cluster that RAY_ADDRESS names or
            on this machine. A cluster's machines must see the same files.
        jobs: of "local".

    Raises:
        RuntimeError: a command failed.
        ImportError: "ray" without the extra ``[ray]``.
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
