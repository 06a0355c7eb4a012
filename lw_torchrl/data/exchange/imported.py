"""Read the files of other formats in a child process, and convert their rows to a dataset."""

from __future__ import annotations

import json
import re
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

from lw_torchrl._util.checks import shown, unknown_name
from lw_torchrl._util.files import replacing_folder, run_limited
from lw_torchrl._util.progress import Progress
from lw_torchrl.data import dataset
from lw_torchrl.data.collection_policy import Behaviour
from lw_torchrl.data.dataset import CollectConfig, DatasetError, Demonstrations, EpisodeInfo
from lw_torchrl.data.exchange import reader
from lw_torchrl.data.exchange.table import ABOUT, KEYS, WIDE, Array, EpisodeRows
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import Suite


class ExchangeError(DatasetError):
    """An error for a file that is corrupted, has an unknown format, or lacks columns that a dataset requires."""


@dataclass(frozen=True)
class ImportedTable(EpisodeRows):
    """Rows of consecutive episodes, imported from another format; see :class:`.reader.Files` for the attributes."""

    columns: Mapping[str, Array]
    lengths: tuple[int, ...]
    tasks: tuple[tuple[str, ...], ...]
    sources: Mapping[str, str]
    unfit: Mapping[str, str]
    ends_known: bool
    notes: Sequence[str]

    def explain(self, name: str) -> str:
        """Return text to append to a missing-column warning if the files have this column in a wrong size, else ""."""
        return f" ({self.unfit[name]} does not have one number per row)" if name in self.unfit else ""


def read_files(source: Path, is_hdf5: bool, layout: Layout) -> ImportedTable:
    """Read HDF5 or parquet files in a child process with time and memory limits; see :mod:`.reader`."""
    widths = {name: 1 if name not in WIDE else layout.action_size if "action" in name else layout.size for name in KEYS}
    order = [name for name in reader.NAMES if name in widths]
    stored = reader.stored_bytes(reader.data_files(source, reader.HDF5 if is_hdf5 else reader.PARQUET))
    with TemporaryDirectory() as folder:
        allowed = 100 * 10**6 + 50 * stored  # bytes of numbers; compressed files are smaller than their numbers
        argument = json.dumps([is_hdf5, allowed, {name: widths[name] for name in order}])
        command = [sys.executable, "-P", reader.__file__, str(source.absolute()), folder, argument]
        done = run_limited(command, stored)
        report = Path(folder, "table.json")
        if done.returncode or not report.is_file():
            last = done.stderr.decode("utf-8", "replace").strip().splitlines()[-1:]
            raise ExchangeError(f"reading failed (exit status {done.returncode}; {last})")
        table: dict[str, Any] = json.loads(report.read_text("utf-8"))
        if "refused" in table:
            raise ExchangeError(table["refused"])
        if "missing" in table:
            raise ModuleNotFoundError(f"no module named {table['missing']}", name=table["missing"])
        if "system" in table:
            raise OSError(*table["system"])
        columns = {name: np.load(Path(folder, f"{name}.npy"), allow_pickle=False) for name in table.pop("columns")}
    table |= {"lengths": tuple(table["lengths"]), "tasks": tuple(map(tuple, table["tasks"]))}
    return ImportedTable(columns, **table)


