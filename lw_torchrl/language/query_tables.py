"""Tables for :class:`~lw_torchrl.QueryProgram`: queries compiled to tensors, and to bits for the Numba kernel."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lw_torchrl.language.objects import TypedPosition, coordinate_indices, typed_position
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import STATES, Comparison, comparisons
from lw_torchrl.language.tasks import MT50, Task, one_layout, task_id


class Atom(NamedTuple):
    """A comparison of two positions in the form "value < threshold".

    For the operators ">" and "<=", the positions are swapped, which negates the value; the threshold is also
    negated.
    """

    first: TypedPosition
    second: TypedPosition
    shift: tuple[float, float, float]  # metres, added to first - second
    part: Comparison

    def coordinates(self, side: int, constants: list[float], size: int) -> list[int]:
        """Return the index of each coordinate of position ``side`` (0 or 1); an unused axis has the index of 0.0."""
        position = (self.first, self.second)[side if self.part.sense == "<" else 1 - side]
        used = [c if axis in self.part.axes else 0.0 for axis, (_, c) in zip("xyz", position, strict=True)]
        return coordinate_indices(used, constants, size)

    @property
    def offset(self) -> list[float]:
        """The shift (metres along x, y and z) that is added to the difference of the positions."""
        x, y, z = self.shift
        axes, sign = zip("xyz", (x, y, z + self.part.raise_z), strict=True), 1 if self.part.sense == "<" else -1
        return [sign * metres if axis in self.part.axes else 0.0 for axis, metres in axes]

    @property
    def threshold(self) -> float:
        """The threshold in metres; the atom is true if its value is below (not below, if :attr:`flipped`)."""
        return self.part.threshold if self.part.sense == "<" else -self.part.threshold

    @property
    def far(self) -> bool:
        """Whether the value is a length that must be negated, since swapping the positions does not negate a length."""
        return self.part.length and self.part.sense != "<"

    @property
    def flipped(self) -> bool:
        """Whether the atom is true where its value is not below the threshold."""
        return self.part.sense == "<="


_ORIGIN = typed_position((0.0, 0.0, 0.0))
_NO_SHIFT = (0.0, 0.0, 0.0)
# Padding atoms compare the origin with itself; their truth never changes, and their margins are extreme.
_ALWAYS = Atom(_ORIGIN, _ORIGIN, _NO_SHIFT, Comparison("xyz", "<", 1e4, temperature=1e-6))
_NEVER = Atom(_ORIGIN, _ORIGIN, _NO_SHIFT, Comparison("xyz", "<", -1e4, temperature=1e-6))


def clause_atoms(clause: Clause, task: Task) -> list[Atom]:
    """Return the atoms that must all be true for a clause to be true, ignoring its negation."""
    second, shift = _ORIGIN, _NO_SHIFT
    if clause.predicate in STATES:
        first = typed_position((0.0, 0.0, task.openings[clause.subject]))
    else:
        subject = task.object(clause.subject)
        first, shift = typed_position(subject.position), subject.offset
        if clause.object is not None:
            other = task.object(clause.object)
            second = typed_position(other.position)
            x, y, z = (a - b for a, b in zip(shift, other.offset, strict=True))
            shift = (x, y, z)
    return [Atom(first, second, shift, part) for part in comparisons(clause.predicate, task.layout)]


class QueryTables(NamedTuple):
    """Tensors that encode queries: the A atoms of each task and, for each of its S queries, K clauses of J atoms each.

    The first dimension is the tasks (T), or the rows of the batch (B) in tables that were selected for a batch.
    """

    first: Tensor  # (T, 3*A) int64, index of each coordinate of the first position; an unused axis has the index of 0.0
    second: Tensor  # (T, 3*A) int64, the same for the second position
    shift: Tensor  # (T, 3, A) float64, metres added to the difference
    length: Tensor  # (T, A) bool, compare the length of the difference; otherwise one coordinate
    far: Tensor  # (T, A) bool, negate the length
    threshold: Tensor  # (T, A) float64, metres; an atom is true where its value is below
    flipped: Tensor  # (T, A) bool, negate the atom
    temperature: Tensor  # (T, A) float64, metres per logit
    atoms: Tensor  # (T, J*K*S) int64, indices into the atoms
    negated: Tensor  # (T, K, S) bool, negate the clause
    constants: Tensor  # (T, C) float64, indexed as if they followed the observation


def compile_queries(queries: Mapping[Task, Sequence[Query]]) -> QueryTables:
    """Compile the queries of tasks to tables with one row per task, in the order of the mapping."""
    steps = max(map(len, queries.values()))
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    compiled = [_task_atoms(task, listed, steps, width) for task, listed in queries.items()]
    most = max(len(atoms) for atoms, _, _ in compiled)
    parts = max(2, *(len(each) for _, places, _ in compiled for row in places for each in row))
    padded = [[[[*each, *[0] * (parts - len(each))] for each in row] for row in places] for _, places, _ in compiled]
    listed = [atoms + [_ALWAYS] * (most - len(atoms)) for atoms, _, _ in compiled]
    constants, size = [0.0], one_layout(queries).size

    def table(value: Callable[[Atom], Any], dtype: torch.dtype = torch.int64) -> Tensor:
        values = torch.tensor([[value(atom) for atom in atoms] for atoms in listed], dtype=dtype)
        return values.movedim(1, -1).contiguous()

    return QueryTables(
        first=table(lambda atom: atom.coordinates(0, constants, size)).flatten(1),
        second=table(lambda atom: atom.coordinates(1, constants, size)).flatten(1),
        shift=table(lambda atom: atom.offset, torch.float64),
        length=table(lambda atom: atom.part.length, torch.bool),
        far=table(lambda atom: atom.far, torch.bool),
        threshold=table(lambda atom: atom.threshold, torch.float64),
        flipped=table(lambda atom: atom.flipped, torch.bool),
        temperature=table(lambda atom: atom.part.temperature, torch.float64),
        atoms=torch.tensor(padded).permute(0, 3, 2, 1).flatten(1),
        negated=torch.tensor([negated for _, _, negated in compiled]).transpose(1, 2).contiguous(),
        constants=torch.tensor([constants] * len(listed), dtype=torch.float64),
    )


def _task_atoms(task: Task, queries: Sequence[Query], steps: int, width: int) -> tuple[list[Atom], list, list]:
    """Return a task's distinct atoms, the atom indices of each clause (steps, width, J), and whether each clause is
    negated.
    """
    clauses = [[(clause_atoms(clause, task), clause.negated) for clause in query.clauses] for query in queries]
    clauses += [[([_NEVER], False)]] * (steps - len(queries))
    padded = [[*listed, *[([], False)] * (width - len(listed))] for listed in clauses]
    atoms = dict.fromkeys([_ALWAYS, *(atom for listed in padded for group, _ in listed for atom in group)])
    place = {atom: number for number, atom in enumerate(atoms)}
    places = [[[place[atom] for atom in group] for group, _ in row] for row in padded]
    return list(atoms), places, [[negated for _, negated in row] for row in padded]


MOST_FACTS = 63  # maximum number of facts of a task; the last of the 64 bits is never set
_FALSE = 1 << MOST_FACTS
Bits = NDArray[np.uint64]


class QueryFacts(NamedTuple):
    """The facts (F) of all tasks as bits, one task after another.

    A task's facts are its length comparisons, single-coordinate comparisons and conjunctions (D). A query
    is true if ``facts & care == want``, where ``care`` masks the bits that the query depends on.
    """

    ids: NDArray[np.int64]  # (T,), task ids, ascending
    row_of: NDArray[np.int64]  # (50,), the row of each Meta-World task; -1 for a task without queries
    ends: Bits  # (T, 5): first length, first coordinate, end of coordinates, first conjunction, end of conjunctions
    places: Bits  # (F, 6), indices of x, x, y, y, z, z of the two positions; a coordinate uses only the first two
    metres: NDArray[np.floating[Any]]  # (F, 5): the shift along x, y and z, the length's sign, the threshold
    bit: Bits  # (F,), the bit number of each fact
    flipped: Bits  # (T,), the bits to negate
    conjunction: Bits  # (D, 2): the bits that must all be set, and the bit that is then set
    care: Bits  # (T, S), the bits that each query depends on
    want: Bits  # (T, S), the required values of these bits
    constants: NDArray[np.floating[Any]]  # (C,), indexed as if they followed the observation

    def of(self, dtype: Any) -> QueryFacts:
        """Return the facts with all metres and constants cast to ``dtype``."""
        return self._replace(metres=self.metres.astype(dtype), constants=self.constants.astype(dtype))


def _task_facts(task: Task, queries: Sequence[Query]) -> tuple[dict[Atom, int], dict[int, int], list[tuple[int, int]]]:
    """Return each atom's bit number, each conjunction's bit, and each query's (care, want) bit masks."""
    places: dict[Atom, int] = {}

    def bits(clause: Clause) -> int:
        return sum({1 << places.setdefault(atom, len(places)) for atom in clause_atoms(clause, task)})

    # Number all atoms first, since the bits of conjunctions follow the bits of atoms.
    listed = [[(bits(clause), clause.negated) for clause in query.clauses] for query in queries]
    conjunctions: dict[int, int] = {}
    literals = []
    for clauses in listed:
        true = false = 0
        for together, negated in clauses:
            if not negated:
                true |= together
            elif together.bit_count() == 1:
                false |= together
            else:
                false |= conjunctions.setdefault(together, 1 << len(places) + len(conjunctions))
        literals.append((_FALSE, _FALSE) if true & false else (true | false, true))
    return places, conjunctions, literals


