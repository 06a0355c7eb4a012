"""Two threads in one environment are an error, not MuJoCo's memory; an environment in each thread is none."""

from __future__ import annotations

import threading
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from torchrl.envs import AsyncEnvPool, EnvBase

import lw_torchrl as lw
from lw_torchrl.suites.engine import EngineStep


class Slow:
    """An engine whose steps, resets and pictures wait until they may end."""

    def __init__(self, tasks, **options):
        self.rows = len(tasks)
        self.inside, self.go, self.closed = threading.Event(), threading.Event(), False
        self.go.set()

    def _wait(self):
        self.inside.set()
        assert self.go.wait(5)
        assert not self.closed, "closed while a thread was in it"

    def reset(self, rows, seeds):
        self._wait()
        return np.zeros((len(rows), 39))

    def step(self, action, active):
        self._wait()
        return EngineStep(np.zeros((self.rows, 39)), *(np.zeros(self.rows, kind) for kind in (float, bool, bool)))

    def render(self, rows, *, camera, height, width):
        self._wait()
        return np.zeros((len(rows), height, width, 3), np.uint8)

    def close(self):
        self.closed = True


@pytest.fixture
def env():
    made = lw.LanguageWorldEnv("reach", engine=Slow)
    yield made
    made.engine.go.set()
    made.close(raise_if_closed=False)


def step(env: EnvBase):
    return env.step(env.full_action_spec.zero())


def load(env: EnvBase):
    env.load_state_dict(env.state_dict())


DOINGS = {"step": step, "reset": lambda env: env.reset(), "render": lambda env: env.render()}
REFUSED = DOINGS | {"set_seed": lambda env: env.set_seed(1), "load_state_dict": load}


@pytest.mark.parametrize("first", DOINGS)
@pytest.mark.parametrize("second", REFUSED)
def test_a_second_thread_is_refused_and_the_first_goes_on(env, first, second):
    env.reset()
    state = env.state_dict()
    env.engine.go.clear()
    env.engine.inside.clear()
    with ThreadPoolExecutor(1) as other:
        under_way = other.submit(DOINGS[first], env)
        assert env.engine.inside.wait(5)
        with pytest.raises(RuntimeError, match="takes one thread at a time: make an environment in each"):
            REFUSED[second](env)
        assert str(env.state_dict()) == str(state), "can be read meanwhile, and nothing moved"
        env.engine.go.set()
        under_way.result()
    REFUSED[second](env)  # afterwards it may
    env.reset()
    step(env)


def test_closing_waits_for_the_step_under_way(env):
    env.reset()
    env.engine.go.clear()
    env.engine.inside.clear()
    with ThreadPoolExecutor(2) as others:
        under_way = others.submit(step, env)
        assert env.engine.inside.wait(5)
        closing = others.submit(env.close)
        assert not closing.done()
        env.engine.go.set()
        under_way.result()
        closing.result()
    with pytest.raises(RuntimeError, match="this environment is closed"):
        step(env)


def test_an_error_within_leaves_it_free(env):
    env.reset()
    with pytest.raises(ValueError, match="action must be"):
        env.step(env.full_action_spec.zero().set("action", torch.zeros(1, 3)))
    with ThreadPoolExecutor(1) as other:
        other.submit(step, env).result()


def test_a_pool_of_threads_that_holds_one_environment_twice():
    env = lw.LanguageWorldEnv("reach", batch_size=(), engine=Slow)
    pool = AsyncEnvPool([env, env], backend="threading")
    env.engine.go.clear()
    threading.Timer(1.0, env.engine.go.set).start()  # the one that is in goes on
    with pytest.raises(RuntimeError, match="takes one thread at a time"):
        pool.reset()
    env.close()


def test_an_environment_in_each_thread_gives_what_it_gives_alone():
    def rollout(task):
        env = lw.LanguageWorldEnv(task, seed=3, num_threads=1)
        found = env.rollout(20, lw.ExpertActor(task))
        env.close()
        return found

    tasks = ["reach", "push", "reach"]
    alone = [rollout(task) for task in tasks]
    with ThreadPoolExecutor(3) as threads:
        assert all((one == other).all() for one, other in zip(alone, threads.map(rollout, tasks), strict=True))


def test_experts_in_threads_leave_pythons_warnings_alone():
    state = lw.LanguageWorldEnv("reach", num_envs=4).reset()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        before = list(warnings.filters)

        def act(_):
            expert = lw.ExpertActor("reach")
            for _ in range(200):
                expert(state.copy())

        with ThreadPoolExecutor(3) as threads:
            list(threads.map(act, range(3)))
        assert warnings.filters == before
