"""Split episodes over worker processes, because Meta-World's experts and other Python code use one core per process.

The workers are forked from a server process (multiprocessing's "forkserver") that imports the library once and starts
no threads; a fork of this process would copy locks that other threads hold. Each worker waits in a thread for the end
of a pipe, so that it ends with this process, however this process ends.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, TypeVar

import cloudpickle
import torch

from lw_torchrl.suites.metaworld.simulated_rows import available_cores

Episodes = Mapping[str, Sequence[int]]  # the indices of each task's episodes
T = TypeVar("T")

WORTHWHILE = 60_000  # time steps from which workers save more time than they take to start: about 20 s on one core
_LARGEST = 64  # episodes per part; with more, progress would be coarse, and an interruption would lose more work
_PARTS = 3  # parts per worker, because some tasks take longer than others
_PRELOAD = ["lw_torchrl.evaluation.rollout", "lw_torchrl.data.collect", "metaworld"]


def split(episodes: Episodes, workers: int) -> list[dict[str, Sequence[int]]]:
    """Split episodes into parts of about equal size. A part holds few tasks, because a simulator is made for each."""
    size = max(1, min(_LARGEST, sum(map(len, episodes.values())) // (_PARTS * workers)))
    parts: list[dict[str, Sequence[int]]] = []
    room = 0
    for task, listed in episodes.items():
        pieces = -(-len(listed) // size)
        for piece in range(pieces):
            chosen = listed[piece * len(listed) // pieces : (piece + 1) * len(listed) // pieces]
            if len(chosen) > room:
                parts.append({})
                room = size
            parts[-1][task] = chosen
            room -= len(chosen)
    return parts


def spread(
    run: Callable[[Episodes, Callable[[int], object]], Iterable[T]],
    episodes: Episodes,
    on_steps: Callable[[int], object],
    *,
    workers: int | None,
    max_steps: int,
    alone: bool = False,
) -> Generator[T]:
    """Yield the items of ``run(episodes, on_steps)``, computed for parts of the episodes in worker processes.

    Errors of a worker are raised here, with a note that lists the part's episodes; warnings are issued here.

    Args:
        run: a function that runs episodes and calls ``on_steps`` with the number of new time steps. In workers, a copy
            runs for each part, and the items are pickled.
        episodes: the indices of each task's episodes.
        workers: number of processes, 1 for this process only. None for one per core, or for this process only if the
            episodes have few time steps, ``run`` cannot be pickled, or this process is a worker itself.
        max_steps: maximum number of time steps of an episode.
        alone: whether None means this process only.

    Raises:
        ValueError: ``run`` cannot be pickled.
        RuntimeError: a worker was killed.
    """
    number = workers
    if number is None:
        pays = sum(map(len, episodes.values())) * max_steps >= WORTHWHILE
        number = available_cores() if pays and not alone and multiprocessing.parent_process() is None else 1
    parts, pickled = split(episodes, number), b""
    if min(number, len(parts)) > 1:
        try:
            pickled = cloudpickle.dumps(run)
        except Exception as error:
            if workers is not None:
                reason = f"{type(error).__name__}: {error}"
                raise ValueError(f"workers={workers} requires a policy that can be pickled ({reason})") from error
    yield from _in_workers(pickled, parts, number, on_steps) if pickled else run(episodes, on_steps)


def _in_workers(pickled: bytes, parts: list[Any], workers: int, on_steps: Callable[[int], object]) -> Iterator[Any]:
    context: Any = multiprocessing.get_context("forkserver" if os.name == "posix" else "spawn")
    alive, end = context.Pipe(duplex=False)
    steps, report = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(min(workers, len(parts)), context, _start, (pickled, alive, report))
    try:
        with _starting(context):
            running: dict[Future[Any], Any] = {pool.submit(_work, part): part for part in parts}
        while running:
            done = wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done
            while steps.poll():
                on_steps(steps.recv())
            for future in done:
                yield from _items(future, running.pop(future))
    except BrokenProcessPool as error:
        advice = "repeat the call; if memory is short, use fewer workers"
        raise RuntimeError(f"a worker process was killed, for example because memory was short: {advice}") from error
    finally:
        end.close()  # ends the workers at once
        pool.shutdown(cancel_futures=True)
        for connection in (alive, steps, report):
            connection.close()


@contextmanager
def _starting(context: Any) -> Iterator[None]:
    """Keep the processes that are started from importing the user's script and from reacting to Ctrl-C."""
    if context.get_start_method() == "forkserver":
        context.set_forkserver_preload(_PRELOAD)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    script, sys.modules["__main__"] = sys.modules["__main__"], ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _items(future: Future[bytes], part: Episodes) -> list[Any]:
    """Return a part's items, and issue its warnings."""
    try:
        items, caught = pickle.loads(future.result())
    except BrokenProcessPool:
        raise
    except Exception as error:
        listed = "; ".join(f"{task} {', '.join(map(str, episodes))}" for task, episodes in part.items())
        error.add_note(f"raised in a worker process, in one of these episodes: {listed}")
        raise
    for message, category in caught:
        warnings.warn(message, category, stacklevel=2)
    return items


# In a worker process
_pickled = b""
_report: Connection


def _start(pickled: bytes, alive: Connection, report: Connection) -> None:
    global _pickled, _report
    _pickled, _report = pickled, report
    torch.set_num_threads(1)
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()


def _end_with(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _work(part: Episodes) -> bytes:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        items = list(pickle.loads(_pickled)(part, _report.send))
    return pickle.dumps((items, [(str(warning.message), warning.category) for warning in caught]))