def compile_facts(queries: Mapping[Task, Sequence[Query]]) -> QueryFacts | None:
    """Compile queries of tasks in the order of their ids to facts; return None if a task has more than 63 facts."""
    ids = [task_id(task.name) for task in queries]
    row_of = np.full(len(MT50), -1)
    for row, number in enumerate(ids):
        if number < len(MT50):
            row_of[number] = row
    tasks = [_task_facts(task, listed) for task, listed in queries.items()]
    if max(len(atoms) + len(together) for atoms, together, _ in tasks) > MOST_FACTS:
        return None
    constants, size = [0.0], one_layout(queries).size
    places: list[list[int]] = []
    conjunctions: list[tuple[int, int]] = []
    ends, metres, bits, flipped = [], [], [], []
    for atoms, together, _ in tasks:
        begin = len(places)
        for atom in sorted(atoms, key=lambda atom: not atom.part.length):
            first, second = (atom.coordinates(side, constants, size) for side in (0, 1))
            axes = [0, 1, 2] if atom.part.length else ["xyz".index(atom.part.axes)] * 3
            places.append([place for axis in axes for place in (first[axis], second[axis])])
            metres.append([*(atom.offset[axis] for axis in axes), -1.0 if atom.far else 1.0, atom.threshold])
            bits.append(atoms[atom])
        lengths = sum(atom.part.length for atom in atoms)
        flipped.append(sum(1 << bit for atom, bit in atoms.items() if atom.flipped))
        ends.append([begin, begin + lengths, len(places), len(conjunctions), len(conjunctions) + len(together)])
        conjunctions += together.items()
    steps = max(len(literals) for *_, literals in tasks)
    padded = [literals + [(_FALSE, _FALSE)] * (steps - len(literals)) for *_, literals in tasks]
    care, want = np.moveaxis(np.array(padded, np.uint64), 2, 0)
    tables = {"ends": ends, "places": places, "bit": bits, "flipped": flipped, "care": care, "want": want}
    facts = {name: np.array(table, np.uint64, order="C") for name, table in tables.items()}
    facts["conjunction"] = np.array(conjunctions, np.uint64).reshape(-1, 2)
    return QueryFacts(ids=np.array(ids), row_of=row_of, metres=np.array(metres), constants=np.array(constants), **facts)
