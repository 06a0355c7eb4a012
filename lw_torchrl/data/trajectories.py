"""Which of a collector's rows follow one another, and numbers for their trajectories that are nobody else's."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from tensordict import NestedKey
from torch import Tensor

Columns = Mapping[NestedKey, Tensor]


@dataclass(frozen=True)
class Open:
    """Trajectories whose last row so far was not their end, one entry each, in the order of those rows.

    Attributes:
        key: the collector's id, (K,) int64.
        number: ours.
        last: the serial number of the last row.
    """

    key: Tensor
    number: Tensor
    last: Tensor

    @classmethod
    def none(cls) -> Open:
        return cls(*(torch.empty(0, dtype=torch.int64) for _ in range(3)))


def shared_keys(columns: Iterable[NestedKey]) -> dict[NestedKey, NestedKey]:
    """The columns that a row has twice: as it was, and under "next" as it became."""
    names = list(columns)
    pairs = {key: ("next", key) if isinstance(key, str) else ("next", *key) for key in names}
    return {key: later for key, later in pairs.items() if later in names}


def _goes_on(was: Columns, before: Tensor, now: Columns, after: Tensor) -> Tensor:
    """Whether what the rows ``before`` of ``was`` became is what the rows ``after`` of ``now`` are."""
    equal = [
        (was[later][before] == now[key][after]).unsqueeze(-1).flatten(1).all(1)
        for key, later in shared_keys(now).items()
    ]
    return torch.stack(equal).all(0)


def _match(start: Tensor, candidate: Tensor, starts: int, candidates: int) -> Tensor:
    """The candidate of each start, -1 for none: the newest, and each once."""
    found = torch.full((starts,), -1).scatter_reduce_(0, start, candidate, "amax")
    mine = (found >= 0).nonzero().flatten()
    owner = torch.full((candidates,), starts).scatter_reduce_(0, found[mine], mine, "amin")
    found[mine[owner[found[mine]] != mine]] = -1
    return found


def follow(
    key: Tensor, done: Tensor, batch: Columns, opened: Open, ring: Columns, slots: Tensor, *, serial: int, number: int
) -> tuple[Tensor, Tensor, Open]:
    """The row before each, and the number of its trajectory.

    A row follows another if both have the same ``key``, the other is not ``done``, and what it became is bit for bit
    what this one was. Otherwise a trajectory begins: a collector was reset, or another one counts from 0 as well.

    Args:
        key: the collector's ids, (n,) int64; rows of the same key are in the order of time.
        done: (n,) bool.
        batch: the columns of the rows.
        opened: the trajectories that may go on.
        ring: columns in which their last rows are.
        slots: where, (K,) int64.
        serial: the serial number of the first row.
        number: of the next trajectory.

    Returns:
        previous: the serial number of the row before, (n,) int64, -1 where a trajectory begins.
        numbers: (n,) int64.
        opened: the trajectories that may go on from here.
    """
    order = key.argsort(stable=True)
    one, next_one = order[:-1], order[1:]
    first = torch.ones(len(key), dtype=torch.bool)
    first[1:] = (key[one] != key[next_one]) | done[one] | ~_goes_on(batch, one, batch, next_one)
    starts = order[first]
    start, candidate = (key[starts][:, None] == opened.key).nonzero(as_tuple=True)
    going = _goes_on(ring, slots[candidate], batch, starts[start])
    match = _match(start[going], candidate[going], len(starts), len(opened.key))

    new = match < 0
    begun = torch.where(new, number - 1 + new.cumsum(0), 0)
    begun[~new] = opened.number[match[~new]]
    numbers = torch.empty_like(key)
    numbers[order] = begun[first.cumsum(0) - 1]
    previous = torch.full_like(key, -1)
    previous[next_one[~first[1:]]] = serial + one[~first[1:]]
    previous[starts[~new]] = opened.last[match[~new]]

    ends = order[torch.cat([first[1:], first.new_ones(1)])]
    ends = ends[~done[ends]].sort().values
    stay = torch.ones(len(opened.key), dtype=torch.bool)
    stay[match[~new]] = False
    kept = (opened.key[stay], opened.number[stay], opened.last[stay])
    added = (key[ends], numbers[ends], serial + ends)
    return previous, numbers, Open(*(torch.cat(pair) for pair in zip(kept, added, strict=True)))
