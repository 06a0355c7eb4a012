"""A sampler's state, read from a folder without unpickling, and checked before it is taken."""

from __future__ import annotations

from math import prod
from pathlib import Path
from reprlib import repr as short
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from lw_torchrl._files import read_json


def read_state(folder: Path) -> dict[str, Any]:
    """The tensors in a folder, if each file is as long as its description says; a shorter one would be lengthened."""
    try:
        for name, leaf in read_json(folder / "meta.json", "path: the description", limit=2**20).items():
            if not isinstance(leaf, dict):
                continue
            if set(leaf) != {"device", "shape", "dtype", "is_nested"} or leaf["is_nested"] or "/" in name:
                raise ValueError(f"{name} is no tensor")
            dtype = {"torch.int64": torch.int64, "torch.bool": torch.bool}[leaf["dtype"]]
            if not all(type(size) is int and 0 <= size < 2**48 for size in leaf["shape"]):
                raise ValueError(f"{name} is of no shape")
            size, file = prod(leaf["shape"]) * dtype.itemsize, folder / f"{name}.memmap"
            if (there := file.stat().st_size if file.is_file() else 0) != size:
                raise ValueError(f"{name}.memmap has {there} bytes, not {size}")
        return TensorDict.load_memmap(folder, allow_pickle=False).to_dict()
    except (OSError, RuntimeError, TypeError, KeyError, ValueError) as error:
        raise ValueError(f"path: {str(folder)!r} holds no sampler's state ({type(error).__name__}: {error})") from error


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
