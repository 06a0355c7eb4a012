"""The rows that a growing buffer stores: checked, and linked to trajectories."""

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from lw_torchrl._tensor_archive import check_like
from lw_torchrl.data.rewards import STEPS
from lw_torchrl.data.storage import DONE, TRAJECTORY, column_name
from lw_torchrl.language.value_checks import finite

EXECUTED = ("next", "executed_action")
MASK = ("collector", "mask")


def collected_rows(batch: TensorDictBase, columns: Mapping[NestedKey, Tensor]) -> dict[NestedKey, Tensor]:
    """The ``columns`` of a collector's batch (n, ...), flattened to one dimension; ``action`` is what was executed.
    Other columns, dtypes or shapes, NaN, actions outside [-1, 1], and rows of n steps or of padding are refused."""
    names = set(batch.keys(True, True))
    if STEPS in names:
        why = "so MultiStep or MultiStepTransform was here: leave it out and give the buffer n_steps= and gamma="
        raise ValueError(f"batch holds {STEPS}, {why}")
    if MASK in names and not batch.get(MASK).all():
        instead = "leave it out, or give batch[batch['collector', 'mask']]"
        raise ValueError(f"batch holds rows that are no steps: split_trajs=True fills trajectories up; {instead}")
    sources = {key: EXECUTED if key == "action" and EXECUTED in names else key for key in columns}
    if absent := [column_name(key) for key, source in sources.items() if source not in names]:
        raise ValueError(f"batch lacks the columns {', '.join(absent)}, which the demonstrations have")
    found = {}
    for key, like in columns.items():
        leaf = batch.get(sources[key])
        tail = leaf.shape[batch.ndim :]
        if leaf.dtype != like.dtype or tail != like.shape[1:]:
            wanted = f"{like.dtype} of shape {tuple(like.shape[1:])} a row as in the demonstrations"
            got = f"{leaf.dtype} of shape {tuple(tail)}"
            raise ValueError(f"batch: column {column_name(sources[key])} must be {wanted}, got {got}")
        if leaf.dtype.is_floating_point and not leaf.isfinite().all():
            raise ValueError(f"batch: column {column_name(sources[key])} holds NaN or an infinite number")
        found[key] = leaf.detach().reshape(-1, *tail)
    if sources.get("action") == "action" and (most := float(found["action"].abs().max())) > 1.0:
        instead = "LanguageWorldEnv gives it as ('next', 'executed_action')"
        raise ValueError(f"batch: action must be what was done, in [-1, 1], got one of {most:.3g}; {instead}")
    return found


Columns = Mapping[NestedKey, Tensor]


class OpenTrajectories(NamedTuple):
    """Of trajectories that have not ended, the collector's id, our number, and the last row's serial, (K,) int64."""

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

    def require(holds: bool, name: str, wanted: str) -> None:
        if not holds:
            raise ValueError(f"state_dict: {name} must be {wanted}")

    grow = len(ring[TRAJECTORY])
    require(state.get("grow") == grow, "grow", f"{grow}, as this buffer's")
    for name, wanted in (("count", "a number of rows"), ("number", "a trajectory's number")):
        require(type(state.get(name)) is int and 0 <= state[name] < 2**62, name, wanted)
    count, number, names = state["count"], state["number"], {column_name(key): key for key in ring}
    there = min(count, grow)
    given = state.get("rows")
    require(isinstance(given, Mapping) and set(given) == set(names), "rows", f"the columns {', '.join(names)}")
    check_like(given, {name: ring[key][:there] for name, key in names.items()}, "state_dict: rows")
    rows = {key: state["rows"][name] for name, key in names.items()}
    for key, leaf in rows.items():
        require(finite(leaf), f"rows[{column_name(key)!r}]", "finite numbers")
    if "action" in rows:
        require(bool((rows["action"].abs() <= 1).all()), "rows['action']", "in [-1, 1]")
    require(bool((rows[TRAJECTORY] < number).all()), f"rows[{column_name(TRAJECTORY)!r}]", f"below {number}")
    given, fields = state.get("open"), OpenTrajectories._fields
    require(isinstance(given, Mapping) and set(given) == set(fields), "open", "key, number and last")
    parts = [state["open"][name] for name in fields]
    fits = (isinstance(part, Tensor) and part.dtype == torch.int64 and part.dim() == 1 for part in parts)
    require(all(fits) and len({len(part) for part in parts}) == 1, "open", "(K,) int64 each")
    opened = OpenTrajectories(*(part.clone() for part in parts))
    inside = (opened.last >= count - there) & (opened.last < count)
    require(bool(inside.all()) and len(opened.last.unique()) == len(opened.last), "open", "of rows that are there")
    numbers = rows[TRAJECTORY].reshape(-1)[opened.last - (count - there)]
    require(torch.equal(opened.number, numbers), "open", "of these rows' trajectories")
    return count, number, rows, opened
