"""Table: the rows and episodes of a dataset, the common form of all formats in :mod:`lw_torchrl.data.exchange`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from typing import Any

import numpy as np
import torch

from lw_torchrl.data.dataset import DatasetError, Demonstrations
from lw_torchrl.data.memory_map import load_rows, verify
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import Suite
from lw_torchrl.transforms.qaf import plan_program

Array = np.ndarray[Any, Any]
KEYS: Mapping[str, tuple[str, ...]] = {
    **{name: (name,) for name in ("observation", "action", "expert_action", "unclipped_action")},
    "next_observation": ("next", "observation"),
    **{
        name: ("next", name) for name in ("reward_sparse", "reward_dense", "success", "done", "terminated", "truncated")
    },
}
"""The columns of an exported table, and their keys in a dataset; the other keys follow from the episodes."""
WIDE = ("observation", "next_observation", "action", "expert_action", "unclipped_action")  # the others are scalars
NAMES: Mapping[str, tuple[str, ...]] = {
    "observation": (
        "observation.state", "observation.environment_state", "observation", "observations",
        "observations.observation", "obs.state", "obs.flat", "obs", "states", "state",
    ),
    "action": ("action", "actions"),
    "expert_action": ("expert_action", "infos.expert_action"),
    "unclipped_action": ("unclipped_action", "infos.unclipped_action"),
    "next_observation": (
        "next.observation", "next_observation", "infos.next_observation", "next_obs.state", "next_obs.flat",
        "next_obs", "next_observations",
    ),
    "reward_sparse": ("next.reward_sparse", "reward_sparse", "infos.reward_sparse"),
    "reward_dense": ("next.reward", "next.reward_dense", "reward", "rewards", "reward_dense"),
    "success": ("next.success", "success", "successes", "is_success", "infos.success", "infos.is_success"),
    "done": ("next.done", "done", "dones"),
    "terminated": ("next.terminated", "terminated", "terminations", "terminals"),
    "truncated": ("next.truncated", "truncated", "truncations", "timeouts"),
}  # fmt: skip
"""The names of each column in files, the most likely first; names in groups are joined by dots."""
KNOWN = frozenset(name for names in NAMES.values() for name in names)
TASK_NAMES = ("task", "task_name", "language_instruction", "instruction", "task_description", "language")
HOLDS = "plan_holds"  # (R, S) bool: which conditions of its plan hold in a row, false beyond the plan's last
ABOUT = "lw_torchrl"  # the name of our metadata in exported files
_BLOCK = 50_000  # rows whose conditions are answered at once


class ExchangeError(DatasetError):
    """A file or folder of another format that is damaged, is not of that format, or lacks what a dataset needs."""


@dataclass(frozen=True)
class Table:
    """Rows of episodes, one after another.

    Attributes:
        columns: name to (R, ...), scalars as (R,): the names of :data:`KEYS` and :data:`HOLDS` for a table to export,
            the file's own names for one that was read.
        lengths: the number of rows of each episode.
        tasks: the task of each episode, by name or in the file's words; "" if the file does not say.
        words, plans: task to its description and to its plan's text.
        about: the metadata of the exported dataset; None for other people's files.
        demonstrations, fps: the dataset that is exported, and its steps per second.
    """

    columns: Mapping[str, Array]
    lengths: tuple[int, ...]
    tasks: tuple[str, ...]
    words: Mapping[str, str] = field(default_factory=dict)
    plans: Mapping[str, str] = field(default_factory=dict)
    about: Mapping[str, Any] | None = None
    demonstrations: Demonstrations | None = None
    fps: int = 80

    @property
    def rows(self) -> int:
        return sum(self.lengths)

    def spans(self) -> Iterator[tuple[int, int]]:
        """The first row of each episode, and the row behind its last."""
        return pairwise(accumulate(self.lengths, initial=0))

    def of_rows(self, values: Any) -> Array:
        """Repeat a value of each episode for each of its rows."""
        return np.repeat(np.asarray(values), self.lengths)


def table_of(dataset: Demonstrations, metadata: Mapping[str, Any], suite: Suite, plans: Plans | None) -> Table:
    """The checked rows of a dataset, with the truth of the conditions of its tasks' plans."""
    verify(dataset, dataset.episodes)
    rows = load_rows(dataset)
    columns: dict[str, Array] = {name: np.asarray(rows.get(key)) for name, key in KEYS.items()}
    columns |= {name: column[:, 0] for name, column in columns.items() if name not in WIDE}
    texts = {name: plans[name] for name in dataset.config.tasks if plans is not None and name in plans}
    table = Table(
        columns,
        tuple(episode.length for episode in dataset.episodes),
        tuple(episode.task for episode in dataset.episodes),
        {name: suite.tasks[name].description for name in dataset.config.tasks},
        {name: str(plan).rstrip() for name, plan in texts.items()},
        metadata,
        dataset,
        round(1 / suite.step_time),
    )
    if texts:
        columns[HOLDS] = _holds(table, Plans(texts))
    return table


def _holds(table: Table, plans: Plans) -> Array:
    program = plan_program(plans)
    number = torch.from_numpy(table.of_rows([task_id(task) for task in table.tasks]))
    planned = torch.from_numpy(table.of_rows([task in plans for task in table.tasks])).nonzero().flatten()
    observation = torch.from_numpy(table.columns["observation"])
    holds = torch.zeros(table.rows, max(len(plan.steps) for plan in plans.values()), dtype=torch.bool)
    for rows in planned.split(_BLOCK):
        holds[rows] = program(observation[rows], number[rows])
    return holds.numpy()


def names_in(columns: Mapping[str, Any], name: str) -> list[str]:
    """The names in a file under which it may have a column, the most likely first."""
    return [one for one in NAMES[name] if one in columns]
