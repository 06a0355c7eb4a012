"""Minibatches of equal numbers from every task."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDict
from torchrl.data import ReplayBufferEnsemble, TensorDictReplayBuffer, TensorStorage

import lw_torchrl as lw
from benchmarks.report import Row, Settings, compare, take_turns

TASKS, BATCH, CALLS = 50, 200, 20


def _rows(count: int) -> TensorDict:
    generator = torch.Generator().manual_seed(0)
    return TensorDict(
        {
            "observation": torch.randn((count, 39), generator=generator),
            "action": torch.rand((count, 4), generator=generator),
            "task_id": torch.arange(count) * TASKS // count,
            "episode": torch.arange(count) // 500,
        },
        [count],
    )


def samplers(settings: Settings) -> list[Row]:
    """A batch of 200 out of 500 000 rows of 50 tasks: ours, TorchRL's ensemble of a buffer per task, a bare gather."""
    count = settings.pick(500_000, 5_000)
    rows = _rows(count)
    size = count // TASKS
    balanced = TensorDictReplayBuffer(storage=TensorStorage(rows), sampler=lw.TaskBalancedSampler(), batch_size=BATCH)
    members = [
        TensorDictReplayBuffer(storage=TensorStorage(rows[k * size : (k + 1) * size]), batch_size=BATCH // TASKS)
        for k in range(TASKS)
    ]
    ensemble = ReplayBufferEnsemble(*members, batch_size=BATCH)

    def gather() -> TensorDict:
        return rows[torch.randint(count, (BATCH,))]

    def several(draw: Callable[[], object]) -> Callable[[], None]:
        def run() -> None:
            for _ in range(CALLS):
                draw()

        return run

    contenders = {"ours": balanced.sample, "ensemble": ensemble.sample, "gather": gather}
    found = take_turns({k: several(v) for k, v in contenders.items()}, settings.pick(30, 3))
    name = f"TaskBalancedSampler, {BATCH} of {count:,} rows"
    scale = 1e6 / CALLS
    return [
        compare(name, found["ours"], "ReplayBufferEnsemble", found["ensemble"], unit="µs", scale=scale),
        compare(
            name,
            found["ours"],
            "a plain gather",
            found["gather"],
            unit="µs",
            scale=scale,
            note="one randint and one index, no equal numbers: the least a batch can cost",
        ),
    ]
