"""Convert imported tables to datasets: our exports unchanged, others with a warning about missing columns."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from lw_torchrl._util.checks import shown, unknown_name
from lw_torchrl._util.files import replacing_folder
from lw_torchrl._util.progress import Progress
from lw_torchrl.data import dataset
from lw_torchrl.data.behaviours import Behaviour
from lw_torchrl.data.dataset import CollectConfig, Demonstrations, EpisodeInfo
from lw_torchrl.data.exchange.table import ABOUT, KEYS, WIDE, Array, ExchangeError, Table, names_in
from lw_torchrl.data.memory_map import describe_episode, write_rows
from lw_torchrl.language.tasks import task_id
from lw_torchrl.suites.suite import Suite


def write_dataset(
    columns: Mapping[str, Array],
    spans: Sequence[tuple[int, int]],
    description: Demonstrations,
    out: Path,
    exported_as: Path | None = None,
) -> Demonstrations:
    """Write rows, an episode for each span, as the dataset that is described; whole or not at all. Rows of an export
    must match the checksums in the description."""
    infos: list[EpisodeInfo] = []

    def episodes() -> Iterator[TensorDict]:
        with Progress("importing", sum(end - start for start, end in spans), "row") as bar:
            for number, (info, (start, end)) in enumerate(zip(description.episodes, spans, strict=True)):
                rows = TensorDict({}, [end - start])
                for name, key in KEYS.items():
                    part = torch.from_numpy(np.array(columns[name][start:end], order="C"))
                    rows.set(key, part if name in WIDE else part.unsqueeze(-1))
                task = torch.full((end - start,), description.task_ids[info.task])
                rows.set("task_id", task).set(("next", "task_id"), task)
                rows.set("episode", torch.full_like(task, info.episode))
                rows.set(("collector", "traj_ids"), torch.full_like(task, number))
                first = infos[-1].start + infos[-1].length if infos else 0
                infos.append(describe_episode(info.task, info.episode, first, rows))
                yield rows
                bar.update(end - start)

    with replacing_folder(out) as folder:
        write_rows(folder / dataset.DATA, episodes(), description.config.layout)
        if exported_as and tuple(infos) != description.episodes:
            raise ExchangeError(f"source: {str(exported_as)!r} is damaged: its rows differ from their checksums")
        dataset.write_metadata(replace(description, root=folder, episodes=tuple(infos)))
    return dataset.read_metadata(out)


def exported_columns(table: Table) -> dict[str, Array]:
    """The columns of a table that was exported, under our names."""
    columns: dict[str, Array] = {}
    for name in KEYS:
        if name == "done" and "terminations" in table.columns:  # Minari stores the two kinds of ends only
            columns[name] = table.columns["terminations"] | table.columns["truncations"]
        elif names := names_in(table.columns, name):
            columns[name] = table.columns[names[0]]
        else:
            raise ExchangeError(f"it lacks the column {name}, which was exported")
    return columns


def complete_columns(table: Table, suite: Suite) -> tuple[dict[str, Array], list[str]]:
    """All columns of a dataset, from those of other people's files; and what these lack, in words."""
    layout, rows = suite.layout, table.rows
    columns: dict[str, Array] = {}
    for name in KEYS:
        width = 1 if name not in WIDE else layout.action_size if "action" in name else layout.size
        names = names_in(table.columns, name)
        if fitting := [one for one in names if table.columns[one].size == rows * width]:
            column = table.columns[fitting[0]].reshape(rows, -1)
            columns[name] = _converted(name, fitting[0], column if name in WIDE else column[:, 0])
        elif name in ("observation", "action"):
            sizes = ", ".join(f"{one} has {column.size // rows}" for one, column in table.columns.items())
            raise ExchangeError(f"it needs a column {name} of {width} numbers, as {suite.name!r} has; {sizes}")
    lacking = []
    last = np.zeros(rows, dtype=bool)
    last[np.cumsum(table.lengths) - 1] = True
    observation, action = columns["observation"], columns["action"]
    if (action != action.clip(-1, 1)).any():
        columns.setdefault("unclipped_action", action)
        action = columns["action"] = action.clip(-1, 1)
        lacking.append("actions in [-1, 1]: larger ones are clipped, as the environment does")
    for name in ("expert_action", "unclipped_action"):
        columns.setdefault(name, action)
    if "next_observation" not in columns:
        columns["next_observation"] = np.where(last[:, None], observation, np.roll(observation, -1, 0))
        lacking.append("the observation after the last action of an episode: the observation before it is used")
    reward = columns.get("reward_sparse", columns.get("reward_dense"))
    if "success" not in columns:
        is_sparse = reward is not None and np.isin(reward, (0.0, 1.0)).all()
        columns["success"] = np.asarray(reward == 1.0) if is_sparse else np.zeros(rows, dtype=bool)
        if not is_sparse:
            lacking.append("success: no row succeeds")
    if "reward_dense" not in columns or (columns["reward_dense"] == columns["success"]).all():
        columns["reward_dense"] = np.full(rows, np.nan, dtype=np.float32)
        lacking.append("a dense reward: it is NaN, so use reward='sparse' or 'cost'")
    if max(table.lengths) > suite.max_steps:
        lacking.append(f"episodes of at most {suite.max_steps} steps: the longest has {max(table.lengths)}")
    columns["reward_sparse"] = columns["success"].astype(np.float32)
    terminated = columns.get("terminated", ~last) & last
    return columns | {"done": last, "terminated": terminated, "truncated": last & ~terminated}, lacking


