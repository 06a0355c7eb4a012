"""Table: the rows and episodes of a dataset, as every format of :mod:`lw_torchrl.data.exchange` holds them."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import accumulate, pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

from lw_torchrl._checks import counted, shown
from lw_torchrl.data.dataset import DatasetError, Demonstrations
from lw_torchrl.data.memory_map import map_rows, verify
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import Tasks, task_id
from lw_torchrl.transforms.qaf import plan_program

Array = np.ndarray[Any, Any]
OURS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "observation": ("observation",),
        "action": ("action",),
        "expert_action": ("expert_action",),
        "unclipped_action": ("unclipped_action",),
        "next_observation": ("next", "observation"),
        "reward_sparse": ("next", "reward_sparse"),
        "reward_dense": ("next", "reward_dense"),
        **{name: ("next", name) for name in ("success", "done", "terminated", "truncated")},
    }
)
"""A table's columns to those of a dataset; the others follow from the episodes."""
HOLDS = "plan_holds"  # (R, S) bool: which conditions of its plan hold in a row, false beyond the plan's last
ABOUT = "lw_torchrl"  # under this name files hold the metadata of a dataset of ours
_NAMES = tomllib.loads((files(__package__) / "data" / "columns.toml").read_text("utf-8"))
NAMES: Mapping[str, list[str]] = MappingProxyType(_NAMES["rows"])
EPISODES: Mapping[str, list[str]] = MappingProxyType(_NAMES["episodes"])
_ENDS = ("done", "terminated", "truncated")
_BLOCK = 50_000  # rows whose conditions are answered at once


class ExchangeError(DatasetError):
    """A file or folder of another format that is damaged, is not of that format, or lacks what a dataset needs."""


@dataclass(frozen=True)
class Table:
    """Rows of episodes, one after another.

    Attributes:
        columns: name to (R, ...), scalars as (R,): those of :data:`OURS` and :data:`HOLDS`, or what a file has, under
            the file's own names.
        lengths: the rows of each episode.
        tasks: the task of each episode, by name, or in other words; "" where a file does not say.
        words, plans: task to its description and to its plan's text.
        about: the metadata of a dataset of ours; None of others.
        found: the dataset that a table was made of, which may have pictures.
    """

    columns: Mapping[str, Array]
    lengths: tuple[int, ...]
    tasks: tuple[str, ...]
    words: Mapping[str, str] = field(default_factory=dict)
    plans: Mapping[str, str] = field(default_factory=dict)
    about: Mapping[str, Any] | None = None
    found: Demonstrations | None = None

    @property
    def rows(self) -> int:
        return sum(self.lengths)

    def spans(self) -> Iterator[tuple[int, int]]:
        """The first row of each episode, and the one behind its last."""
        return pairwise(accumulate(self.lengths, initial=0))

    def of_rows(self, values: Any) -> Array:
        """A value of each episode, for each of its rows."""
        return np.repeat(np.asarray(values), self.lengths)


def table_of(found: Demonstrations, metadata: Mapping[str, Any], tasks: Tasks, plans: Plans | None) -> Table:
    """A dataset's rows, which are checked; with the truth of their plans' conditions."""
    verify(found, found.episodes)
    rows = map_rows(found)
    columns: dict[str, Array] = {}
    for name, key in OURS.items():
        column = np.asarray(rows.get(key))
        columns[name] = (
            column[:, 0] if column.shape[1:] == (1,) and len(key) > 1 and name != "next_observation" else column
        )
    own = {name: plans[name] for name in found.config.tasks if plans is not None and name in plans}
    table = Table(
        columns,
        tuple(one.length for one in found.episodes),
        tuple(one.task for one in found.episodes),
        {name: tasks[name].description for name in found.config.tasks},
        {name: str(plan).rstrip() for name, plan in own.items()},
        metadata,
        found,
    )
    if own:
        columns[HOLDS] = _holds(table, Plans(own))
    return table


def _holds(table: Table, plans: Plans) -> Array:
    program = plan_program(plans)
    number = torch.from_numpy(table.of_rows([task_id(task) for task in table.tasks]))
    there = torch.from_numpy(table.of_rows([task in plans for task in table.tasks])).nonzero().flatten()
    observation = torch.from_numpy(table.columns["observation"])
    steps = max(len(plan.steps) for plan in plans.values())
    found = torch.zeros(table.rows, steps, dtype=torch.bool)
    for rows in there.split(_BLOCK):
        found[rows] = program(observation[rows], number[rows])
    return found.numpy()


