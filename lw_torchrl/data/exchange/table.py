"""Table: the intermediate form of all exchange formats; convert datasets to tables and tables to datasets."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from lw_torchrl._util.checks import shown, unknown_name
from lw_torchrl._util.files import replacing_folder
from lw_torchrl._util.progress import Progress
from lw_torchrl.data import dataset
from lw_torchrl.data.collection_policy import Behaviour
from lw_torchrl.data.dataset import CollectConfig, DatasetError, Demonstrations, EpisodeInfo
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
"""A mapping from the columns of an exported table to keys of a dataset; all other keys follow from the episodes."""
WIDE = ("observation", "next_observation", "action", "expert_action", "unclipped_action")  # other columns are scalars
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
"""The names that files use for each column, the most likely first; nested names are joined by dots."""
KNOWN = frozenset(name for names in NAMES.values() for name in names)
TASK_NAMES = ("task", "task_name", "language_instruction", "instruction", "task_description", "language")
HOLDS = "plan_holds"  # (R, S) bool: which conditions of the plan hold in each row; padded with False
ABOUT = "lw_torchrl"  # the name of the dataset's metadata in exported files
_BLOCK = 50_000  # number of rows whose conditions are evaluated at once


class ExchangeError(DatasetError):
    """An error for a file that is corrupted, has an unknown format, or lacks columns that a dataset requires."""


@dataclass(frozen=True)
class Table:
    """The rows of consecutive episodes, in a form that is independent of file formats.

    Attributes:
        columns: arrays (R, ...) by name, scalars as (R,). A table to export has the names of :data:`KEYS` and
            :data:`HOLDS`; an imported table has the names in the file.
        lengths: the number of rows of each episode.
        tasks: the task of each episode, by name or as written in the file; "" if the file does not state the task.
        descriptions, plans: the description and the plan's text of each task, by name.
        metadata: the metadata of the exported dataset; None for files not written by :func:`export_dataset`.
        demonstrations, fps: the dataset to export, and its number of time steps per second.
    """

    columns: Mapping[str, Array]
    lengths: tuple[int, ...]
    tasks: tuple[str, ...]
    descriptions: Mapping[str, str] = field(default_factory=dict)
    plans: Mapping[str, str] = field(default_factory=dict)
    metadata: Mapping[str, Any] | None = None
    demonstrations: Demonstrations | None = None
    fps: int = 80

    @property
    def rows(self) -> int:
        return sum(self.lengths)

    def spans(self) -> Iterator[tuple[int, int]]:
        """Yield the start row and the end row (exclusive) of each episode."""
        return pairwise(accumulate(self.lengths, initial=0))

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


def names_in(columns: Mapping[str, Any], name: str) -> list[str]:
    """Return the columns of a file that may hold the dataset's column ``name``, the most likely first."""
    return [candidate for candidate in NAMES[name] if candidate in columns]


def write_dataset(
    columns: Mapping[str, Array],
    spans: Sequence[tuple[int, int]],
    description: Demonstrations,
    out: Path,
    exported_as: Path | None = None,
) -> Demonstrations:
    """Write rows as the described dataset, atomically, with one episode for each (start, end) in ``spans``.

    If the rows come from an exported dataset (``exported_as``), they must match the checksums in the description.
    """

    def episodes() -> Iterator[tuple[str, int, TensorDict]]:
        with Progress("importing", sum(end - start for start, end in spans), "row") as bar:
            for info, (start, end) in zip(description.episodes, spans, strict=True):
                rows = TensorDict({}, [end - start])
                for name, key in KEYS.items():
                    part = torch.from_numpy(np.array(columns[name][start:end], order="C"))
                    rows.set(key, part if name in WIDE else part.unsqueeze(-1))
                task = torch.full((end - start,), description.task_ids[info.task])
                rows.set("task_id", task).set(("next", "task_id"), task)
                rows.set("episode", torch.full_like(task, info.episode))
                yield info.task, info.episode, rows
                bar.update(end - start)

    with replacing_folder(out) as folder:
        infos = dataset.write_rows(folder / dataset.DATA, episodes(), description.config.layout)
        if exported_as and infos != description.episodes:
            raise ExchangeError(f"source: {str(exported_as)!r} is corrupted: the rows differ from their checksums")
        dataset.write_metadata(replace(description, root=folder, episodes=infos))
    return dataset.read_metadata(out)


def exported_columns(table: Table) -> dict[str, Array]:
    """Return the columns of a file written by :func:`export_dataset`, under the names in :data:`KEYS`."""
    columns: dict[str, Array] = {}
    for name in KEYS:
        if name == "done" and "terminations" in table.columns:  # Minari does not store "done" itself
            columns[name] = table.columns["terminations"] | table.columns["truncations"]
        elif names := names_in(table.columns, name):
            columns[name] = table.columns[names[0]]
        else:
            raise ExchangeError(f"the exported column {name} is missing")
    return columns


