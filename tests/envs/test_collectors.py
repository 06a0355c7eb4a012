"""Collectors with a policy of plans: its new weights reach every worker, and one that is resumed goes on."""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import pytest
import torch
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import AsyncEnvPool
from worker_envs import make_actor, make_push_reach, make_single

pytestmark = pytest.mark.filterwarnings(
    "ignore:No explicit `?device", "ignore:This process .* is multi-threaded, use of fork:DeprecationWarning"
)
ROWS, STEPS = 2, 5  # of an environment of a worker, and of its episodes
KINDS = {
    "one": (Collector, make_push_reach, {"auto_register_policy_transforms": False}),
    "sync": (MultiSyncCollector, [make_push_reach] * 2, {"cat_results": "stack"}),
    "async": (MultiAsyncCollector, [make_push_reach] * 2, {}),
}


def make_collector(kind, actor):
    cls, makers, options = KINDS[kind]
    workers = len(makers) if isinstance(makers, list) else 1
    return cls(makers, actor, frames_per_batch=2 * ROWS * STEPS * workers, total_frames=-1, **options)


def episodes(batch) -> set[tuple[int, int]]:
    return set(zip(batch["task_id"].flatten().tolist(), batch["episode"].flatten().tolist(), strict=True))


@pytest.mark.parametrize("kind", KINDS)
def test_workers_get_new_weights_and_differ(kind):
    actor = make_actor()
    collector = make_collector(kind, actor)
    batches = iter(collector)
    first = next(batches).clone()
    assert first["action_log_prob"].isfinite().all()
    assert len(episodes(first)) == first.numel() // STEPS, "no episode twice"
    with torch.no_grad():
        for p in actor.head.parameters():
            p.zero_()
    collector.update_policy_weights_()
    for _ in range(4):  # what was under way was done with the old ones
        last = next(batches)
    assert not last["loc"].any()
    assert first["loc"].any()
    assert not episodes(first) & episodes(last)
    collector.shutdown()


@pytest.mark.parametrize("kind", KINDS)
def test_one_that_is_resumed_goes_on_with_the_next_episodes(kind):
    first = make_collector(kind, make_actor())
    batches = iter(first)
    seen = set().union(*(episodes(next(batches)) for _ in range(2)))
    file = io.BytesIO()
    torch.save(first.state_dict(), file)
    first.shutdown()
    file.seek(0)
    second = make_collector(kind, make_actor())
    second.load_state_dict(torch.load(file, weights_only=True))
    second.reset()
    batches = iter(second)
    after = set().union(*(episodes(next(batches)) for _ in range(2)))
    second.shutdown()
    assert after
    assert not seen & after


def test_a_pool_of_processes_with_a_policy():
    pool = AsyncEnvPool([make_single] * 2, backend="multiprocessing", exchange="queue")
    with torch.no_grad():
        data = pool.rollout(4, make_actor())
    pool.close()
    assert data["action"].shape == (2, 4, 4)
    assert data["episode"][:, 0].tolist() == [0, 1]


@pytest.mark.slow
def test_ray():
    ray = pytest.importorskip("ray")
    from torchrl.collectors.distributed import RayCollector

    found_here = {"env_vars": {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])}}
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, logging_level="ERROR", runtime_env=found_here)
    try:
        actor = make_actor()
        collector = RayCollector(
            [make_push_reach] * 2,
            actor,
            frames_per_batch=2 * ROWS * STEPS,
            total_frames=4 * 2 * ROWS * STEPS,
            collector_kwargs={"auto_register_policy_transforms": False},
            remote_configs={"num_cpus": 1, "num_gpus": 0, "memory": 2**28},
        )
        collector.update_policy_weights_()
        found, locs = [], []
        for batch in collector:
            found.append(episodes(batch))
            locs.append(batch["loc"].abs().sum().item())
            with torch.no_grad():
                for p in actor.head.parameters():
                    p.zero_()
            collector.update_policy_weights_()
        assert len(set().union(*found)) == sum(map(len, found)), "no episode twice"
        assert locs[0] > 0
        assert locs[-1] == 0
        collector.shutdown()
    finally:
        ray.shutdown()
