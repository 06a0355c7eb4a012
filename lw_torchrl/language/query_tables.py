"""Queries compiled to tables of comparisons: what :class:`~lw_torchrl.QueryProgram` answers from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lw_torchrl.language.named_objects import TypedPosition, coordinate_index, typed
from lw_torchrl.language.observation import OPENING
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import PREDICATES, Comparison
from lw_torchrl.language.tasks import Task

# Of the origin and itself, the padding of the tables: far from changing its truth at any temperature.
_ALWAYS = Comparison("xyz", "<", 1e4, temperature=1e-6)
_NEVER = Comparison("xyz", "<", -1e4, temperature=1e-6)

Atom = tuple[TypedPosition, TypedPosition, tuple[float, float, float], Comparison]
_NO_SHIFT = (0.0, 0.0, 0.0)


_ORIGIN = typed((0.0, 0.0, 0.0))


class QueryTables(NamedTuple):
    """A task's atoms (A), each a comparison of the difference of two positions, and which J atoms make up
    each clause (K) of each query (S). The first dimension is of tasks (T) where compiled, of rows where selected."""

    first: Tensor  # (T, 3*A) int64, index of each coordinate of the first position; of 0 for an axis left out
    second: Tensor  # (T, 3*A) int64
    shift: Tensor  # (T, 3, A) float64, metres, added to the difference
    length: Tensor  # (T, A) bool, the difference's length is compared, otherwise its one coordinate
    far: Tensor  # (T, A) bool, it is the length's opposite that is compared, with the threshold's
    threshold: Tensor  # (T, A) float64, metres; the atom holds below it
    flipped: Tensor  # (T, A) bool, take the atom's complement
    temperature: Tensor  # (T, A) float64, metres to one logit
    atoms: Tensor  # (T, J*K*S) int64
    negated: Tensor  # (T, K, S) bool, take the clause's complement
    constants: Tensor  # (T, C) float64, read as if they followed the observation


def clause_atoms(clause: Clause, task: Task) -> list[Atom]:
    first, second = typed((0.0, 0.0, OPENING)), _ORIGIN
    shift = _NO_SHIFT
    if clause.predicate not in ("open", "closed"):
        subject = task.object(clause.subject)
        first, shift = typed(subject.position), subject.offset
        if clause.object is not None:
            other = task.object(clause.object)
            second = typed(other.position)
            x, y, z = (a - b for a, b in zip(shift, other.offset, strict=True))
            shift = (x, y, z)
    return [(first, second, shift, part) for part in PREDICATES[clause.predicate]]


def atom_index(atom: Atom, side: int, constants: list[float]) -> list[int]:
    """Where the coordinates of an atom's first or second position stand; those of 0 for an axis left out."""
    first, second, _, part = atom
    position = (first, second)[side if part.sense == "<" else 1 - side]
    used = [c if axis in part.axes else 0.0 for axis, (_, c) in zip("xyz", position, strict=True)]
    return [coordinate_index(c, constants) for c in used]


def atom_shift(atom: Atom) -> list[float]:
    """What is added to the difference of an atom's positions, metres."""
    *_, shift, part = atom
    sign = 1.0 if part.sense == "<" else -1.0
    moved = (shift[0], shift[1], shift[2] + part.raise_z)
    return [sign * metres if axis in part.axes else 0.0 for axis, metres in zip("xyz", moved, strict=True)]


def is_far(atom: Atom) -> bool:
    """Whether the opposite of the atom's length is compared."""
    return atom[3].length and atom[3].sense != "<"


def atom_threshold(atom: Atom) -> float:
    """What the atom's value is below where it holds, metres."""
    return atom[3].threshold * (1 if atom[3].sense == "<" else -1)


def is_flipped(atom: Atom) -> bool:
    """Whether the atom holds where its value is not below the threshold."""
    return atom[3].sense == "<="


def _task_atoms(task: Task, queries: Sequence[Query], steps: int, width: int) -> tuple[list[Atom], list, list]:
    """The atoms of one task, each once; those of each clause (steps, width, J); what is negated (steps, width)."""
    clauses = [[(clause_atoms(clause, task), clause.negated) for clause in query.clauses] for query in queries]
    clauses += [[([(_ORIGIN, _ORIGIN, _NO_SHIFT, _NEVER)], False)]] * (steps - len(queries))
    always = (_ORIGIN, _ORIGIN, _NO_SHIFT, _ALWAYS)
    padded = [[*listed, *[([], False)] * (width - len(listed))] for listed in clauses]
    atoms = dict.fromkeys([always, *(atom for listed in padded for found, _ in listed for atom in found)])
    place = {atom: number for number, atom in enumerate(atoms)}
    places = [[[place[atom] for atom in found] for found, _ in row] for row in padded]
    return list(atoms), places, [[negated for _, negated in row] for row in padded]


def compile_queries(queries: Mapping[Task, Sequence[Query]]) -> QueryTables:
    """The tables of the queries of tasks, which have a row for each task, in the mapping's order."""
    steps = max(map(len, queries.values()))
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    found = [_task_atoms(task, listed, steps, width) for task, listed in queries.items()]
    most = max(len(atoms) for atoms, _, _ in found)
    parts = max(2, *(len(each) for _, places, _ in found for row in places for each in row))
    filled = [[[[*each, *[0] * (parts - len(each))] for each in row] for row in places] for _, places, _ in found]
    listed = [atoms + [(_ORIGIN, _ORIGIN, _NO_SHIFT, _ALWAYS)] * (most - len(atoms)) for atoms, _, _ in found]
    constants = [0.0]

    def table(value: Callable[[Atom], Any], dtype: torch.dtype = torch.int64) -> Tensor:
        values = torch.tensor([[value(atom) for atom in atoms] for atoms in listed], dtype=dtype)
        return values.movedim(1, -1).contiguous()

    return QueryTables(
        first=table(lambda atom: atom_index(atom, 0, constants)).flatten(1),
        second=table(lambda atom: atom_index(atom, 1, constants)).flatten(1),
        shift=table(atom_shift, torch.float64),
        length=table(lambda atom: atom[3].length, torch.bool),
        far=table(is_far, torch.bool),
        threshold=table(atom_threshold, torch.float64),
        flipped=table(is_flipped, torch.bool),
        temperature=table(lambda atom: atom[3].temperature, torch.float64),
        atoms=torch.tensor(filled).permute(0, 3, 2, 1).flatten(1),
        negated=torch.tensor([negated for _, _, negated in found]).transpose(1, 2).contiguous(),
        constants=torch.tensor([constants] * len(listed), dtype=torch.float64),
    )
