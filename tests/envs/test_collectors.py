"""Collectors with an actor: new weights reach every worker, and resuming continues."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from pathlib import Path

import pytest
import torch
from speed import first_fast
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from worker_envs import make_actor, make_push_reach, numbered

pytestmark = pytest.mark.filterwarnings(
    "ignore:No explicit `?device", "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
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

        options = {
            "collector_kwargs": {"auto_register_policy_transforms": False},
            "total_frames": 10_000 * ROWS * STEPS,
        }
        options |= {"remote_configs": {"num_cpus": 1, "num_gpus": 0, "memory": 2**28}}
        collector = RayCollector(numbered(make_push_reach, 2), actor, frames_per_batch=2 * ROWS * STEPS, **options)
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
    program = f"import test_collectors; test_collectors.collect_until_killed({kind!r}, {str(file)!r})"
    paths = {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path]), "OMP_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", program], env={**os.environ, **paths}, start_new_session=True
    )
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
