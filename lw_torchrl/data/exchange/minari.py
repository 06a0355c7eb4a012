"""Write Minari datasets with the minari package.

data/main_data.hdf5    a group for each episode: observations (T + 1, 39), actions (T, 4), dense rewards, terminations
                       and truncations (T,), and infos/... (T + 1, ...). success and reward_sparse describe the
                       preceding step (zero in the first row), all other infos the following step (zero in the last)
data/metadata.json     Minari's description, and the metadata of the lw_torchrl dataset
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._util.progress import Progress
from lw_torchrl.data.exchange.table import ABOUT, HOLDS, Array, Table

_AFTER = ("success", "reward_sparse")
_BEFORE = ("expert_action", "unclipped_action", HOLDS, "next_observation")


def _infos(table: Table, start: int, end: int) -> dict[str, Array]:
    """Return an episode's infos (T + 1 rows); omit next observations that equal the observations of the next rows."""
    infos = {}
    observation, after = (table.columns[name][start:end] for name in ("observation", "next_observation"))
    for name in (*_AFTER, *_BEFORE):
        column = table.columns.get(name)
        if column is None or (name == "next_observation" and observation[1:].tobytes() == after[:-1].tobytes()):
            continue
        empty, part = np.zeros_like(column[:1]), column[start:end]
        infos[name] = np.concatenate([empty, part] if name in _AFTER else [part, empty])
    return infos


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table as a Minari dataset, whose id is the folder's name, with the suffix -v0 if it has no version."""
    import h5py
    import minari
    from gymnasium.spaces import Box
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    observation, action, after = (table.columns[name] for name in ("observation", "action", "next_observation"))
    storage = MinariStorage.new(
        folder / "data",
        observation_space=Box(-np.inf, np.inf, observation.shape[1:], np.float32),
        action_space=Box(-1.0, 1.0, action.shape[1:], np.float32),
        data_format="hdf5",
    )

    (file,) = (folder / "data").glob("*.hdf5")
    h5py.File(file, "w", track_order=True).close()
    _reserve(file, 2 * sum(column.nbytes for column in table.columns.values()) + 100_000 * len(table.tasks))

    def episodes() -> Iterator[Any]:
        for start, end in table.spans():
            rows = slice(start, end)
            yield EpisodeBuffer(
                observations=np.concatenate([observation[rows], after[end - 1 : end]]),
                actions=action[rows],
                rewards=table.columns["reward_dense"][rows],
                terminations=table.columns["terminated"][rows],
                truncations=table.columns["truncated"][rows],
                infos=_infos(table, start, end),
            )
            bar.update(end - start)

    storage.update_episodes(episodes())
    _reserve(file, 100_000 * len(table.tasks))
    storage.update_episode_metadata(
        {"task": task, "task_description": table.descriptions[task], "plan": table.plans.get(task, "")}
        for task in table.tasks
    )
    name = re.sub(r"[^-\w]", "-", folder.name)
    about = "Robot demonstrations; the metadata of each episode hold the task's description and plan."
    versioned = name if re.search(r"-v\d+$", name) else f"{name}-v0"
    metadata = {"dataset_id": versioned, "minari_version": minari.__version__, "description": about}
    storage.update_metadata({**metadata, ABOUT: json.dumps(table.metadata)})


def _reserve(file: Path, size: int) -> None:
    """Reserve ``size`` bytes of disk space at the end of an HDF5 file; HDF5 frees unused space when it closes the file.

    Otherwise a write could fail inside HDF5 because the disk is full. HDF5 would leave the file open, and the process
    would crash at exit.
    """
    if hasattr(os, "posix_fallocate"):  # not on macOS
        with file.open("r+b") as handle:
            os.posix_fallocate(handle.fileno(), 0, file.stat().st_size + size)
