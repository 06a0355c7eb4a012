"""Datasets made of random numbers in no time, for the tests of the formats of others."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.data.dataset import (
    COLUMNS,
    DATA,
    CollectConfig,
    Demonstrations,
    describe_episode,
    read_metadata,
    write_metadata,
    write_rows,
)
from lw_torchrl.language.tasks import task_id

ODD = np.array([0.0, -0.0, 1e-45, -1e-38, 3.4e38, np.pi, 1 / 3], dtype=np.float32)  # where bits get lost


def random_dataset(root: Path, lengths: Sequence[Sequence[int]], seed: int = 0) -> Demonstrations:
    """A dataset of a task for each list, of episodes of so many rows; each observation follows from the one before."""
    tasks = ("drawer-open", "push", "reach")[: len(lengths)]
    draws = np.random.default_rng(seed)

    def numbers(*shape: int) -> torch.Tensor:
        found = draws.standard_normal(shape).astype(np.float32)
        odd = draws.random(shape) < 0.1
        found[odd] = draws.choice(ODD, odd.sum())
        return torch.from_numpy(found)

    infos, parts = [], []
    for task, own in zip(tasks, lengths, strict=True):
        for episode, steps in enumerate(own):
            states, ends = numbers(steps + 1, 39), torch.zeros(steps, 1, dtype=torch.bool)
            ends[-1] = True
            success = torch.from_numpy(draws.random((steps, 1)) < 0.2)
            rows = TensorDict({}, [steps])
            for key, (tail, _) in COLUMNS.items():
                rows.set(key, numbers(steps, *tail))
            number = torch.full((steps,), task_id(task))
            rows.update({"observation": states[:-1], "task_id": number, "episode": torch.full_like(number, episode)})
            rows.set("action", rows.get("action").clamp(-1, 1)).set(("next", "observation"), states[1:])
            rows.set(("next", "task_id"), number).set(("collector", "traj_ids"), torch.full_like(number, len(infos)))
            rows.set(("next", "reward_sparse"), success.float()).set(("next", "success"), success)
            rows.set(("next", "done"), ends).set(("next", "truncated"), ends).set(("next", "terminated"), ends & False)
            start = infos[-1].start + infos[-1].length if infos else 0
            infos.append(describe_episode(task, episode, start, rows))
            parts.append(rows)
    config = CollectConfig(tasks, len(lengths[0]), seed, max_steps=max(map(max, lengths)))
    write_rows(root / DATA, parts, config.layout)
    numbers_of = {task: task_id(task) for task in tasks}
    attempts = dict.fromkeys(tasks, len(lengths[0]))
    write_metadata(Demonstrations(root, config, package_versions(), numbers_of, tuple(infos), attempts))
    return read_metadata(root)
