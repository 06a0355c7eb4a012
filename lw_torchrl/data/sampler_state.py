"""A sampler's state, checked before it is taken."""

from __future__ import annotations

from reprlib import repr as short
from typing import Any

import torch
from torch import Tensor


def check_state(state: Any) -> dict[str, Any]:
    """A sampler's state whose parts fit one another: the groups' rows one after another, each row once."""

    def require(holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ValueError(f"state_dict: {name} must be {wanted}, got {short(state.get(name))}")

    found: dict[str, Any] = {}
    for name, dtype in (("length", torch.int64), ("ran_out", torch.bool)):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == dtype and given.numel() == 1, name, f"one {dtype}")
        found[name] = given.item()
    require(found["length"] >= 0, "length", "at least 0")
    for name in ("order", "start", "size", "cursor"):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == torch.int64 and given.dim() == 1, name, "(n,) int64")
        found[name] = given.cpu()
    order, start, size, cursor = (found[name] for name in ("order", "start", "size", "cursor"))
    rows = len(order)
    require(
        bool(((size > 0) & (size <= rows)).all()) and int(size.sum()) == rows, "size", f"of {rows} rows, none empty"
    )
    require(torch.equal(start, size.cumsum(0) - size), "start", "where the groups begin")
    fits = cursor.shape == size.shape and bool(((cursor >= 0) & (cursor < size)).all())
    require(fits, "cursor", "a place within each group")
    inside = rows <= found["length"] and bool(((order >= 0) & (order < found["length"])).all())
    require(inside and len(order.unique()) == rows, "order", f"rows below {found['length']}, each once")
    for name, lengths in (("known", {0, len(size)}), ("written", None)):
        given = state.get(name)
        fits = isinstance(given, Tensor) and given.dtype == torch.int64 and given.dim() == 1
        require(fits and (lengths is None or len(given) in lengths), name, "(n,) int64, one a group or none")
        found[name] = given.cpu()
    return found
