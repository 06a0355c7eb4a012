"""Read HDF5 files in the layout of robomimic and LIBERO.

data                        attributes: env_args (JSON with env_name), the task (see TASK_NAMES), LIBERO's problem_info
data/demo_0                 a group for each episode; attributes: the task (see TASK_NAMES)
data/demo_0/obs/...         (T, n), or (T + 1, n) where the last row is the observation after the last action
data/demo_0/actions         (T, n); also rewards, dones, next_obs/..., success
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from lw_torchrl.data.exchange.table import KNOWN, TASK_NAMES, Array, ExchangeError, Table


def _files(source: Path) -> list[Path]:
    """Return the HDF5 files at a path, in natural order (numbers in names are compared by value)."""
    if source.is_file():
        return [source]
    paths = [path for path in source.iterdir() if path.suffix in (".hdf5", ".h5") and path.name[0] != "."]
    return sorted(paths, key=lambda path: re.sub(r"\d+", lambda digits: digits[0].zfill(20), path.name))


def _episode(group: Any) -> dict[str, Array]:
    """Read the known columns from an episode's HDF5 group."""
    columns: dict[str, Array] = {}

    def add(path: str, item: Any) -> None:
        # Load only known columns, because images may not fit into memory.
        name = path.replace("/", ".")
        if name in KNOWN and getattr(item, "dtype", np.dtype("O")).kind in "biuf" and item.ndim:
            columns[name] = item[()]

    group.visititems(add)
    if "actions" not in columns:
        raise ExchangeError(f"{group.name} has no actions")
    steps = len(columns["actions"])
    for name in [name for name, column in columns.items() if len(column) == steps + 1]:
        columns.setdefault(f"next_{name}", columns[name][1:])
        columns[name] = columns[name][:-1]
    if odd := [name for name, column in columns.items() if len(column) != steps]:
        raise ExchangeError(f"{group.name} has {steps} actions, but {len(columns[odd[0]])} rows of {odd[0]}")
    return columns


def _task(attributes: Any) -> str:
    """Return the task stated in HDF5 attributes, or "" if there is none."""
    texts = {name: attributes[name] for name in TASK_NAMES if name in attributes}
    for name, keys in {"problem_info": TASK_NAMES, "env_args": ("env_name",)}.items():
        texts |= {key: value for key, value in json.loads(attributes.get(name, "{}")).items() if key in keys}
    text = next(iter(texts.values()), "")
    return text.decode("utf-8", "replace") if isinstance(text, bytes) else str(text)


def read(source: Path) -> Table:
    """Read a file in robomimic's format, or all such files in a folder, as a table."""
    import h5py

    parts, tasks = [], []
    for path in _files(source):
        with h5py.File(path, "r") as file:
            if "data" not in file:
                raise ExchangeError(f"{path.name} has no group data/demo_0")
            groups = {name: group for name, group in file["data"].items() if re.fullmatch(r"\D+_\d+", name)}
            for name in sorted(groups, key=lambda name: int(name.rpartition("_")[2])):
                parts.append(_episode(groups[name]))
                tasks.append(_task(groups[name].attrs) or _task(file["data"].attrs))
    if not parts or any(part.keys() != parts[0].keys() for part in parts):
        raise ExchangeError("there must be at least one episode, and all episodes must have the same columns")
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return Table(columns, tuple(len(part["actions"]) for part in parts), tuple(tasks))