def _converted(name: str, source_name: str, column: Array) -> Array:
    if name in WIDE or name.startswith("reward"):
        with np.errstate(over="ignore"):
            column = column.astype(np.float32)
        if not np.isfinite(column).all():
            raise ExchangeError(f"{source_name} must hold finite numbers, found NaN or infinity")
        return column
    if (odd := column[~np.isin(column, (0, 1))]).size:
        raise ExchangeError(f"{source_name} must hold booleans, or 0 and 1, found {odd[0]}")
    return column.astype(bool)


def task_names(table: Table, suite: Suite, task: str | Mapping[str, str] | None) -> list[str]:
    """The suite's name of each episode's task: by ``task``, or by a name or description that the suite has."""
    known = {name: name for name in suite.tasks}
    known |= {name.removeprefix(f"{suite.name}/"): name for name in suite.tasks}
    known |= {one.description: name for name, one in suite.tasks.items()}
    if isinstance(task, Mapping):
        known |= {words: _one_task(suite, name) for words, name in task.items()}
    elif task is not None:
        return [_one_task(suite, task)] * len(table.tasks)
    names = {}
    for words in {*table.tasks}:
        plain = re.sub(r"-v[0-9]+(-goal-(observable|hidden))?$", "", words.strip())
        name = known.get(words, known.get(plain, known.get(plain.lower().replace("_", "-").replace(" ", "-"))))
        if name is None and not words:
            raise ValueError("task must be given, 'reach' for example: the files do not name it")
        if name is None:
            more = f"; or map it with task={{{shown(words)}: 'reach'}}, for example"
            raise ValueError(f"{unknown_name('task', words, suite.tasks)}{more}")
        names[words] = name
    return [names[words] for words in table.tasks]


def _one_task(suite: Suite, name: str) -> str:
    if len(names := suite.named_tasks(name)) != 1:
        raise ValueError(f"task must be one task, {shown(name)} is a set of {len(names)}; use 'reach', for example")
    return next(iter(names))


def describe(
    names: Sequence[str], table: Table, suite: Suite, behaviour: str, episodes_per_task: int | None
) -> tuple[Demonstrations, list[tuple[int, int]]]:
    """The description of a dataset of other people's episodes, and the rows of each episode."""
    count = Counter(names)
    if episodes_per_task is None and len({*count.values()}) > 1:
        counts = ", ".join(f"{number} of {name}" for name, number in sorted(count.items())[:5])
        raise ValueError(f"give episodes_per_task, {min(count.values())} for example: it holds {counts} episodes")
    each = min(count.values()) if episodes_per_task is None else episodes_per_task
    if short := [name for name, number in count.items() if number < each]:
        raise ValueError(f"episodes_per_task must be at most {count[short[0]]}, as {short[0]!r} has, got {each}")
    spans = [*table.spans()]
    chosen = {name: [span for span, one in zip(spans, names, strict=True) if one == name][:each] for name in count}
    infos = tuple(EpisodeInfo(name, turn, 0, 1, False, None, 0) for name in sorted(chosen) for turn in range(each))
    ordered = [span for name in sorted(chosen) for span in chosen[name]]
    config = CollectConfig(
        tasks=tuple(sorted(chosen)),
        episodes_per_task=each,
        seed=-1,
        max_steps=max(end - start for start, end in ordered),
        policy=Behaviour(behaviour, "imported"),
        layout=suite.layout,
    )
    task_ids = {name: task_id(name) for name in config.tasks}
    return Demonstrations(Path(ABOUT), config, {}, task_ids, infos, dict.fromkeys(config.tasks, each)), ordered
