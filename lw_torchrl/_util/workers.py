"""Split episodes over worker processes, because Meta-World's experts and other Python code use one core per process.

The workers are forked from a server process (multiprocessing's "forkserver") that imports the library once and starts
no threads; a fork of this process would copy locks that other threads hold. A thread in each worker waits until a pipe
from this process closes, so that the worker exits even if this process is killed.
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
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from types import ModuleType
from typing import Any, TypeVar

import cloudpickle

Episodes = Mapping[str, Sequence[int]]  # the indices of each task's episodes
T = TypeVar("T")

START = 30_000  # time steps that one core simulates while the workers start and compile models
_THREADED = 0.64  # measured time of this process with several simulation threads, relative to one thread
_PRELOAD = ["lw_torchrl.evaluation.rollout", "lw_torchrl.data.collect", "metaworld"]


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def choose_workers(workers: int | None, time_steps: int) -> int:
    """Return ``workers`` unless it is None. Otherwise return the number of cores if that many workers save time and
    this process is not a worker itself, else 1."""
    if workers is not None:
        return workers
    cores = available_cores()
    pays = time_steps * (_THREADED - 1 / cores) >= START  # true from 220,000 steps on 2 cores, or 55,000 on 16
    return cores if pays and multiprocessing.parent_process() is None else 1


def start_early(workers: int | None, time_steps: int) -> None:
    """Start the server of worker processes, if workers will be used, while this process still imports PyTorch."""
    if choose_workers(workers, time_steps) > 1:
        with _starting():
            forkserver.ensure_running()


def split(episodes: Episodes, workers: int, largest: int) -> list[dict[str, list[int]]]:
    """Split episodes into parts of nearly equal size: at least one part per worker if there are enough, and at most
    ``largest`` episodes per part.

    A part contains few tasks, because each task takes time to set up.
    """
    listed = [(task, episode) for task, numbers in episodes.items() for episode in numbers]
    number = min(len(listed), workers * -(-len(listed) // (workers * largest)))
    parts: list[dict[str, list[int]]] = [{} for _ in range(number)]
    for place, (task, episode) in enumerate(listed):
        parts[place * number // len(listed)].setdefault(task, []).append(episode)
    return parts


def spread(
    run: Callable[[Episodes, Callable[[int], object]], Iterable[T]],
    episodes: Episodes,
    on_steps: Callable[[int], object],
    *,
    workers: int | None,
    max_steps: int,
    largest: int,
    alone: bool = False,
) -> Generator[T]:
    """Yield the items of ``run(episodes, on_steps)``, computed for parts of the episodes in worker processes.

    ``run`` calls ``on_steps`` with the number of new time steps. Each part has at most ``largest`` episodes; a
    worker runs a pickled copy of ``run`` on the part and returns the part's items together. Errors and warnings of
    workers are raised in this process; an error has a note that lists the part's episodes. ``workers`` is the number of
    processes; 1 runs everything in this process. None means one per core, or only this process if workers would not
    save time for episodes of ``max_steps`` time steps, if ``run`` cannot be pickled, or if ``alone`` is true.

    Raise a :class:`ValueError` if ``run`` cannot be pickled, and a :class:`RuntimeError` if a worker was killed.
    """
    time_steps = sum(map(len, episodes.values())) * max_steps
    number = 1 if alone and workers is None else choose_workers(workers, time_steps)
    parts, pickled = split(episodes, number, largest), b""
    if min(number, len(parts)) > 1:
        try:
            pickled = cloudpickle.dumps(run)
        except Exception as error:
            if workers is not None:
                reason = f"{type(error).__name__}: {error}"
                raise ValueError(f"workers={workers} requires a policy that can be pickled ({reason})") from error
    yield from _in_workers(pickled, parts, number, on_steps) if pickled else run(episodes, on_steps)


def _in_workers(pickled: bytes, parts: list[Any], workers: int, on_steps: Callable[[int], object]) -> Iterator[Any]:
    context = multiprocessing.get_context("forkserver")
    alive, end = context.Pipe(duplex=False)
    steps, report = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(min(workers, len(parts)), context, _start, (pickled, alive, report))
    try:
        with _starting():
            running: dict[Future[Any], Any] = {pool.submit(_work, part): part for part in parts}
            pool.submit(int)  # the executor watches only the processes that it started before the latest submission
        while running:
            done = wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done
            while steps.poll():
                on_steps(steps.recv())
            for future in done:
                yield from _items(future, running.pop(future))
    except BrokenProcessPool as error:
        advice = "repeat the call, with fewer workers if memory is low"
        raise RuntimeError(f"a worker process was killed, possibly because memory ran out: {advice}") from error
    finally:
        end.close()  # ends the workers at once
        pool.shutdown(cancel_futures=True)
        for connection in (alive, steps, report):
            connection.close()


@contextmanager
def _starting() -> Iterator[None]:
    """Prevent processes that are started in the block from importing the user's script and from reacting to Ctrl-C."""
    forkserver.set_forkserver_preload(_PRELOAD)
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
    threading.Thread(target=_end_with, args=(alive,), daemon=True).start()
    import torch  # here, because start_early must not wait for it

    torch.set_num_threads(1)


def _end_with(alive: Connection) -> None:
    alive.poll(None)
    os._exit(1)


def _work(part: Episodes) -> bytes:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        items = list(pickle.loads(_pickled)(part, _report.send))
    different = dict.fromkeys((str(warning.message), warning.category) for warning in caught)
    return pickle.dumps((items, list(different)))
