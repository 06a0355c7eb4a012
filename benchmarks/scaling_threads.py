"""Benchmarks of the simulation with several threads, compared with the upper limit, several processes."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Sequence
from contextlib import contextmanager
from statistics import median
from time import perf_counter
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch

import lw_torchrl as lw
from benchmarks.report import Row, Settings
from lw_torchrl._util.workers import available_cores
from lw_torchrl.suites.metaworld import simulated_rows
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

ROUNDS = 7
ROWS_OF_A_PROCESS = 50
LEAST = {50: 0.55, 400: 0.75}  # minimum fraction of the limit for 16 threads, by number of rows
MOST_SERIAL = 0.06  # maximum serial share of a step of 400 rows on two cores


def rows(threads: Sequence[int], sizes: Sequence[int] = (50, 400), seconds: float = 0.5) -> list[dict[str, Any]]:
    """Measure steps per second of the engine (compiled, and in Python threads) and of ``LanguageWorldEnv``.

    For each size and number of threads, the contenders run in turn, ``seconds`` at a time. ``limit`` is the rate of the
    same number of processes, with 50 rows and one thread each. ``serial`` is the share of the compiled engine's step in
    which one thread works and the others wait.
    """
    torch.set_num_threads(1)
    limits = {count: _processes(count, seconds) for count in threads}
    return [_measure(n, count, limits[count], seconds) for n in sizes for count in threads]


def threads(settings: Settings) -> list[Row]:
    """Compare 1, 2, 4, 8 and 16 threads, up to the number of cores, with as many processes and with one thread."""
    counts = [count for count in (1, 2, 4, 8, 16) if count <= available_cores()]
    found = rows(counts, (5,) if settings.quick else (50, 400), seconds=0.02 if settings.quick else 0.5)
    lines = []
    for line in found:
        n, count, ours = line["rows"], line["threads"], line["compiled"]
        name = f"engine, N = {n}, {count} thread{'s' * (count > 1)}"
        one = next(other["compiled"] for other in found if other["rows"] == n)
        least = LEAST.get(n) if count == 16 else None
        lines.append(_rate(name, ours, f"{count} processes, the limit", line["limit"], least))
        lines.append(_rate(name, ours, "Python threads", line["python"], {50: 1.0, 400: 1.1}.get(n * (count == 1))))
        if count > 1:
            lines.append(_rate(name, ours, "1 thread", one, 1.8 if count == 2 else None))
        most = MOST_SERIAL if (n, count) == (400, 2) else None
        share, met = line["serial"], None if most is None else line["serial"] <= most
        lines.append(
            Row(f"{name}: serial share of a step", share, "", target="" if most is None else "≤ 0.06", met=met)
        )
    return lines


def _rate(name: str, ours: float, rival: str, theirs: float, least: float | None) -> Row:
    ratio = ours / theirs
    target, met = ("", None) if least is None else (f"ratio ≥ {least:g}", ratio >= least)
    return Row(name, ours, "steps/s", rival, theirs, ratio, target=target, met=met)


def _tasks(n: int) -> list[str]:
    return [lw.MT50[row % len(lw.MT50)] for row in range(n)]


def _actions(n: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (16, n, 4)).astype(np.float32)


class _Engine:
    """A contender that steps an engine."""

    def __init__(self, engine: VectorizedEngine, n: int) -> None:
        self.n, self.engine, self.number, self.parallel = n, engine, 0, 0.0
        self.engine.reset(range(n), range(n))
        self._actions, self._active = _actions(n), np.ones(n, dtype=bool)
        run = engine._pool.run

        def timed(*arguments: Any) -> None:
            start = perf_counter()
            run(*arguments)
            self.parallel += perf_counter() - start

        engine._pool.run = timed  # type: ignore[method-assign]

    def step(self) -> None:
        self.engine.step(self._actions[self.number % len(self._actions)], self._active)
        self.number += 1


class _Env:
    """A contender that steps a ``LanguageWorldEnv`` as TorchRL's collectors do."""

    def __init__(self, n: int, threads: int) -> None:
        self.n, self.number = n, 0
        self.env = lw.LanguageWorldEnv(lw.MT50[:n], num_envs=n, num_threads=threads, max_steps=10**6)
        self._state, self._actions = self.env.reset(), torch.from_numpy(_actions(n))

    def step(self) -> None:
        self._state["action"] = self._actions[self.number % len(self._actions)]
        self._state = self.env.step_and_maybe_reset(self._state)[1]
        self.number += 1


def _play(contender: Any, seconds: float) -> float:
    """Step a contender for ``seconds``; return the steps per second, summed over rows."""
    start, number = perf_counter(), 0
    while (passed := perf_counter() - start) < seconds:
        contender.step()
        number += 1
    return number * contender.n / passed


@contextmanager
def _without_kernel() -> Any:
    find = simulated_rows.find_row_kernel
    simulated_rows.find_row_kernel = lambda: None  # type: ignore[assignment]
    try:
        yield
    finally:
        simulated_rows.find_row_kernel = find


def _measure(n: int, threads: int, limit: float, seconds: float) -> dict[str, Any]:
    with _without_kernel():
        python = VectorizedEngine(_tasks(n), num_threads=threads)
    env = _Env(n, threads)
    contenders = {"compiled": _Engine(env.env.engine, n), "python": _Engine(python, n), "env": env}
    rates: dict[str, list[float]] = {name: [] for name in contenders}
    shares = []
    for number in range(-1, ROUNDS):
        for name, contender in contenders.items():
            contenders["compiled"].parallel = 0.0
            start = perf_counter()
            rate = _play(contender, seconds)
            if number >= 0:
                rates[name].append(rate)
            if number >= 0 and name == "compiled":
                shares.append(1 - contender.parallel / (perf_counter() - start))
    env.env.close()
    python.close()
    found = {name: round(median(rate)) for name, rate in rates.items()}
    return {
        "rows": n,
        "threads": threads,
        **found,
        "limit": round(limit),
        "of the limit": round(found["compiled"] / limit, 3),
        "serial": round(median(shares), 3),
    }


def _processes(count: int, seconds: float) -> float:
    """Return the total steps per second of ``count`` processes."""
    context = multiprocessing.get_context("spawn")
    barrier, rates = context.Barrier(count), context.Queue()
    processes = [context.Process(target=_one_process, args=(barrier, rates, seconds)) for _ in range(count)]
    for process in processes:
        process.start()
    total = sum(rates.get(timeout=120) for _ in processes)
    for process in processes:
        process.join()
    return total


def _one_process(barrier: Any, rates: Any, seconds: float) -> None:
    engine = _Engine(VectorizedEngine(_tasks(ROWS_OF_A_PROCESS), num_threads=1), ROWS_OF_A_PROCESS)
    _play(engine, 0.2)
    barrier.wait(120)
    rates.put(median(_play(engine, seconds) for _ in range(ROUNDS)))
    barrier.wait(120)


if __name__ == "__main__":
    cores = available_cores()
    for line in rows([count for count in (1, 2, 4, 8, 16) if count <= cores]):
        print(line, flush=True)
