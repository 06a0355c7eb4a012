"""Benchmarks of LanguageWorldEnv: TorchRL's overhead, resets, construction, and other ways to run Meta-World."""

from __future__ import annotations

import json
import subprocess
import sys
import warnings
from collections.abc import Callable, Sequence
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.envs import Compose, EnvBase, StepCounter, TransformedEnv

import lw_torchrl as lw
from benchmarks.report import Row, Settings, Skipped, bars, compare, part_of, take_turns, timed, under
from lw_torchrl._util.workers import available_cores
from lw_torchrl.suites.engine import Engine, EngineStep
from lw_torchrl.suites.metaworld.environments import make_metaworld_env
from lw_torchrl.suites.metaworld.vectorized_engine import VectorizedEngine

_SMALL = ("reach", "push", "door-open")


class _OnlySimulates(lw.LanguageWorldEnv):
    """An environment that returns the same tensordict after every engine step, to measure only TorchRL's own time."""

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        n = self.batch_size[0]
        self._engine.step(tensordict.get("action").numpy(), np.ones(n, dtype=bool))
        if not hasattr(self, "_same"):
            self._same = self._rows.as_tensordict(reward=torch.zeros(n, 1))
        return self._same.copy()


class _Clock:
    """A factory of engines that measures the seconds spent in their steps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self, tasks: Sequence[str], **options: Any) -> Engine:
        engine = VectorizedEngine(tasks, **options)
        step = engine.step

        def counted(action: np.ndarray, active: np.ndarray) -> EngineStep:
            start = perf_counter()
            result = step(action, active)
            self.seconds += perf_counter() - start
            return result

        engine.step = counted  # type: ignore[method-assign]
        return engine


def _tasks(n: int) -> tuple[str, ...]:
    """Return n of the 50 tasks, spread over the list, so that small batches also consist of typical tasks."""
    return tuple(lw.MT50[i * len(lw.MT50) // n] for i in range(n)) if n < len(lw.MT50) else lw.MT50


def _stepper(env: EnvBase, state: TensorDictBase, steps: int) -> Callable[[], None]:
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand((steps, *state.batch_size, 4), generator=generator) * 2 - 1

    def run() -> None:
        now = state
        for action in actions:
            now.set("action", action.clone())
            now = env.step_and_maybe_reset(now)[1]

    return run


def overhead(settings: Settings) -> list[Row]:
    """Measure the time of a step outside the engine, with QAFTransform and StepCounter, and the time of TorchRL alone,
    with StepCounter. The physics runs in between, because it empties the caches."""
    rows = []
    for n in (2, 4) if settings.quick else (1, 10, 50, 200):
        rounds, steps = settings.pick(15, 3), settings.pick(max(5, 600 // n), 5)
        layers = {
            "whole": (lw.LanguageWorldEnv, [lw.QAFTransform(lw.load_plans("MT50")), StepCounter()]),
            "machinery": (_OnlySimulates, [StepCounter()]),
        }
        clock, runs, envs = _Clock(), {}, []
        for name, (kind, transforms) in layers.items():
            base = kind(_tasks(n), num_envs=n, engine=clock, num_threads=1, max_steps=10**6)
            envs.append(TransformedEnv(base, Compose(*transforms)))
            runs[name] = _stepper(envs[-1], envs[-1].reset(), steps)
        whole: list[float] = []
        found: dict[str, list[float]] = {name: [] for name in runs}
        for _ in bars(range(rounds), f"overhead, N = {n}"):
            for name, run in runs.items():
                clock.seconds = 0.0
                seconds = timed(run)
                found[name].append(seconds - clock.seconds)
                if name == "whole":
                    whole.append(seconds)
        for env in envs:
            env.close()
        rows.append(
            part_of(
                f"TorchRL's layer of a step, N = {n}, 1 thread",
                found["whole"],
                "the whole step",
                whole,
                unit="µs",
                scale=1e6 / steps,
                at_most=0.05 if n == 50 else None,
                note=f"{1e6 * median(found['machinery']) / steps:.0f} µs of it by TorchRL around an environment that "
                "only simulates, StepCounter included",
            )
        )
    return rows


def reset(settings: Settings) -> list[Row]:
    """Compare a reset of all rows with Meta-World's own ``env.seed(s); env.reset()``."""
    tasks = _SMALL if settings.quick else lw.MT50
    env = lw.LanguageWorldEnv(tasks, num_threads=1)
    originals = [make_metaworld_env(task) for task in tasks]
    seeds = iter(range(10**6))

    def theirs() -> None:
        seed = next(seeds)
        for original in originals:
            original.seed(seed)
            original.reset()

    found = take_turns({"ours": env.reset, "theirs": theirs}, settings.pick(15, 2))
    env.close()
    return [
        compare(
            f"reset, {len(tasks)} tasks, 1 thread",
            found["ours"],
            "Meta-World's env.reset",
            found["theirs"],
            unit="ms",
            scale=1e3 / len(tasks),
        )
    ]


_CONSTRUCT = """
import json, re, resource, sys, time
import lw_torchrl as lw

def peak():
    # A fork inherits its parent's ru_maxrss, so this value would be wrong for a process started from here.
    try:
        return int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1]) * 1024 / 1e9
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e9

before = peak()
start = time.perf_counter()
env = lw.LanguageWorldEnv(sys.argv[1].split(","), num_envs=int(sys.argv[2]))
built = time.perf_counter() - start
env.reset()
print(json.dumps({"built": built, "reset": time.perf_counter() - start - built, "memory": peak(), "imports": before}))
"""


