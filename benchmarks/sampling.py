"""Benchmarks of samplers with exact proportions: balanced tasks, co-learning with a target, and growing buffers."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyTensorStorage,
    RandomSampler,
    ReplayBufferEnsemble,
    TensorDictReplayBuffer,
    TensorStorage,
)

import lw_torchrl as lw
from benchmarks.report import Row, Settings, compare, take_turns

TASKS, BATCH, CALLS = 50, 200, 20
TARGET = "coffee-push"


def _rows(count: int, task: torch.Tensor) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "observation": torch.randn((count, 39), generator=generator),
            "action": torch.rand((count, 4), generator=generator),
            "task_id": task,
            "episode": torch.arange(count) // 500,
        },
        [count],
    )


def _compare(name: str, draws: Mapping[str, Callable[[], object]], rounds: int, rival: str, targets: bool) -> list[Row]:
    """Return rows that compare "ours" with "ensemble", which ``rival`` describes, and with "gather"."""

    def several(draw: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(CALLS):
                draw()

        return run

    found = take_turns({key: several(draw) for key, draw in draws.items()}, rounds)
    scale = 1e6 / CALLS
    return [
        compare(
            name,
            found["ours"],
            "ReplayBufferEnsemble",
            found["ensemble"],
            unit="µs",
            scale=scale,
            at_least=5 if targets else None,
            note=rival,
        ),
        compare(
            name,
            found["ours"],
            "a plain gather",
            found["gather"],
            unit="µs",
            scale=scale,
            at_least=0.2 if targets else None,
            note="one randint and one index, no exact numbers: the least a batch can cost",
        ),
    ]


def _balanced(settings: Settings, count: int) -> list[Row]:
    """Draw 200 of 500,000 rows of 50 tasks with our sampler, TorchRL's ensemble of buffers, and a plain gather."""
    rows = _rows(count, torch.arange(count) * TASKS // count)
    size = count // TASKS
    balanced = TensorDictReplayBuffer(storage=TensorStorage(rows), sampler=lw.TaskBalancedSampler(), batch_size=BATCH)
    members = [
        TensorDictReplayBuffer(storage=TensorStorage(rows[k * size : (k + 1) * size]), batch_size=BATCH // TASKS)
        for k in range(TASKS)
    ]
    ensemble = ReplayBufferEnsemble(*members, batch_size=BATCH)
    draws = {
        "ours": balanced.sample,
        "ensemble": ensemble.sample,
        "gather": lambda: rows[torch.randint(count, (BATCH,))],
    }
    name = f"TaskBalancedSampler, {BATCH} of {count:,} rows"
    return _compare(name, draws, settings.pick(30, 3), "a buffer for each task", targets=False)


def _co_learning(settings: Settings, count: int) -> list[Row]:
    """Draw 100 rows of one demonstration and 10 rows of each MT10 task, from two joined datasets."""
    size = count // len(lw.MT10)
    base = _rows(count, torch.tensor([lw.task_id(task) for task in lw.MT10]).repeat_interleave(size))
    target = _rows(500, torch.full((500,), lw.task_id(TARGET)))
    ours = TensorDictReplayBuffer(
        storage=TensorStorage(torch.cat([base, target])),
        sampler=lw.CoLearningSampler(TARGET),
        batch_size=BATCH,
    )
    parts = [target, *(base[k * size : (k + 1) * size] for k in range(len(lw.MT10)))]
    members = [TensorDictReplayBuffer(storage=TensorStorage(part), batch_size=10) for part in parts]
    shares = torch.tensor([0.5] + [0.05] * len(lw.MT10))
    ensemble = ReplayBufferEnsemble(*members, p=shares, num_buffer_sampled=BATCH // 10, batch_size=BATCH)
    draws = {
        "ours": ours.sample,
        "ensemble": ensemble.sample,
        "gather": lambda: base[torch.randint(count, (BATCH,))],
    }
    name = f"CoLearningSampler, {BATCH} of {count + 500:,} rows of two datasets"
    rival = "a buffer for each task, 20 drawn by their shares for 10 rows each: the counts are right on average alone"
    return _compare(name, draws, settings.pick(30, 3), rival, targets=True)


def _growing(settings: Settings, count: int) -> list[Row]:
    """Add 100 rows to a buffer, then draw a balanced batch of 200 rows."""
    task = torch.arange(count) % TASKS
    rows, come = _rows(count, task), 100
    batch = _rows(come, torch.arange(come) % TASKS)

    def balanced(sampler: object) -> Callable[[], object]:
        replay = TensorDictReplayBuffer(
            storage=LazyTensorStorage(count + count // 2), sampler=sampler, batch_size=BATCH
        )
        replay.extend(rows.clone())
        replay.sample()

        def turn() -> None:
            replay.extend(batch.clone())
            replay.sample()

        return turn

    rounds = settings.pick(15, 3)
    draws = {
        "ours": balanced(lw.TaskBalancedSampler()),
        "random": balanced(RandomSampler()),
    }
    found = take_turns(draws, rounds, warm_up=3)
    name = f"TaskBalancedSampler, {come} rows come and {BATCH} of {count:,} are drawn"
    unit = {"unit": "µs", "scale": 1e6}
    result = [
        compare(
            name,
            found["ours"],
            "RandomSampler",
            found["random"],
            note="no exact numbers; both write the rows first",
            **unit,  # type: ignore[arg-type]
        ),
    ]

    return result


def samplers(settings: Settings) -> list[Row]:
    """Draw a batch of 200 of 500,000 rows; compare with TorchRL's ensemble, a plain gather, and regrouping all rows."""
    count = settings.pick(500_000, 5_000)
    return [*_balanced(settings, count), *_co_learning(settings, count), *_growing(settings, count)]
