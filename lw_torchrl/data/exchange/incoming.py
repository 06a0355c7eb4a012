"""A table as a dataset of ours: whole as it was, where it was one, or what others hold, with what it lacks named."""

from __future__ import annotations

import json
import re
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from lw_torchrl._checks import counted, shown, unknown_name
from lw_torchrl._files import replacing_folder
from lw_torchrl._progress import Progress
from lw_torchrl.data import dataset
from lw_torchrl.data.behaviours import Behaviour
from lw_torchrl.data.dataset import CollectConfig, Demonstrations, EpisodeInfo
from lw_torchrl.data.exchange.table import ABOUT, NAMES, OURS, Array, ExchangeError, Table, booleans, of_names
from lw_torchrl.data.memory_map import describe_episode, write_rows
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import Suite

_SIZES = {"observation": "size", "next_observation": "size"}  # the others of several numbers are actions
_ACTIONS = ("action", "expert_action", "unclipped_action")
_WIDE, _NEEDED = (*_SIZES, *_ACTIONS), ("observation", "action")


def write_incoming(
    table: Table, source: Path, out: Path, made: Demonstrations, lacking: Sequence[str] = ()
) -> Demonstrations:
    """Write a table's rows, whose columns have our names, as the dataset that is described; whole or not at all."""
    infos: list[EpisodeInfo] = []

    def episodes() -> Iterator[TensorDict]:
        with Progress("importing", table.rows, "row") as bar:
            for number, (info, (start, end)) in enumerate(zip(made.episodes, table.spans(), strict=True)):
                rows = _rows_of(table, start, end)
                task = torch.full((end - start,), made.task_ids[info.task])
                rows.set("task_id", task).set(("next", "task_id"), task)
                rows.set("episode", torch.full_like(task, info.episode))
                rows.set(("collector", "traj_ids"), torch.full_like(task, number))
                infos.append(describe_episode(info.task, info.episode, start, rows))
                if table.about is not None and infos[-1] != info:
                    which = f"episode {info.episode} of {info.task!r} is not as its metadata say"
                    instead = f"without {ABOUT!r} among these it comes in as anyone's rows"
                    raise ExchangeError(f"source: {str(source)!r} is damaged, or was edited: {which}; {instead}")
                yield rows
                bar.update(end - start)

    with replacing_folder(out) as folder:
        write_rows(folder / dataset.DATA, episodes(), made.config.layout)
        dataset.write_metadata(replace(made, root=folder, episodes=tuple(infos)))
    if lacking:
        warnings.warn(f"source: {str(source)!r} lacks {'; '.join(lacking)}", stacklevel=4)
    return dataset.read_metadata(out)


def _rows_of(table: Table, start: int, end: int) -> TensorDict:
    rows = TensorDict({}, [end - start])
    for name, key in OURS.items():
        part = torch.from_numpy(np.array(table.columns[name][start:end], order="C"))
        rows.set(key, part.unsqueeze(-1) if part.dim() == 1 else part)
    return rows


def own_description(table: Table, source: Path, folder: Path) -> Demonstrations:
    """The description of a dataset of ours, as an export carries it; ExchangeError where the rows are not of it."""
    where = f"source: {str(source)!r}"
    (folder / dataset.METADATA).write_text(json.dumps(table.about), encoding="utf-8")
    try:
        found = dataset.read_metadata(folder)
    except dataset.DatasetError as error:
        raise ExchangeError(
            f"{where} is damaged: its metadata are not those of a dataset ({str(error)[:300]})"
        ) from error
    if tuple(one.length for one in found.episodes) != table.lengths:
        rows = counted(found.num_steps, "row")
        raise ExchangeError(
            f"{where} is damaged: its episodes are not the {len(found.episodes)}, of {rows}, that were exported"
        )
    return found


def with_our_names(table: Table, source: Path) -> Table:
    """A table that was exported, with a dataset's columns; ExchangeError where one is missing."""
    found: dict[str, Array] = {}
    for name in OURS:
        if name == "done" and "terminations" in table.columns:  # Minari has no other
            found[name] = table.columns["terminations"] | table.columns["truncations"]
            continue
        if not (there := of_names(table.columns, NAMES, name)):
            raise ExchangeError(f"source: {str(source)!r} is damaged: it lacks {name}, which was exported")
        column = table.columns[there[0]]
        found[name] = column.astype(bool) if name == "done" else column
    return replace(table, columns=found)