def complete_columns(table: Table, suite: Suite) -> tuple[dict[str, Array], list[str]]:
    """Return all columns of a dataset from an imported table, and an explanation for each missing column."""
    layout, rows = suite.layout, table.rows
    columns: dict[str, Array] = {}
    for name in KEYS:
        width = 1 if name not in WIDE else layout.action_size if "action" in name else layout.size
        names = names_in(table.columns, name)
        if fitting := [candidate for candidate in names if table.columns[candidate].size == rows * width]:
            column = table.columns[fitting[0]].reshape(rows, -1)
            columns[name] = _converted(name, fitting[0], column if name in WIDE else column[:, 0])
        elif name in ("observation", "action"):
            sizes = ", ".join(f"{name} ({column.size // rows})" for name, column in table.columns.items())
            raise ExchangeError(
                f"suite {suite.name!r} requires a column {name!r} with {width} numbers per row; the columns are {sizes}"
            )
    lacking = []
    last = np.zeros(rows, dtype=bool)
    last[np.cumsum(table.lengths) - 1] = True
    observation, action = columns["observation"], columns["action"]
    if (action != action.clip(-1, 1)).any():
        columns.setdefault("unclipped_action", action)
        action = columns["action"] = action.clip(-1, 1)
        lacking.append("actions in [-1, 1]: larger actions are clipped, as the environment does")
    for name in ("expert_action", "unclipped_action"):
        columns.setdefault(name, action)
    if "next_observation" not in columns:
        columns["next_observation"] = np.where(last[:, None], observation, np.roll(observation, -1, 0))
        lacking.append("the observation after the last action of an episode: the preceding observation is used")
    reward = columns.get("reward_sparse", columns.get("reward_dense"))
    if "success" not in columns:
        is_sparse = reward is not None and np.isin(reward, (0.0, 1.0)).all()
        columns["success"] = np.asarray(reward == 1.0) if is_sparse else np.zeros(rows, dtype=bool)
        if not is_sparse:
            lacking.append("success: all rows are marked as unsuccessful")
    if "reward_dense" not in columns or (columns["reward_dense"] == columns["success"]).all():
        columns["reward_dense"] = np.full(rows, np.nan, dtype=np.float32)
        lacking.append("a dense reward: the column is filled with NaN, so use reward='sparse' or 'cost'")
    if max(table.lengths) > suite.max_steps:
        lacking.append(f"episodes of at most {suite.max_steps} steps: the longest has {max(table.lengths)} steps")
    columns["reward_sparse"] = columns["success"].astype(np.float32)
    terminated = columns.get("terminated", ~last) & last
    return columns | {"done": last, "terminated": terminated, "truncated": last & ~terminated}, lacking


def _converted(name: str, source_name: str, column: Array) -> Array:
    if name in WIDE or name.startswith("reward"):
        with np.errstate(over="ignore"):
            column = column.astype(np.float32)
        if not np.isfinite(column).all():
            raise ExchangeError(f"{source_name} holds NaN or infinity")
        return column
    if (odd := column[~np.isin(column, (0, 1))]).size:
        raise ExchangeError(f"{source_name} must hold booleans, or the numbers 0 and 1, got {odd[0]}")
    return column.astype(bool)


def task_names(table: Table, suite: Suite, task: str | Mapping[str, str] | None) -> list[str]:
    """Return each episode's task name in the suite, from ``task`` or by matching the suite's names and descriptions."""
    known = {name: name for name in suite.tasks}
    known |= {name.removeprefix(f"{suite.name}/"): name for name in suite.tasks}
    known |= {each.description: name for name, each in suite.tasks.items()}
    if isinstance(task, Mapping):
        known |= {text: _one_task(suite, name) for text, name in task.items()}
    elif task is not None:
        return [_one_task(suite, task)] * len(table.tasks)
    names = {}
    for text in {*table.tasks}:
        plain = re.sub(r"-v[0-9]+(-goal-(observable|hidden))?$", "", text.strip())
        name = known.get(text, known.get(plain, known.get(plain.lower().replace("_", "-").replace(" ", "-"))))
        if name is None and not text:
            raise ValueError("task must be given, for example 'reach', because the files do not state the task")
        if name is None:
            hint = f"; or map it with task={{{shown(text)}: 'reach'}}, for example"
            raise ValueError(f"{unknown_name('task', text, suite.tasks)}{hint}")
        names[text] = name
    return [names[text] for text in table.tasks]


def _one_task(suite: Suite, name: str) -> str:
    if len(names := suite.named_tasks(name)) != 1:
        raise ValueError(f"task must be one task, such as 'reach', but {shown(name)} is a set of {len(names)} tasks")
    return next(iter(names))


def describe(
    names: Sequence[str], table: Table, suite: Suite, behaviour: str, episodes_per_task: int | None
) -> tuple[Demonstrations, list[tuple[int, int]]]:
    """Return the description of the dataset to import, and the (start, end) rows of each of its episodes."""
    count = Counter(names)
    if episodes_per_task is None and len({*count.values()}) > 1:
        counts = ", ".join(f"{number} of {name}" for name, number in sorted(count.items())[:5])
        hint = f"episodes_per_task must be set, for example to {min(count.values())}"
        raise ValueError(f"{hint}, because the tasks have different numbers of episodes: {counts}")
    each = min(count.values()) if episodes_per_task is None else episodes_per_task
    if short := [name for name, number in count.items() if number < each]:
        limit = f"at most {count[short[0]]}, the number of episodes of {short[0]!r}"
        raise ValueError(f"episodes_per_task must be {limit}, got {each}")
    spans: dict[str, list[tuple[int, int]]] = {name: [] for name in sorted(count)}
    for name, span in zip(names, table.spans(), strict=True):
        spans[name].append(span)
    infos = tuple(EpisodeInfo(name, turn, 0, 1, False, None, 0) for name in spans for turn in range(each))
    ordered = [span for of_task in spans.values() for span in of_task[:each]]
    config = CollectConfig(
        tasks=tuple(spans),
        episodes_per_task=each,
        seed=-1,
        max_steps=max(end - start for start, end in ordered),
        policy=Behaviour(behaviour, "imported"),
        layout=suite.layout,
    )
    task_ids = {name: task_id(name) for name in config.tasks}
    return Demonstrations(Path(ABOUT), config, {}, task_ids, infos, dict.fromkeys(config.tasks, each)), ordered