def of_names(columns: Mapping[str, Any], names: Mapping[str, list[str]], name: str) -> list[str]:
    """The names in a file under which a column of ours may stand in it, the likeliest first."""
    return [one for one in names[name] if one in columns]


def lengths_of(source: Path, columns: Mapping[str, Array]) -> tuple[int, ...]:
    """The rows of each episode: until its number changes, or, without numbers, until it is done.

    ExchangeError where another column denies it: an episode that is done before its last row, or whose frames do not
    count up by 1.
    """
    rows = len(next(iter(columns.values())))
    named = [name for kind in _ENDS for name in of_names(columns, NAMES, kind)]
    ends = {name: booleans(source, name, one_each(source, name, columns[name])) for name in named}
    if numbers := of_names(columns, EPISODES, "episode"):
        episode = one_each(source, numbers[0], columns[numbers[0]])
        change = np.flatnonzero(episode[1:] != episode[:-1]) + 1
        if len(np.unique(episode)) <= len(change):
            raise ExchangeError(f"source: {str(source)!r}: the rows of an episode must come one after another")
        for name, end in ends.items():
            if len(early := np.setdiff1d(np.flatnonzero(end[:-1]) + 1, change)):
                where = f"it is true in row {early[0] - 1}, {numbers[0]} {episode[early[0]]} goes on"
                raise ExchangeError(f"source: {str(source)!r}: {name} must be true only where an episode ends, {where}")
    elif ends:
        change = np.flatnonzero(np.any([end[:-1] for end in ends.values()], axis=0)) + 1
    else:
        wanted = ", ".join([*EPISODES["episode"], *(name for kind in _ENDS for name in NAMES[kind])])
        raise ExchangeError(f"source: {str(source)!r} lacks episodes: it has none of the columns {wanted}")
    for name in of_names(columns, EPISODES, "frame"):
        frame = one_each(source, name, columns[name])
        if len(jump := np.setdiff1d(np.flatnonzero(frame[1:] != frame[:-1] + 1) + 1, change)):
            told = f"row {jump[0]} has {frame[jump[0]]} after {frame[jump[0] - 1]}"
            raise ExchangeError(f"source: {str(source)!r}: {name} must count up by 1 within an episode, {told}")
    return tuple(np.diff(np.concatenate([[0], change, [rows]])).tolist())


def one_each(source: Path, name: str, column: Array) -> Array:
    """A column of one number a row, (R,); ExchangeError for another."""
    if column.size != len(column):
        wide = column.size // len(column)
        raise ExchangeError(f"source: {str(source)!r}: {name} must hold one number in each row, it holds {wide}")
    return column.reshape(-1)


def booleans(source: Path, name: str, column: Array) -> Array:
    """A column of booleans, or of 0 and 1; ExchangeError for others."""
    if column.dtype.kind != "b" and len(odd := column[~np.isin(column, (0, 1))]):
        raise ExchangeError(f"source: {str(source)!r}: {name} must hold booleans, or 0 and 1, it holds {odd[0]}")
    return column.astype(bool)


def of_episodes(
    source: Path, name: str, column: Array, lengths: tuple[int, ...], words: Mapping[int, Any]
) -> list[Any]:
    """The word of each episode, of its number in a column; ExchangeError where rows of an episode differ."""
    first = np.cumsum([0, *lengths[:-1]])
    if len(odd := np.flatnonzero(column != np.repeat(column[first], lengths))):
        episode = int(np.searchsorted(np.cumsum(lengths), odd[0], side="right"))
        both = " and ".join(shown(words.get(int(column[row]))) for row in (first[episode], odd[0]))
        told = f"episode {episode} has {both}"
        raise ExchangeError(f"source: {str(source)!r}: {name} must be the same in all rows of an episode, {told}")
    return [words.get(number) for number in column[first].tolist()]


def check_rows(source: Path, columns: Mapping[str, Array], rows: int) -> None:
    """Raise unless all columns have so many rows, at least one."""
    if odd := [f"{name} has {len(column)}" for name, column in columns.items() if len(column) != rows]:
        raise ExchangeError(f"source: {str(source)!r} is damaged: it is of {counted(rows, 'row')}, {odd[0]}")
    if not rows:
        raise ExchangeError(f"source: {str(source)!r} holds no rows")
