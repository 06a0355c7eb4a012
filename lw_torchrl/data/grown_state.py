"""The state of a storage that grows, checked before it is taken."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from lw_torchrl.data.storage import TRAJECTORY, column_name
from lw_torchrl.data.trajectories import Open
from lw_torchrl.language.value_checks import finite


def check_grown(
    state: Mapping[str, Any], grow: int, ring: Mapping[NestedKey, Tensor]
) -> tuple[int, int, dict[NestedKey, Tensor], Open]:
    """The parts of a growing storage's state, if they fit one another and the ring."""

    def require(holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ValueError(f"state_dict: {name} must be {wanted}")

    require(state.get("grow") == grow, "grow", f"{grow}, as this buffer's")
    count, number = state.get("count"), state.get("number")
    require(type(count) is int and 0 <= count < 2**62, "count", "a number of rows")
    require(type(number) is int and 0 <= number < 2**62, "number", "a trajectory's number")
    assert isinstance(count, int)
    assert isinstance(number, int)
    there = min(count, grow)
    given = state.get("rows")
    names = {column_name(key): key for key in ring}
    require(isinstance(given, Mapping) and set(given) == set(names), "rows", f"the columns {', '.join(names)}")
    rows = {}
    for name, key in names.items():
        leaf, like = given[name], ring[key]  # type: ignore[index]
        fits = isinstance(leaf, Tensor) and leaf.dtype == like.dtype and leaf.shape == (there, *like.shape[1:])
        require(fits, f"rows[{name!r}]", f"{like.dtype} of shape {(there, *like.shape[1:])}")
        if leaf.dtype.is_floating_point:
            require(finite(leaf), f"rows[{name!r}]", "finite numbers")
        rows[key] = leaf
    if "action" in rows:
        require(bool((rows["action"].abs() <= 1).all()), "rows['action']", "in [-1, 1]")
    require(bool((rows[TRAJECTORY] < number).all()), f"rows[{column_name(TRAJECTORY)!r}]", f"below {number}")
    given = state.get("open")
    require(isinstance(given, Mapping) and set(given) == {"key", "number", "last"}, "open", "key, number and last")
    parts = [given[name] for name in ("key", "number", "last")]  # type: ignore[index]
    for part in parts:
        fits = isinstance(part, Tensor) and part.dtype == torch.int64 and part.shape == parts[0].shape[:1]
        require(fits, "open", "(K,) int64 each")
    opened = Open(*(part.clone() for part in parts))
    inside = (opened.last >= count - there) & (opened.last < count)
    require(bool(inside.all()) and len(opened.last.unique()) == len(opened.last), "open", "of rows that are there")
    numbers = rows[TRAJECTORY].reshape(-1)[opened.last - (count - there)]
    require(torch.equal(opened.number, numbers), "open", "of these rows' trajectories")
    return count, number, rows, opened