def as_ours(table: Table, source: Path, suite: Suite) -> tuple[Table, list[str]]:
    """The table with a dataset's columns, from what a file has under other names; and what was lacking, in words.

    ExchangeError where there are no observations or actions of the suite's size.
    """
    layout, rows = suite.layout, table.rows
    found: dict[str, Array] = {}
    for name in OURS:
        width = layout.action_size if name in _ACTIONS else getattr(layout, _SIZES.get(name, ""), 1)
        there = of_names(table.columns, NAMES, name)
        fits = (one for one in there if table.columns[one][0].size == width)
        if (named := next(fits, None)) is not None:
            column = table.columns[named].reshape(rows, -1)
            found[name] = _of_kind(source, name, named, column if name in _WIDE else column[:, 0])
        elif name in _NEEDED:
            sizes = (
                ", ".join(f"{one} has {table.columns[one][0].size}" for one in there)
                or f"it has none of {', '.join(NAMES[name])}"
            )
            raise ExchangeError(
                f"source: {str(source)!r} lacks {name}, a column of {width} numbers as in {suite.name!r}: {sizes}"
            )
    lacking = []
    last = np.zeros(rows, dtype=bool)
    last[np.cumsum(table.lengths) - 1] = True
    observation, sparse = found["observation"], found.get("reward_sparse", found.get("reward_dense"))
    if (found["action"] != found["action"].clip(-1, 1)).any():
        found.setdefault("unclipped_action", found["action"])
        found["action"] = found["action"].clip(-1, 1)
        lacking.append("actions in [-1, 1]: those beyond are clipped, as they are when they are executed")
    for name in ("expert_action", "unclipped_action"):
        found.setdefault(name, found["action"])
    if "next_observation" not in found:
        after = np.concatenate([observation[1:], observation[-1:]])
        after[last] = observation[last]
        found["next_observation"] = after
        lacking.append("the observation after the last action of an episode: the one before it stands there")
    if "success" not in found:
        known = sparse is not None and np.isin(sparse, (0.0, 1.0)).all()
        found["success"] = np.asarray(sparse == 1.0) if known else np.zeros(rows, dtype=bool)
        if not known:
            lacking.append("success: no row has one")
    if "reward_dense" not in found or (found["reward_dense"] == found["success"]).all():
        found["reward_dense"] = np.full(rows, np.nan, dtype=np.float32)
        lacking.append("a dense reward: it is NaN, take reward='sparse' or 'cost'")
    found["reward_sparse"] = found["success"].astype(np.float32)
    for name in ("terminated", "truncated"):  # robomimic's "dones" may tell of success
        if len(early := np.flatnonzero(found.get(name, last) & ~last)):
            told = f"it is true in row {early[0]}, where an episode goes on"
            raise ExchangeError(f"source: {str(source)!r}: {name} must be true only where an episode ends, {told}")
    terminated = found.get("terminated", np.zeros(rows, dtype=bool)) & last
    found |= {"done": last, "terminated": terminated, "truncated": last & ~terminated}
    return replace(table, columns=found), lacking


def _of_kind(source: Path, name: str, named: str, column: Array) -> Array:
    if name not in _WIDE and not name.startswith("reward"):
        return booleans(source, named, column)
    with np.errstate(over="ignore"):  # it is told as infinity
        found = column.astype(np.float32)
    if not np.isfinite(found).all():
        raise ExchangeError(f"source: {str(source)!r}: {named} must hold finite numbers, it has NaN or infinity")
    return found


def task_names(table: Table, source: Path, suite: Suite, task: str | Mapping[str, str] | None) -> list[str]:
    """The suite's name of each episode's task: ``task`` says it, or the file in a name or description that we know."""
    known = {name: name for name in suite.tasks}
    known |= {name.removeprefix(f"{suite.name}/"): name for name in suite.tasks}
    known |= {one.description: name for name, one in suite.tasks.items()}
    if isinstance(task, Mapping):
        known |= {said: _one_task(suite, name) for said, name in task.items()}
    elif task is not None:
        return [_one_task(suite, task)] * len(table.tasks)
    found = []
    for said in table.tasks:
        plain = re.sub(r"-v[0-9]+(-goal-(observable|hidden))?$", "", said.strip())
        name = known.get(said, known.get(plain, known.get(plain.lower().replace("_", "-").replace(" ", "-"))))
        if name is None:
            if not said:
                raise ExchangeError(
                    f"source: {str(source)!r} lacks the task of its episodes; give task='reach', for example"
                )
            more = "; task= may map it, {" + f"{shown(said)}: 'reach'" + "} for example"
            raise ValueError(f"{unknown_name('task', said, suite.tasks)}{more}")
        found.append(name)
    return found


def _one_task(suite: Suite, name: str) -> str:
    if len(found := suite.named_tasks(name)) != 1:
        raise ValueError(f"task must be one task, {shown(name)} is a set of {len(found)}; 'reach', for example")
    return next(iter(found))


def foreign_description(
    names: Sequence[str], table: Table, source: Path, suite: Suite, behaviour: str, episodes_per_task: int | None
) -> tuple[Demonstrations, list[int]]:
    """What a dataset of the episodes of others is, and which of them are in it, in its order."""
    number = Counter(names)
    if episodes_per_task is None and len({*number.values()}) > 1:
        told = ", ".join(f"{times} of {name}" for name, times in sorted(number.items())[:5])
        least = min(number.values())
        raise ValueError(f"episodes_per_task must be given, {least} for example: {str(source)!r} holds {told} episodes")
    each = min(number.values()) if episodes_per_task is None else episodes_per_task
    if short := [name for name, times in number.items() if times < each]:
        raise ValueError(
            f"episodes_per_task must be at most {number[short[0]]}, the episodes of {short[0]!r}, got {each}"
        )
    order = [place for name in sorted(number) for place in [p for p, one in enumerate(names) if one == name][:each]]
    config = CollectConfig(
        tasks=tuple(sorted(number)),
        episodes_per_task=each,
        seed=-1,
        max_steps=max(table.lengths[place] for place in order),
        policy=Behaviour(behaviour, "imported"),
        layout=suite.layout,
    )
    task_ids = {name: task_id(name) for name in config.tasks}
    infos = tuple(EpisodeInfo(names[place], turn % each, 0, 1, False, None, 0) for turn, place in enumerate(order))
    return Demonstrations(source, config, {}, task_ids, infos, dict.fromkeys(config.tasks, each)), order


def in_order(table: Table, order: Sequence[int]) -> Table:
    """A table of the episodes at these places."""
    if [*order] == [*range(len(table.lengths))]:
        return table
    spans = [*table.spans()]
    rows = np.concatenate([np.arange(*spans[place]) for place in order])
    lengths, tasks = tuple(table.lengths[place] for place in order), tuple(table.tasks[place] for place in order)
    return replace(
        table, columns={name: one[rows] for name, one in table.columns.items()}, lengths=lengths, tasks=tasks
    )
