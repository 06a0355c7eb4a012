"""Numbered workers run the episodes of one environment with all their rows; forked processes and threads."""

import os
import signal
import sys
from functools import partial

import pytest
import torch
from speed import first_fast
from torchrl.envs import ParallelEnv, SerialEnv
from worker_envs import make_env, make_serial, make_transformed, numbered, still

import lw_torchrl as lw

pytestmark = pytest.mark.filterwarnings(
    "ignore:No explicit `?device", "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


BATCHED = {
    "serial": lambda makers: SerialEnv(2, makers),
    "parallel, fork": lambda makers: ParallelEnv(2, makers, mp_start_method="fork"),
    "parallel, spawn": lambda makers: ParallelEnv(2, makers, mp_start_method="spawn"),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", [make_env, make_transformed])
@pytest.mark.parametrize("name", first_fast(BATCHED, 2))
def test_a_batch_of_environments_runs_the_episodes_of_a_large_one(name, make):
    env, large = BATCHED[name](numbered(make, 2)), make_env(num_envs=4)
    for expected in ([[0, 1], [2, 3]], [[4, 5], [6, 7]]):
        state = env.reset()
        assert state["episode"].tolist() == expected
        assert torch.equal(state["observation"].flatten(0, 1), large.reset()["observation"])
    env.close()
    large.close()


def test_workers_in_workers_run_different_episodes():
    for of, batch in ((3, SerialEnv), (2, partial(ParallelEnv, mp_start_method="fork"))):
        env = batch(of, [partial(make_serial, worker=(w, of)) for w in range(of)])
        assert env.reset()["episode"].flatten().tolist() == list(range(4 * of))
        env.close()


@pytest.mark.parametrize(("makers", "second"), [(make_env, [0, 1]), (numbered(make_env, 2), [2, 3])])
def test_workers_differ_only_if_they_are_numbered(makers, second):
    env = SerialEnv(2, makers)
    for _ in range(2):
        env.set_seed(0)
        assert env.reset()["episode"].tolist() == [[0, 1], second]
    env.close()


def test_numbered_environments_run_different_episodes():
    envs = [make_env(worker=(w, 3)) for w in range(3)]
    assert [env.worker for env in envs] == [(0, 3), (1, 3), (2, 3)]
    for first in (0, 6):
        assert [env.reset()["episode"].tolist() for env in envs] == [
            [first + 2 * w, first + 2 * w + 1] for w in range(3)
        ]
    envs[1].set_seed(3)
    assert envs[1].reset()["episode"].tolist() == [2, 3]
    envs.append(lw.LanguageWorldEnv(["push", "reach"], num_envs=3, worker=(1, 2), num_threads=1))
    assert [envs[3].reset()["episode"].tolist() for _ in range(2)] == [[2, 1, 3], [6, 3, 7]], "rows of each task"
    for env in envs:
        env.close()


@pytest.mark.skipif(sys.platform != "linux", reason="fork")
@pytest.mark.parametrize("action", ["reset", "step"])
@pytest.mark.parametrize("make", [make_env, make_transformed])
def test_use_in_a_forked_process_is_an_error(make, action):
    env = make()
    state = still(env.reset())
    if not (child := os.fork()):
        signal.alarm(30)  # ends the child if it hangs
        try:
            env.reset() if action == "reset" else env.step(state)
        except RuntimeError as error:
            os._exit(0 if "forked after the environment was made" in str(error) else 2)
        finally:
            os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert not env.step(state)["next", "fault"].any()
    env.close()
