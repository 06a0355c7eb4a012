"""Workers that are made by one factory run different episodes: those that one environment of all their rows would."""

from __future__ import annotations

import multiprocessing
import os
import sys
from functools import partial

import pytest
import torch
from speed import first_fast
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import AsyncEnvPool, EnvCreator, ParallelEnv, SerialEnv
from worker_envs import make_env, make_serial, make_transformed, still

import lw_torchrl as lw
from lw_torchrl.envs.workers import MANY, torchrl_worker

pytestmark = pytest.mark.filterwarnings(
    "ignore:No explicit `?device", "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


def four_rows() -> torch.Tensor:
    """(2, 4): the first two episodes of one environment of four rows, and their first observations."""
    env = make_env(num_envs=4)
    states = [env.reset() for _ in range(2)]
    env.close()
    return torch.stack([state["observation"] for state in states])


BATCHED = {
    "serial": lambda make: SerialEnv(2, make),
    "parallel, fork": lambda make: ParallelEnv(2, make, mp_start_method="fork"),
    "parallel, spawn": lambda make: ParallelEnv(2, make, mp_start_method="spawn"),
}


@pytest.mark.parametrize("make", [make_env, make_transformed])
@pytest.mark.parametrize("name", first_fast(BATCHED, 2))
def test_a_batch_of_environments_runs_what_one_large_one_would(name, make):
    for _ in range(1 if "spawn" in name else 2):  # whatever ran before in this process
        env = BATCHED[name](make)
        states = [env.reset() for _ in range(2)]
        env.close()
        assert states[0]["episode"].tolist() == [[0, 1], [2, 3]]
        assert states[1]["episode"].tolist() == [[4, 5], [6, 7]]
        assert torch.equal(torch.stack([state["observation"].flatten(0, 1) for state in states]), four_rows())


def test_workers_within_workers():
    env = SerialEnv(3, make_serial)
    assert env.reset()["episode"].flatten().tolist() == list(range(12))
    env.close()
    env = ParallelEnv(2, make_serial, mp_start_method="fork")
    assert env.reset()["episode"].flatten().tolist() == list(range(8))
    env.close()


def test_an_env_creator_in_workers():
    env = SerialEnv(2, EnvCreator(make_transformed))
    assert env.reset()["episode"].tolist() == [[0, 1], [2, 3]]
    env.close()


def test_without_buffers_workers_differ_too():
    env = ParallelEnv(2, make_env, mp_start_method="fork", use_buffers=False)
    first, second = env.reset()["episode"], env.reset()["episode"]
    env.close()
    assert torch.cat([first, second]).unique().numel() == 8


def test_a_set_seed_still_gives_each_worker_its_own():
    env = SerialEnv(2, make_env)
    env.set_seed(0)
    first = env.reset()["observation"]
    env.set_seed(0)
    assert torch.equal(env.reset()["observation"], first)
    assert first.flatten(0, 1).unique(dim=0).shape == (4, 39)
    env.close()


def test_a_collector_of_one_environment_is_no_worker():
    collector = Collector(make_env, still, frames_per_batch=8, total_frames=-1)
    assert next(iter(collector))["episode"].tolist() == [[0, 0, 2, 2], [1, 1, 3, 3]]
    collector.shutdown()


def collected(kind, makers, **options) -> list[torch.Tensor]:
    collector = kind(makers, still, frames_per_batch=8 * len(makers), total_frames=16 * len(makers), **options)
    batches = [torch.stack([b["episode"], b["observation"][..., 36]], -1).flatten(0, -2) for b in collector]
    collector.shutdown()
    return batches


@pytest.mark.slow
def test_collectors_in_processes_differ_and_repeat_themselves():
    runs = [collected(MultiSyncCollector, [make_env] * 2, cat_results="stack") for _ in range(2)]
    assert all(torch.equal(left, right) for left, right in zip(*runs, strict=True)), "the seed says it all"
    episodes, goals = torch.cat(runs[0]).unbind(-1)
    assert episodes.unique().numel() == goals.unique().numel() == 2 * 2 * 4
    assert {int(e) for e in episodes if e < MANY} == {0, 1, 2, 3}


@pytest.mark.slow
def test_asynchronous_collectors_differ():
    found = torch.cat(collected(MultiAsyncCollector, [make_env] * 2))
    assert found[:, 0].unique().numel() == found[:, 1].unique().numel()
    ranks = {int(episode) // 2 % MANY for episode in found[:, 0]}
    assert ranks <= {0, 1}
    assert len(ranks) > 0


def make_parallel():
    return ParallelEnv(2, make_env, mp_start_method="spawn")


@pytest.mark.slow
def test_spawned_environments_of_spawned_collectors():
    found = torch.cat(collected(MultiSyncCollector, [make_parallel] * 2, cat_results="stack"))
    assert found[:, 0].unique().numel() == found[:, 1].unique().numel() >= 8


@pytest.mark.slow
def test_a_pool_of_processes_and_one_of_threads():
    pool = AsyncEnvPool([partial(make_env, num_envs=1)] * 2, backend="multiprocessing", exchange="queue")
    assert pool.reset()["episode"].flatten().tolist() == [0, 1]
    pool.close()
    for factories in ([make_env] * 2, [partial(make_env, worker=(w, 2)) for w in range(2)], [make_env]):
        with pytest.raises(RuntimeError, match=r"does not say which .*: take backend='multiprocessing'"):
            AsyncEnvPool(factories, backend="threading")


def test_a_worker_may_be_told_who_it_is():
    told = [make_env(worker=(w, 3)) for w in range(3)]
    assert [env.reset()["episode"].tolist() for env in told] == [[0, 1], [2, 3], [4, 5]]
    assert [env.reset()["episode"].tolist() for env in told] == [[6, 7], [8, 9], [10, 11]]
    assert [env.worker for env in told] == [(0, 3), (1, 3), (2, 3)]
    told[1].set_seed(3)
    assert told[1].reset()["episode"].tolist() == [2, 3]
    for env in told:
        env.close()
    env = SerialEnv(2, make_env, create_env_kwargs=[{"worker": (0, 1)}, {"worker": (1, 2)}])
    assert env.reset()["episode"].tolist() == [[0, 1], [2, 3]]
    env.close()
    assert torchrl_worker() == (0, 1)


def test_rows_of_several_tasks_are_counted_each():
    env = lw.LanguageWorldEnv(["push", "reach"], num_envs=3, worker=(1, 2), num_threads=1)
    assert env.reset()["episode"].tolist() == [2, 1, 3]
    assert env.reset()["episode"].tolist() == [6, 3, 7]
    env.close()


# --- processes -----------------------------------------------------------------------------------------------------


def in_a_fork(env, state, what: str, channel) -> None:
    try:
        channel.send((env.reset() if what == "reset" else env.step(state))["episode"].tolist())
    except RuntimeError as error:
        channel.send(str(error))
    channel.close()
    os._exit(0)


@pytest.mark.skipif(sys.platform != "linux", reason="fork")
@pytest.mark.parametrize("what", ["reset", "step"])
@pytest.mark.parametrize("make", [make_env, make_transformed])
def test_a_forked_child_is_told_to_make_its_own(make, what):
    env = make()
    state = still(env.reset())
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe()
    child = context.Process(target=in_a_fork, args=(env, state, what, theirs))
    child.start()
    assert ours.poll(30), "it hangs"
    assert "make the environment in this process" in ours.recv()
    child.join()
    assert not env.step(state)["next", "fault"].any(), "the parent goes on"
    env.close()