def construction(settings: Settings) -> list[Row]:
    """Measure the construction of MT50 with 1000 environments in new processes, in which no model is compiled yet."""
    tasks, n = (_SMALL, 6) if settings.quick else (lw.MT50, 1000)
    found = []
    for _ in bars(range(settings.pick(3, 1)), "construction"):
        command = [sys.executable, "-W", "ignore", "-c", _CONSTRUCT, ",".join(tasks), str(n)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError((done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1])
        found.append(json.loads(done.stdout.splitlines()[-1]))
    middle = {key: median(one[key] for one in found) for key in found[0]}
    what = f"{len(tasks)} tasks, {n} environments"
    return [
        under(f"{what}: built", middle["built"], "s", 12, "compiles every model; the imports are not counted"),
        under(f"{what}: first reset", middle["reset"], "s"),
        under(f"{what}: peak memory", middle["memory"], "GB", 3, f"imports alone {middle['imports']:.2f} GB"),
    ]


def gym_wrapper(settings: Settings) -> list[Row]:
    """Compare with TorchRL's GymWrapper over Meta-World, one environment after another, as a SerialEnv steps them.

    The wrapper gets zero actions and has no info reader, because it supports no seeding, partial resets or success.
    """
    from torchrl.envs import GymWrapper

    tasks = _SMALL if settings.quick else lw.MT50
    steps = settings.pick(10, 3)
    wrapped = []
    for task in tasks:
        env = make_metaworld_env(task, max_steps=10**6)
        env.seed(0)
        wrapped.append(GymWrapper(env))
    states = [env.reset() for env in wrapped]
    action = torch.zeros(4)

    def theirs() -> None:
        for number, env in enumerate(wrapped):
            for _ in range(steps):
                states[number].set("action", action)
                states[number] = env.step_mdp(env.step(states[number]))

    ours = lw.LanguageWorldEnv(tasks, num_threads=1, max_steps=10**6, reward="dense")
    state = ours.reset()

    def run() -> None:
        now = state
        for _ in range(steps):
            now.set("action", torch.zeros(len(tasks), 4))
            now = ours.step_mdp(ours.step(now))

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the wrapper and Gymnasium warn about Meta-World's specs
        found = take_turns({"ours": run, "theirs": theirs}, settings.pick(15, 2))
    ours.close()
    return [
        compare(
            f"LanguageWorldEnv step, N = {len(tasks)}, 1 thread, dense reward",
            found["ours"],
            "GymWrapper over Meta-World",
            found["theirs"],
            unit="µs",
            scale=1e6 / len(tasks) / steps,
        )
    ]


def envpool(settings: Settings) -> list[Row]:
    """Compare with EnvPool's C++ Meta-World: 10 tasks with 10 environments each, random actions, 1 and 2 threads."""
    try:
        import envpool as rival
    except ImportError as error:
        raise Skipped(f"EnvPool is not installed ({error}): pip install -e '.[bench]'") from error

    return [row for threads in range(1, min(2, available_cores()) + 1) for row in _envpool(rival, threads, settings)]


def _envpool(rival: Any, threads: int, settings: Settings) -> list[Row]:
    tasks, n, steps = (_SMALL if settings.quick else lw.MT10), 10, settings.pick(20, 3)
    rows = [task for task in tasks for _ in range(n)]
    generator = np.random.default_rng(0)
    pools = []
    for task in tasks:
        name = "".join(word.capitalize() for word in task.split("-"))
        pools.append(rival.make_gymnasium(f"MetaWorld/{name}-v3", num_envs=n, num_threads=threads, seed=0))
        pools[-1].reset()
    engines = {reward: VectorizedEngine(rows, num_threads=threads, reward=reward) for reward in ("sparse", "dense")}
    for engine in engines.values():
        engine.reset(range(len(rows)), list(range(len(rows))))
    env = lw.LanguageWorldEnv(tasks, num_envs=len(rows), num_threads=threads, reward="dense", max_steps=10**6)
    state = env.reset()
    order = [i % len(tasks) * n + i // len(tasks) for i in range(len(rows))]  # our environment assigns tasks in turn
    active = np.ones(len(rows), dtype=bool)
    found: dict[str, list[float]] = {name: [] for name in ("theirs", "sparse", "dense", "env")}
    for _ in bars(range(settings.pick(15, 2)), f"EnvPool, {threads} threads"):
        actions = generator.uniform(-1, 1, (steps, len(rows), 4)).astype(np.float32)

        def theirs(actions: np.ndarray = actions) -> None:
            for number, pool in enumerate(pools):
                for action in actions[:, number * n : (number + 1) * n]:
                    pool.step(action)

        def engine(reward: str, actions: np.ndarray = actions) -> None:
            for action in actions:
                engines[reward].step(action, active)

        def whole(actions: np.ndarray = actions[:, order]) -> None:
            now = state
            for action in actions:
                now.set("action", torch.from_numpy(action))
                now = env.step_mdp(env.step(now))

        found["theirs"].append(timed(theirs))
        found["sparse"].append(timed(lambda: engine("sparse")))
        found["dense"].append(timed(lambda: engine("dense")))
        found["env"].append(timed(whole))
    env.close()
    for each in engines.values():
        each.close()
    counted = "1 thread" if threads == 1 else f"{threads} threads"
    names = {
        "sparse": "engine step, sparse reward",
        "dense": "engine step, dense reward",
        "env": "LanguageWorldEnv step, dense reward",
    }
    return [
        compare(
            f"{name}, {len(tasks)} tasks × {n}, {counted}",
            found[key],
            f"EnvPool {rival.__version__}",
            found["theirs"],
            unit="µs",
            scale=1e6 / steps / len(rows),
            at_least=1.0,
            note="EnvPool's numbers are not bit for bit Meta-World's",
        )
        for key, name in names.items()
    ]