def find_ends(table: ImportedTable, suite: Suite, episode_length: int | None) -> ImportedTable:
    """Return the table with the ends of all episodes. If the files do not state the ends, derive them and add a note.

    A row that is marked as done, terminated or truncated ends an episode, unless marked rows are consecutive, because
    such marks describe a state, such as success. Without usable marks, episodes have ``episode_length`` steps, or the
    suite's maximum.
    """
    if table.ends_known:
        if episode_length is not None:
            raise ValueError(f"episode_length must not be given, got {episode_length}: the files state all ends")
        return table
    marks = np.zeros(table.rows, dtype=bool)
    for name in ("done", "terminated", "truncated"):
        marks |= table.columns.get(name, marks).reshape(table.rows) == 1
    if episode_length is not None or (marks[1:] & marks[:-1]).any():
        marks[:] = False
    limit, lengths, tasks, is_cut = episode_length or suite.max_steps, [], [], False
    for (start, end), task in zip(table.spans(), table.tasks, strict=True):
        inner = np.flatnonzero(marks[start:end]) + 1 + start
        parts = [*pairwise(np.unique([start, *inner, end]).tolist())]
        for first, last in parts:
            if len(parts) == 1 and (last - first) % limit and (last - first > limit or episode_length is not None):
                rows = f"{last - first} rows, because the files do not state where episodes end"
                raise ValueError(f"episode_length must divide {rows}; got {limit}")
            number = -(-(last - first) // limit)
            is_cut |= not inner.size or number > 1
            lengths += [limit] * (number - 1) + [last - first - limit * (number - 1)]
            tasks += [task] * number
    note = f"the ends of episodes: {len(lengths)} episodes of at most {limit} steps are assumed"
    return replace(table, lengths=tuple(lengths), tasks=tuple(tasks), notes=(*table.notes, *[note] * is_cut))


def write_dataset(
    columns: Mapping[str, Array],
    spans: Sequence[tuple[int, int]],
    description: Demonstrations,
    out: Path,
    exported_as: Path | None = None,
) -> Demonstrations:
    """Write rows atomically as a dataset with this description; each (start, end) in ``spans`` is an episode.

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


def exported_columns(table: ImportedTable) -> dict[str, Array]:
    """Return the columns of a file written by :func:`export_dataset`."""
    columns = dict(table.columns)
    if "done" not in columns and {"terminated", "truncated"} <= columns.keys():  # Minari does not store "done" itself
        columns["done"] = columns["terminated"] | columns["truncated"]
    if lacking := [name for name in KEYS if name not in columns]:
        raise ExchangeError(f"the exported column {lacking[0]} is missing")
    return columns


def complete_columns(table: ImportedTable, suite: Suite) -> tuple[dict[str, Array], list[str]]:
    """Return all columns of a dataset, built from an imported table, and a note on each column that the table lacks."""
    rows, lacking = table.rows, [*table.notes]
    used = ["observation", "action", "next_observation", "reward_dense"]
    used.append("success" if "success" in table.columns else "reward_sparse")  # unused columns must not cause errors
    columns: dict[str, Array] = {}
    for name in [name for name in used if name in table.columns]:
        column = table.columns[name].reshape((rows, -1) if name in WIDE else rows)
        columns[name] = _converted(name, table.sources.get(name, name), column)
    last = np.zeros(rows, dtype=bool)
    last[np.cumsum(table.lengths) - 1] = True
    observation, action = columns["observation"], columns["action"]
    if (action != action.clip(-1, 1)).any():
        columns.setdefault("unclipped_action", action)
        action = columns["action"] = action.clip(-1, 1)
        lacking.append("actions in [-1, 1]: larger actions are clipped, as the environment does")
    columns["expert_action"] = action
    columns.setdefault("unclipped_action", action)
    if "next_observation" not in columns:
        columns["next_observation"] = np.where(last[:, None], observation, np.roll(observation, -1, 0))
        lacking.append("the observation after the last action of an episode: the preceding observation is used")
    reward = columns.get("reward_sparse", columns.get("reward_dense"))
    if "success" not in columns:
        is_sparse = reward is not None and np.isin(reward, (0.0, 1.0)).all()
        columns["success"] = np.asarray(reward == 1.0) if is_sparse else np.zeros(rows, dtype=bool)
        if not is_sparse:
            lacking.append("success: all rows are marked as unsuccessful" + table.explain("success"))
    if "reward_dense" not in columns or (columns["reward_dense"] == columns["success"]).all():
        columns["reward_dense"] = np.full(rows, np.nan, dtype=np.float32)
        hint = "the column is filled with NaN, so use reward='sparse' or 'cost'"
        lacking.append(f"a dense reward: {hint}{table.explain('reward_dense')}")
    elif number := np.isnan(columns["reward_dense"]).sum():
        lacking.append(f"a dense reward in {number} rows, which keep NaN")
    if max(table.lengths) > suite.max_steps:
        lacking.append(f"episodes of at most {suite.max_steps} steps: the longest has {max(table.lengths)} steps")
    columns["reward_sparse"] = columns["success"].astype(np.float32)
    terminated = (table.columns.get("terminated", ~last).reshape(rows) == 1) & last
    return columns | {"done": last, "terminated": terminated, "truncated": last & ~terminated}, lacking


def _converted(name: str, source_name: str, column: Array) -> Array:
    if name in WIDE or name.startswith("reward"):
        with np.errstate(over="ignore"):
            column = column.astype(np.float32)
        if not np.isfinite(column).all() and not (name == "reward_dense" and not np.isinf(column).any()):
            raise ExchangeError(f"{source_name} holds NaN or infinity")
        return column
    if (odd := column[~np.isin(column, (0, 1))]).size:
        raise ExchangeError(f"{source_name} must hold booleans, or the numbers 0 and 1, got {odd[0]}")
    return column.astype(bool)


def task_names(table: ImportedTable, suite: Suite, task: str | Mapping[str | int, str | int] | None) -> list[str]:
    """Return each episode's task name in the suite, from ``task`` or by matching the suite's names and descriptions."""
    known = {name: name for name in suite.tasks}
    known |= {name.removeprefix(f"{suite.name}/"): name for name in suite.tasks}
    known |= {each.description: name for name, each in suite.tasks.items()}
    mapped: dict[str, str] = {}
    if isinstance(task, Mapping):
        for text, name in task.items():
            if isinstance(name, int):  # a table of numbers by name
                text, name = name, str(text)
            mapped[str(text)] = _one_task(suite, known.get(_plain(name), name))
    elif task is not None:
        return [_one_task(suite, task)] * len(table.tasks)
    names = {}
    for texts in {*table.tasks}:
        found = [mapped[text] for text in texts if text in mapped]
        found += [known[text] for each in texts for text in (each, _plain(each), _hyphens(each)) if text in known]
        if not found:
            hint = f" (to map it, pass for example task={{{shown(texts[0])}: 'reach'}})" if texts else ""
            raise ValueError(f"{unknown_name('task', texts[0] if texts else None, suite.tasks)}{hint}")
        names[texts] = found[0]
    return [names[texts] for texts in table.tasks]


def _plain(text: str) -> str:
    """Remove the version from a task's name: "reach-v3" is "reach"."""
    return re.sub(r"-v[0-9]+(-goal-(observable|hidden))?$", "", text.strip())


def _hyphens(text: str) -> str:
    return _plain(text.strip().lower().replace("_", "-").replace(" ", "-"))


def _one_task(suite: Suite, name: str) -> str:
    if len(names := suite.named_tasks(name)) != 1:
        raise ValueError(f"task must be one task, such as 'reach', but {shown(name)} is a set of {len(names)} tasks")
    return next(iter(names))


def describe(
    names: Sequence[str], table: ImportedTable, suite: Suite, behaviour: str, episodes_per_task: int | None
) -> tuple[Demonstrations, list[tuple[int, int]]]:
    """Return the description of the dataset to import, and the (start, end) rows of each of its episodes."""
    count = Counter(names)
    if episodes_per_task is None and len({*count.values()}) > 1:
        counts = ", ".join(f"{number} of {name}" for name, number in sorted(count.items())[:5])
        raise ValueError(f"episodes_per_task must be given, because tasks have different numbers of episodes: {counts}")
    each = min(count.values()) if episodes_per_task is None else episodes_per_task
    if each > min(count.values()):
        raise ValueError(f"episodes_per_task must be at most {min(count.values())} for all tasks, got {each}")
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
