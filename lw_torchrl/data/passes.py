"""Passes over groups of rows, updated as rows come and go; their state, checked."""

from reprlib import repr as short
from typing import Any

import torch
from torch import Tensor


def spans(first: Tensor, count: Tensor) -> Tensor:
    """``count[g]`` places from ``first[g]`` on, group after group: (count.sum(),) int64."""
    group = torch.repeat_interleave(count)
    return torch.arange(len(group)) + (first - count.cumsum(0) + count)[group]


def _without(some: Tensor, others: Tensor) -> Tensor:
    return some[~torch.isin(some, others)]


def choose(first: Tensor, size: Tensor, count: Tensor, generator: torch.Generator | None) -> Tensor:
    """``count[g]`` different places of ``size[g]`` from ``first[g]`` on, sorted, uniform, in the time of ``count``."""
    few = 2 * count <= size
    wanted = torch.where(few, count, size - count)  # where those that are not chosen are fewer, draw these
    found, missing = wanted.new_empty(0), wanted
    while missing.any():
        group = torch.repeat_interleave(missing)
        drawn = torch.rand(len(group), dtype=torch.float64, generator=generator) * size[group]
        found = torch.cat([found, first[group] + drawn.long()]).unique()
        group = torch.searchsorted(first, found, right=True) - 1
        missing = wanted - group.bincount(minlength=len(size))
    if few.all():
        return found
    whole = spans(first, torch.where(few, 0, size))
    chosen = few[torch.searchsorted(first, found, right=True) - 1]
    return torch.cat([found[chosen], _without(whole, found)]).sort().values


class Passes:
    """The rows of each group in the order of its pass: those already drawn, then those left, in random order.

    A new row takes a random place among those left, a row that goes leaves no gap; neither looks at the other rows.
    ``order`` holds the rows group after group, ``size`` (G,) their number, and ``cursor`` (G,) the rows already drawn.
    """

    def __init__(self, order: Tensor, size: Tensor, cursor: Tensor | None = None) -> None:
        self.order, self.size = order, size
        self.start = size.cumsum(0) - size
        self.cursor = torch.zeros_like(size) if cursor is None else cursor
        self._room = size
        self._place: Tensor | None = None  # of each row in the order, -1 for none; made when rows change

    def shuffle(self, group: int, generator: torch.Generator | None) -> None:
        start, size = int(self.start[group]), int(self.size[group])
        rows = self.order[start : start + size]
        self.order[start : start + size] = rows[torch.randperm(size, generator=generator)]
        self.cursor[group] = 0
        if self._place is not None:
            self._place[self.order[start : start + size]] = torch.arange(start, start + size)

    def take(self, group: int, count: int, generator: torch.Generator | None) -> tuple[Tensor, bool]:
        """``count`` rows of a group, across the end of its pass, and whether a pass ended."""
        taken, ended = [], False
        start, size = int(self.start[group]), int(self.size[group])
        while count:
            cursor = int(self.cursor[group])
            found = self.order[start + cursor : start + min(size, cursor + count)].clone()
            taken.append(found)
            self.cursor[group] += len(found)
            count -= len(found)
            if self.cursor[group] == size:
                ended = True
                self.shuffle(group, generator)
        return torch.cat(taken), ended

    def compact(self) -> Tensor:
        """The rows group after group, without the free places between them."""
        return self.order[spans(self.start, self.size)]

    def exchange(self, rows: Tensor, label: Tensor, generator: torch.Generator | None) -> None:
        """Move rows (n,) int64, each once, from where they are, if anywhere, to their groups (n,) int64."""
        place = self._places(int(rows.max()) + 1)
        at = place[rows]
        place[rows] = -1
        self._close(at[at >= 0].sort().values)
        self._insert(rows, label, generator)
        for group in ((self.cursor == self.size) & (self.size > 0)).nonzero().flatten().tolist():
            self.shuffle(group, generator)

    def _places(self, rows: int) -> Tensor:
        if self._place is None or len(self._place) < rows:
            self._place = torch.full((2 * max(rows, len(self.order)),), -1)
            filled = spans(self.start, self.size)
            self._place[self.order[filled]] = filled
        return self._place

    def _put(self, places: Tensor, rows: Tensor) -> None:
        assert self._place is not None
        self.order[places] = rows
        self._place[rows] = places

    def _close(self, holes: Tensor) -> None:
        """Fill gaps among the rows already drawn with others of these, then the rest with rows left."""
        group = torch.searchsorted(self.start, holes, right=True) - 1
        drawn = holes < (self.start + self.cursor)[group]
        gone = group[drawn].bincount(minlength=len(self.size))
        self.cursor = self.cursor - gone
        free = spans(self.start + self.cursor, gone)
        self._put(_without(holes[drawn], free), self.order[_without(free, holes)])
        gone = group.bincount(minlength=len(self.size))
        self.size = self.size - gone
        tail = spans(self.start + self.size, gone)
        holes = torch.cat([free, holes[~drawn]]).sort().values
        self._put(_without(holes, tail), self.order[_without(tail, holes)])

    def _insert(self, rows: Tensor, label: Tensor, generator: torch.Generator | None) -> None:
        mixed = torch.randperm(len(rows), generator=generator)
        mixed = mixed[label[mixed].argsort(stable=True)]
        count = label.bincount(minlength=len(self.size))
        if (self.size + count > self._room).any():
            left, self._room = self.compact(), 2 * (self.size + count)
            self.start = self._room.cumsum(0) - self._room
            self.order = torch.zeros(int(self._room.sum()), dtype=torch.int64)
            self._put(spans(self.start, self.size), left)
        end = spans(self.start + self.size, count)
        self._put(end, rows[mixed])
        self.size = self.size + count
        chosen = choose(self.start + self.cursor, self.size - self.cursor, count, generator)
        to, back = _without(chosen, end), _without(end, chosen)
        come, go = self.order[back], self.order[to]
        self._put(to, come)
        self._put(back, go)


def check_state(state: Any) -> dict[str, Any]:
    """A sampler's state, if its parts fit one another: the groups' rows one after another, each row once."""

    def require(holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ValueError(f"state_dict: {name} must be {wanted}, got {short(state.get(name))}")

    found: dict[str, Any] = {}
    for name, dtype in (("length", torch.int64), ("ran_out", torch.bool)):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == dtype and given.numel() == 1, name, f"one {dtype}")
        found[name] = given.item()
    require(found["length"] >= 0, "length", "at least 0")
    for name in (names := ("order", "start", "size", "cursor", "known", "written")):
        given = state.get(name)
        require(isinstance(given, Tensor) and given.dtype == torch.int64 and given.dim() == 1, name, "(n,) int64")
        found[name] = given.cpu()
    order, start, size, cursor, *_ = (found[name] for name in names)
    rows = len(order)
    sized = bool(((size > 0) & (size <= rows)).all()) and int(size.sum()) == rows
    require(sized, "size", f"of {rows} rows, none empty")
    require(torch.equal(start, size.cumsum(0) - size), "start", "where the groups begin")
    fits = cursor.shape == size.shape and bool(((cursor >= 0) & (cursor < size)).all())
    require(fits, "cursor", "a place within each group")
    inside = rows <= found["length"] and bool(((order >= 0) & (order < found["length"])).all())
    require(inside and len(order.unique()) == rows, "order", f"rows below {found['length']}, each once")
    require(len(found["known"]) in (0, len(size)), "known", "one a group, or none")
    return found
