"""Environments and collectors in worker processes: every episode once, new weights, resuming, forks."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path

import pytest
import torch
from speed import first_fast
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import ParallelEnv, SerialEnv, TransformedEnv

import lw_torchrl as lw

pytestmark = pytest.mark.filterwarnings(
    "ignore:No explicit `?device", "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)


def make_env(**options) -> lw.LanguageWorldEnv:
    return lw.LanguageWorldEnv("reach", **{"num_envs": 2, "seed": 3, "max_steps": 2, "num_threads": 1} | options)


def make_transformed(**options) -> TransformedEnv:
    return TransformedEnv(make_env(**options), lw.QAFTransform(lw.load_plans("MT10")))


def make_serial(worker=(0, 1)) -> SerialEnv:
    return SerialEnv(2, numbered(make_env, 2, worker))


def numbered(make, of, worker=(0, 1), **options):
    """Return a factory for each of ``of`` workers, which may run in a worker themselves."""
    rank, outer = worker
    return [partial(make, worker=(rank * of + w, of * outer), **options) for w in range(of)]


def still(tensordict):
    return tensordict.set("action", torch.zeros(*tensordict.batch_size, 4))


def make_push_reach(worker=(0, 1)) -> TransformedEnv:
    env = lw.LanguageWorldEnv(["push", "reach"], num_envs=2, max_steps=5, num_threads=1, worker=worker)
    return TransformedEnv(env, lw.QAFTransform(lw.load_plans("MT10")))


def make_actor() -> lw.modules.StochasticActor:
    torch.manual_seed(0)
    return lw.PlanConditionedActor(lw.load_plans("MT10")).stochastic()


BATCHED = {"serial": partial(SerialEnv, 2)}
BATCHED |= {f"parallel, {start}": partial(ParallelEnv, 2, mp_start_method=start) for start in ("fork", "spawn")}


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
        assert [env.reset()["episode"].tolist() for env in envs] == [[k, k + 1] for k in range(first, first + 6, 2)]
    envs[1].set_seed(3)
    assert envs[1].reset()["episode"].tolist() == [2, 3]
    envs.append(lw.LanguageWorldEnv(["push", "reach"], num_envs=3, worker=(1, 2), num_threads=1))
    assert [envs[3].reset()["episode"].tolist() for _ in range(2)] == [[2, 1, 3], [6, 3, 7]], "rows of each task"


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


ROWS, STEPS = 2, 5  # rows of a worker's environment, and steps of its episodes
KINDS = {
    "one": (Collector, make_push_reach, {"auto_register_policy_transforms": False}),
    "sync": (MultiSyncCollector, numbered(make_push_reach, 2), {"cat_results": "stack"}),
    "async": (MultiAsyncCollector, numbered(make_push_reach, 2), {}),
}


@contextmanager
def ray_started():
    import ray

    environment = {"env_vars": {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}}
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR", runtime_env=environment)
    try:
        yield
    finally:
        ray.shutdown()


def make_collector(kind, actor, batches=None):
    """Return a collector that ends after ``batches`` batches."""
    if kind == "ray":
        from torchrl.collectors.distributed import RayCollector

        resources = {"num_cpus": 1, "num_gpus": 0, "memory": 2**28}
        options = {"frames_per_batch": 2 * ROWS * STEPS, "total_frames": 10_000 * ROWS * STEPS}
        options |= {"collector_kwargs": {"auto_register_policy_transforms": False}, "remote_configs": resources}
        collector = RayCollector(numbered(make_push_reach, 2), actor, **options)
        collector.update_policy_weights_()  # a RayCollector starts without weights
        return collector
    cls, makers, options = KINDS[kind]
    frames = 2 * ROWS * STEPS * (len(makers) if isinstance(makers, list) else 1)
    total = -1 if batches is None else batches * frames
    return cls(makers, actor, frames_per_batch=frames, total_frames=total, **options)


def episodes(batch) -> set[tuple[int, int]]:
    return set(zip(batch["task_id"].flatten().tolist(), batch["episode"].flatten().tolist(), strict=True))


@pytest.mark.parametrize("kind", first_fast(KINDS))
def test_workers_get_new_weights_and_different_episodes(kind):
    actor = make_actor()
    collector = make_collector(kind, actor)
    batches = iter(collector)
    first = next(batches).clone()
    assert first["action_log_prob"].isfinite().all()
    assert len(episodes(first)) == first.numel() // STEPS, "no episode may come twice"
    with torch.no_grad():
        for p in actor.module["decoder"].parameters():
            p.zero_()
    collector.update_policy_weights_()
    for _ in range(4):  # batches that had begun use the old weights
        last = next(batches)
    assert not last["loc"].any()
    assert first["loc"].any()
    assert not episodes(first) & episodes(last)
    collector.shutdown()


def collect_until_killed(kind, file):
    """Collect without an end; after each batch, write the collector's state and the episodes so far to ``file``.

    The state of a MultiAsyncCollector is saved only after the last batch: TorchRL 0.14 hangs if a worker collects
    meanwhile, because it drops the batch and the order to continue.
    """
    with ray_started() if kind == "ray" else nullcontext():
        collector = make_collector(kind, make_actor(), batches=2 if kind == "async" else None)
        seen = set()

        def save(number):
            torch.save({"state": collector.state_dict(), "seen": sorted(seen), "batches": number}, f"{file}.new")
            os.replace(f"{file}.new", file)

        for number, batch in enumerate(collector, 1):
            seen |= episodes(batch)
            if kind != "async":
                save(number)
        save(number)
        time.sleep(120)


def kill_after_two_batches(kind, file):
    """Kill a collecting process; return the state that it saved, and the episodes until then."""
    program = f"import test_workers; test_workers.collect_until_killed({kind!r}, {str(file)!r})"
    paths = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", "-c", program]
    process = subprocess.Popen(command, env=os.environ | paths, start_new_session=True)
    try:
        until = time.monotonic() + 120
        while not (file.is_file() and torch.load(file, weights_only=True)["batches"] >= 2):
            assert process.poll() is None
            assert time.monotonic() < until
            time.sleep(0.05)
    finally:
        os.killpg(process.pid, signal.SIGKILL)  # its workers, too
        process.wait()
    left = torch.load(file, weights_only=True)
    return left["state"], set(left["seen"])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["one", *(pytest.param(k, marks=pytest.mark.slow) for k in ("sync", "async", "ray"))])
def test_a_killed_collector_resumes_with_the_next_episodes(kind, tmp_path):
    if kind == "ray":
        pytest.importorskip("ray")
    state, seen = kill_after_two_batches(kind, tmp_path / "state.pt")
    with ray_started() if kind == "ray" else nullcontext():
        collector = make_collector(kind, make_actor())
        collector.load_state_dict(state)
        if kind == "ray":  # a RayCollector has no reset
            import ray

            ray.get([remote.reset.remote() for remote in collector.remote_collectors])
        else:
            collector.reset()
        batches = iter(collector)
        after = set().union(*(episodes(next(batches)) for _ in range(2)))
        collector.shutdown()
    assert len(after) >= ROWS * 2
    assert not seen & after
    if kind == "one":  # the episode that had just begun is lost
        assert min(number for _, number in after) == max(number for _, number in seen) + 2
