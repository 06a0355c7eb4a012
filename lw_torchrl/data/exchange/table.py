"""Table: the rows of a dataset in the form that the exported formats share."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch

from lw_torchrl.data import dataset
from lw_torchrl.data.dataset import Demonstrations
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import Suite
from lw_torchrl.transforms.qaf import latches_of_rows, plan_program

Array = np.ndarray[Any, Any]
KEYS: Mapping[str, tuple[str, ...]] = {
    **{name: (name,) for name in ("observation", "action", "expert_action", "unclipped_action")},
    "next_observation": ("next", "observation"),
    **{
        name: ("next", name) for name in ("reward_sparse", "reward_dense", "success", "done", "terminated", "truncated")
    },
}
"""A mapping from the columns of an exported table to keys of a dataset, except keys that the episodes determine."""
WIDE = ("observation", "next_observation", "action", "expert_action", "unclipped_action")  # other columns are scalars
HOLDS = "plan_holds"  # (R, S) bool: which conditions of the plan hold in each row; padded with False
ABOUT = "lw_torchrl"  # the name of the dataset's metadata in exported files
_BLOCK = 50_000  # number of rows whose conditions are evaluated at once


class EpisodeRows:
    """Rows of several episodes, one episode after another."""

    lengths: tuple[int, ...]  # rows of each episode

    @property
    def rows(self) -> int:
        return sum(self.lengths)

    def spans(self) -> Iterator[tuple[int, int]]:
        """Yield the start row and the end row (exclusive) of each episode."""
        return pairwise(accumulate(self.lengths, initial=0))


@dataclass(frozen=True)
class Table(EpisodeRows):
    """The rows of consecutive episodes to export.

    Attributes:
        columns: arrays (R, ...) by the names of :data:`KEYS` and :data:`HOLDS`, scalars as (R,).
        lengths, tasks: the number of rows and the task of each episode.
        descriptions, plans: the description and the plan's text of each task, by name.
        metadata: the dataset's metadata.
        demonstrations, fps: the dataset, and its number of time steps per second.
    """

    columns: Mapping[str, Array]
    lengths: tuple[int, ...]
    tasks: tuple[str, ...]
    descriptions: Mapping[str, str]
    plans: Mapping[str, str]
    metadata: Mapping[str, Any]
    demonstrations: Demonstrations
    fps: int

    def repeat(self, values: Any) -> Array:
        """Repeat each episode's value for every row of the episode."""
        return np.repeat(np.asarray(values), self.lengths)


def table_of(demonstrations: Demonstrations, metadata: Mapping[str, Any], suite: Suite, plans: Plans | None) -> Table:
    """Verify a dataset's checksums, then return a table of its rows and the truth values of its plans' conditions."""
    dataset.verify(demonstrations, demonstrations.episodes)
    rows, tasks = dataset.load_rows(demonstrations), demonstrations.config.tasks
    columns: dict[str, Array] = {name: np.asarray(rows.get(key)) for name, key in KEYS.items()}
    columns |= {name: column[:, 0] for name, column in columns.items() if name not in WIDE}
    planned = {name: plans[name] for name in tasks if plans is not None and name in plans}
    table = Table(
        columns,
        tuple(episode.length for episode in demonstrations.episodes),
        tuple(episode.task for episode in demonstrations.episodes),
        {name: suite.tasks[name].description for name in tasks},
        {name: str(plan).rstrip() for name, plan in planned.items()},
        metadata,
        demonstrations,
        round(1 / suite.step_time),
    )
    if planned:
        columns[HOLDS] = _holds(table, Plans(planned))
    return table


def _holds(table: Table, plans: Plans) -> Array:
    program = plan_program(plans)
    task = torch.from_numpy(table.repeat([task_id(task) for task in table.tasks]))
    planned = torch.from_numpy(table.repeat([task in plans for task in table.tasks])).nonzero().flatten()
    observation = torch.from_numpy(table.columns["observation"])
    latches = torch.zeros(table.rows, program.num_latches, dtype=torch.bool)
    if program.num_latches:
        episode = torch.from_numpy(table.repeat(list(range(len(table.tasks)))))
        latches[planned] = latches_of_rows(program, observation[planned], task[planned], episode[planned])
    holds = torch.zeros(table.rows, max(len(plan.steps) for plan in plans.values()), dtype=torch.bool)
    for rows in planned.split(_BLOCK):
        holds[rows] = program(observation[rows], task[rows], latches[rows])
    return holds.numpy()
