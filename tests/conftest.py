"""Fixtures of several test files: Meta-World's own environments as the oracle, a plan for every task, MT50."""

import copy
import gc
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any

import mujoco
import pytest
from commands import python_process
from forks import Forks

import lw_torchrl as lw
from lw_torchrl._util import files as _files


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run the goldens and then other slow files first, so that parallel processes end at about the same time."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path.stem != "test_goldens", item.path not in slow))


def pytest_collection_finish() -> None:
    """Exclude the millions of objects of the libraries from garbage collection."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def interruptible() -> None:
    """Let Ctrl-C interrupt tests, also in processes that a shell started in the background."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture(scope="session", autouse=True)
def compiled_once() -> Iterator[None]:
    """Give each of Meta-World's environments an exact copy of a model that is compiled once, which takes 0.2 s."""
    kept = cache(mujoco.MjModel.from_xml_path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mujoco.MjModel, "from_xml_path", lambda path: copy.copy(kept(path)))
        yield


@pytest.fixture(scope="session")
def metaworld_env() -> Callable[[str], Any]:
    """Make a new Meta-World environment of a task without our code."""

    def make(task: str) -> Any:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE

        env = ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"](seed=12345)
        env._freeze_rand_vec = False
        env.seeded_rand_vec = True
        return env

    return make


@pytest.fixture(scope="session")
def plans() -> dict[str, lw.ConditionalPlan]:
    """A plan for each of the 50 tasks: the shipped one, or one with one to seven supported queries."""
    plans = dict(lw.load_plans("MT10"))
    for number, task in enumerate(lw.MT50):
        queries = lw.supported_queries(task)
        pairs = [(queries[(k * 37 + number) % len(queries)], f"move {k}") for k in range(1 + number % 7)]
        plans.setdefault(task, lw.ConditionalPlan.from_pairs(task, pairs))
    return {task: plans[task] for task in lw.MT50}


@pytest.fixture(scope="session", params=["vectorized", pytest.param("metaworld", marks=pytest.mark.slow)])
def mt50(request: pytest.FixtureRequest) -> Iterator[lw.LanguageWorldEnv]:
    """All 50 tasks, one row each, on each engine. Tests call ``set_seed`` first."""
    env = lw.LanguageWorldEnv("MT50", seed=0, engine=request.param, reward="dense")
    yield env
    env.close(raise_if_closed=False)


@pytest.fixture(scope="session")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    """Commands in separate processes, forked from one that is started once."""
    forks = Forks(tmp_path_factory.mktemp("forks"))
    yield forks
    forks.close()


@pytest.fixture(scope="session")
def python() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Run a program in a new Python process."""
    return partial(python_process, "-c", timeout=120)


@pytest.fixture
def in_time():
    """Let a test fail, instead of waiting, if it reads a pipe to which nothing is written."""

    def late(*_):
        raise TimeoutError("the test waits for a pipe")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


HOLDER = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("_files", sys.argv[1])  # the package would take seconds to import
files = importlib.util.module_from_spec(spec)
spec.loader.exec_module(files)
with files.locked(sys.argv[2], "place", folder=sys.argv[3] == "True"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holding() -> Iterator[Callable[..., Callable[[], None]]]:
    """A function that lets another process lock a path, and returns a function that ends the process."""
    processes = []

    def hold(place: Any, *, folder: bool = False) -> Callable[[], None]:
        command = [sys.executable, "-c", HOLDER, _files.__file__, str(place), str(folder)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        processes.append(process)
        assert process.stdout.readline() == b"held\n"
        return process.communicate  # type: ignore[return-value]

    yield hold
    for process in processes:
        process.kill()
        process.communicate()
