"""Checks of the rows that a growing buffer stores, and their links to trajectories."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from lw_torchrl.data.rewards import STEPS
from lw_torchrl.data.storage import DONE, TRAJECTORY, column_name
from lw_torchrl.language.value_checks import finite

EXECUTED = ("next", "executed_action")
MASK = ("collector", "mask")


def collected_rows(batch: TensorDictBase, columns: Mapping[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
    """The ``columns`` of a collector's batch (n, ...), flattened to one dimension; ``action`` is the executed one.
    ValueError for other columns, dtypes or shapes, NaN, actions outside [-1, 1], and rows of n steps or of padding."""
    names = set(batch.keys(True, True))
    if STEPS in names:
        raise ValueError(f"batch holds {STEPS} of MultiStep; leave that out and give the buffer n_steps= and gamma=")
    if MASK in names and not batch.get(MASK).all():
        raise ValueError("batch holds padding of split_trajs=True; leave that out, or index by ('collector', 'mask')")
    sources = {key: EXECUTED if key == "action" and EXECUTED in names else key for key in columns}
    if absent := [column_name(key) for key, source in sources.items() if source not in names]:
        raise ValueError(f"batch lacks the columns {', '.join(absent)}, which the demonstrations have")
    rows = {}
    for key, like in columns.items():
        leaf = batch.get(sources[key])
        tail = leaf.shape[batch.ndim :]
        if leaf.dtype != like.dtype or tail != like.shape[1:]:
            expected = f"{like.dtype} of shape {tuple(like.shape[1:])} a row as in the demonstrations"
            actual = f"{leaf.dtype} of shape {tuple(tail)}"
            raise ValueError(f"batch: column {column_name(sources[key])} must be {expected}, got {actual}")
        if leaf.dtype.is_floating_point and not leaf.isfinite().all():
            raise ValueError(f"batch: column {column_name(sources[key])} holds NaN or an infinite number")
        rows[key] = leaf.detach().reshape(-1, *tail)
    if sources.get("action") == "action" and (largest := float(rows["action"].abs().max())) > 1.0:
        instead = "LanguageWorldEnv gives it as ('next', 'executed_action')"
        raise ValueError(f"batch: action must be the executed action, in [-1, 1], got {largest:.3g}; {instead}")
    return rows


Columns = Mapping[NestedKey, Tensor]


class OpenTrajectories(NamedTuple):
    """The trajectories that have not ended: the collector's id, our number, and the last row's serial, (K,) int64."""

    key: Tensor
    number: Tensor
    last: Tensor


NONE_OPEN = OpenTrajectories(*torch.empty(3, 0, dtype=torch.int64))


def shared_keys(columns: Iterable[NestedKey]) -> dict[NestedKey, NestedKey]:
    """The columns that a row has twice: for the step, and under "next" for the one after."""
    names = list(columns)
    pairs = {key: ("next", key) if isinstance(key, str) else ("next", *key) for key in names}
    return {key: later for key, later in pairs.items() if later in names}


def _continues(was: Columns, before: Tensor, now: Columns, after: Tensor) -> Tensor:
    """Whether the "next" of the rows ``before`` of ``was`` equals the rows ``after`` of ``now``."""
    pairs = [(was[later][before], now[key][after]) for key, later in shared_keys(now).items()]
    return torch.stack([(one == other).unsqueeze(-1).flatten(1).all(1) for one, other in pairs]).all(0)


def _match(start: Tensor, candidate: Tensor, starts: int, candidates: int) -> Tensor:
    """The candidate of each start, -1 for none: the newest, each used once."""
    found = torch.full((starts,), -1).scatter_reduce_(0, start, candidate, "amax")
    mine = (found >= 0).nonzero().flatten()
    owner = torch.full((candidates,), starts).scatter_reduce_(0, found[mine], mine, "amin")
    found[mine[owner[found[mine]] != mine]] = -1
    return found


def link_rows(
    batch: Columns, opened: OpenTrajectories, ring: Columns, serial: int, number: int
) -> tuple[Tensor, Tensor, OpenTrajectories]:
    """The serial number of the row before each, (n,) int64, -1 where a trajectory begins; each trajectory's number,
    (n,) int64; and the trajectories that may continue. :class:`GrowingStorage` says which row follows another; the last
    rows of ``opened`` are in ``ring``, ``serial`` and ``number`` are of the first row and the next trajectory."""
    key, done = batch[TRAJECTORY].reshape(-1), batch[DONE].reshape(-1)
    slots = opened.last % len(ring[TRAJECTORY])
    order = key.argsort(stable=True)
    one, next_one = order[:-1], order[1:]
    first = torch.ones(len(key), dtype=torch.bool)
    first[1:] = (key[one] != key[next_one]) | done[one] | ~_continues(batch, one, batch, next_one)
    starts = order[first]
    start, candidate = (key[starts][:, None] == opened.key).nonzero(as_tuple=True)
    going = _continues(ring, slots[candidate], batch, starts[start])
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
    kept, added = (part[stay] for part in opened), (key[ends], numbers[ends], serial + ends)
    return previous, numbers, OpenTrajectories(*(torch.cat(pair) for pair in zip(kept, added, strict=True)))


def check_grown_state(state: Mapping[str, Any], ring: Columns) -> tuple[int, int, Columns, OpenTrajectories]:
    """Count, next number, rows and open trajectories of a growing storage's state, if they fit the ring."""
    grow, names = len(ring[TRAJECTORY]), {column_name(key): key for key in ring}
    if state.get("grow") != grow:
        raise ValueError(f"state_dict must be of a buffer with grow={grow}, got {state.get('grow')}")
    count, number, rows = state["count"], state["number"], state["rows"]
    if set(rows) != set(names):
        raise ValueError(f"state_dict: rows must hold the columns {', '.join(names)}, got {', '.join(rows)}")
    for name, key in names.items():
        expected, actual = ring[key][: min(count, grow)], rows[name]
        if (actual.dtype, actual.shape) != (expected.dtype, expected.shape) or not finite(actual):
            raise ValueError(f"state_dict: {name} must be finite {expected.dtype} of shape {tuple(expected.shape)}")
    opened = OpenTrajectories(*(state["open"][name].clone() for name in OpenTrajectories._fields))
    return count, number, {key: rows[name] for name, key in names.items()}, opened
