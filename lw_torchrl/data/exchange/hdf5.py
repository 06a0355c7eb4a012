"""HDF5 as robomimic reads it, a group for each episode; D4RL's flat files are read too.

data                        attributes: total, env_args, and the metadata of a dataset of ours
data/demo_0                 attributes: num_samples, task, task_description, plan
data/demo_0/obs/state       (T, 39) float32; next_obs/state the same, a step later
data/demo_0/actions         (T, 4) float32; rewards, the dense ones, and dones, (T,)
data/demo_0/...             the other columns, under their names here
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl._files import parse_json
from lw_torchrl._progress import Progress
from lw_torchrl.data.exchange.table import (
    ABOUT,
    EPISODES,
    NAMES,
    Array,
    ExchangeError,
    Table,
    check_rows,
    lengths_of,
    of_names,
)

FILE = "data.hdf5"
_PATHS = {
    "observation": "obs/state",
    "next_observation": "next_obs/state",
    "action": "actions",
    "reward_dense": "rewards",
    "done": "dones",
}
_KNOWN = {name for names in (*NAMES.values(), EPISODES["episode"], EPISODES["frame"]) for name in names}
_TYPES = {"done": np.int64}  # as robomimic's own


def write(table: Table, folder: Path, bar: Progress) -> None:
    """Write a table as one file."""
    import h5py

    with h5py.File(folder / FILE, "w", libver="latest") as file:
        data = file.create_group("data", track_order=True)
        data.attrs["total"] = table.rows
        data.attrs["env_args"] = json.dumps({"env_name": "lw_torchrl", "type": 2, "env_kwargs": {}})
        metadata = np.frombuffer(json.dumps(table.about).encode(), dtype=np.uint8)
        file.create_dataset(ABOUT, data=metadata)  # attributes are at most 64 kB
        for number, (task, (start, end)) in enumerate(zip(table.tasks, table.spans(), strict=True)):
            group = data.create_group(f"demo_{number}")
            told = {"task": task, "task_description": table.words[task], "plan": table.plans.get(task, "")}
            group.attrs.update({"num_samples": end - start, **told})
            for name, column in table.columns.items():
                part = np.ascontiguousarray(column[start:end]).astype(_TYPES.get(name, column.dtype), copy=False)
                group.create_dataset(_PATHS.get(name, name), data=part)
            bar.update(end - start)


def read(source: Path) -> Table:
    """Read robomimic's layout or D4RL's; ExchangeError if the file is damaged, or another."""
    import h5py

    where = f"source: {str(source)!r}"
    paths = [source] if source.is_file() else sorted([*source.glob("*.hdf5"), *source.glob("*.h5")])
    if len(paths) != 1 or not paths[0].is_file():
        raise ExchangeError(f"{where} must hold one file of HDF5, it holds {len(paths)}")
    try:
        with h5py.File(paths[0], "r") as file:
            check_whole(source, file)
            return _episodes(source, file) if "data" in file and _demos(file) else _flat(source, file)
    except ExchangeError:
        raise
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, SystemError, MemoryError) as error:
        raise ExchangeError(f"{where} is no HDF5 of episodes, or damaged ({type(error).__name__}: {error})") from error


def _demos(file: Any) -> list[str]:
    named = [name for name in file["data"] if name.startswith("demo_") and name[5:].isdecimal()]
    return sorted(named, key=lambda name: int(name[5:]))


def check_whole(source: Path, file: Any) -> None:
    """Raise where an open file shows what is in other files: by a link, a virtual dataset, or storage outside."""
    import h5py

    odd: list[str] = []  # nothing may be raised inside a visit

    def link(name: str, found: Any) -> None:
        if isinstance(found, h5py.ExternalLink):
            odd.append(f"{name} is a link to")

    def item(name: str, found: Any) -> None:
        if isinstance(found, h5py.Dataset) and (found.external or found.is_virtual):
            odd.append(f"{name} shows")

    file.visititems_links(link)
    file.visititems(item)
    if odd:
        raise ExchangeError(f"source: {str(source)!r} must hold all of its rows itself, {odd[0]} another file")


def columns_in(group: Any) -> dict[str, Array]:
    """The arrays of numbers in a group and the groups inside it whose names, joined by dots, are columns of ours."""
    found: dict[str, Array] = {}

    def note(name: str, item: Any) -> None:
        known = (named := name.replace("/", ".")) in _KNOWN
        if known and hasattr(item, "dtype") and item.dtype.kind in "biuf" and item.ndim:
            found[named] = item[()]

    group.visititems(note)
    return found


def _episodes(source: Path, file: Any) -> Table:
    parts, tasks, lengths = [], [], []
    for name in _demos(file):
        group = file["data"][name]
        found = columns_in(group)
        lengths.append(len(next(iter(found.values()), ())))
        check_rows(source, found, int(group.attrs.get("num_samples", lengths[-1])))
        parts.append(found)
        tasks.append(next((_text(group.attrs[one]) for one in EPISODES["task"] if one in group.attrs), ""))
    for name, part in zip(_demos(file), parts, strict=True):
        if part.keys() != parts[0].keys():
            odd = ", ".join(sorted(part.keys() ^ parts[0].keys()))
            raise ExchangeError(f"source: {str(source)!r}: {name} must have what demo_0 has, they differ in {odd}")
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Table(columns, tuple(lengths), tuple(tasks), about=_about(source, file))


def _text(value: Any) -> str:
    return value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)


def _about(source: Path, file: Any) -> dict[str, Any] | None:
    if ABOUT not in file:
        return None
    try:
        return parse_json(file[ABOUT][()].tobytes())
    except ValueError as error:
        raise ExchangeError(f"source: {str(source)!r} is damaged: its {ABOUT} cannot be read ({error})") from error


def _flat(source: Path, file: Any) -> Table:
    columns = columns_in(file)
    action = of_names(columns, NAMES, "action")
    rows = len(columns[action[0]]) if action else 0
    check_rows(source, columns, rows)
    lengths = lengths_of(source, columns)
    return Table(columns, lengths, ("",) * len(lengths))
