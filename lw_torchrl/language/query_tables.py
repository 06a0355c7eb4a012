"""What :class:`~lw_torchrl.QueryProgram` answers from: queries compiled to tensors, and to bits for its kernel."""

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
    """A comparison of two positions. Where its sense is not "<", the opposite of its value is compared."""

    first: TypedPosition
    second: TypedPosition
    shift: tuple[float, float, float]  # metres, added to first - second
    part: Comparison

    def coordinates(self, side: int, constants: list[float], size: int) -> list[int]:
        """Where the coordinates of one position stand; those of 0 for an axis left out."""
        position = (self.first, self.second)[side if self.part.sense == "<" else 1 - side]
        used = [c if axis in self.part.axes else 0.0 for axis, (_, c) in zip("xyz", position, strict=True)]
        return coordinate_indices(used, constants, size)

    @property
    def offset(self) -> list[float]:
        """What is added to the difference of the positions, metres."""
        x, y, z = self.shift
        used, sign = zip("xyz", (x, y, z + self.part.raise_z), strict=True), 1 if self.part.sense == "<" else -1
        return [sign * metres if axis in self.part.axes else 0.0 for axis, metres in used]

    @property
    def threshold(self) -> float:
        """Metres; the value is below it where the atom holds."""
        return self.part.threshold if self.part.sense == "<" else -self.part.threshold

    @property
    def far(self) -> bool:
        return self.part.length and self.part.sense != "<"  # the opposite of a length is compared

    @property
    def flipped(self) -> bool:
        return self.part.sense == "<="  # the atom holds where its value is not below the threshold


_ORIGIN = typed_position((0.0, 0.0, 0.0))
_NO_SHIFT = (0.0, 0.0, 0.0)
# Of the origin and itself, the padding of the tables: far from changing its truth at any temperature.
_ALWAYS = Atom(_ORIGIN, _ORIGIN, _NO_SHIFT, Comparison("xyz", "<", 1e4, temperature=1e-6))
_NEVER = Atom(_ORIGIN, _ORIGIN, _NO_SHIFT, Comparison("xyz", "<", -1e4, temperature=1e-6))


def clause_atoms(clause: Clause, task: Task) -> list[Atom]:
    """The atoms that must all hold for a clause without its "not"."""
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
    """A task's atoms (A), and which J of them make up each clause (K) of each query (S); of tasks (T), or of rows."""

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


def compile_queries(queries: Mapping[Task, Sequence[Query]]) -> QueryTables:
    """The tables of the queries of tasks, which have a row for each task, in the mapping's order."""
    steps = max(map(len, queries.values()))
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    found = [_task_atoms(task, listed, steps, width) for task, listed in queries.items()]
    most = max(len(atoms) for atoms, _, _ in found)
    parts = max(2, *(len(each) for _, places, _ in found for row in places for each in row))
    filled = [[[[*each, *[0] * (parts - len(each))] for each in row] for row in places] for _, places, _ in found]
    listed = [atoms + [_ALWAYS] * (most - len(atoms)) for atoms, _, _ in found]
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
        atoms=torch.tensor(filled).permute(0, 3, 2, 1).flatten(1),
        negated=torch.tensor([negated for _, _, negated in found]).transpose(1, 2).contiguous(),
        constants=torch.tensor([constants] * len(listed), dtype=torch.float64),
    )


def _task_atoms(task: Task, queries: Sequence[Query], steps: int, width: int) -> tuple[list[Atom], list, list]:
    """The atoms of one task, each once; those of each clause (steps, width, J); what is negated (steps, width)."""
    clauses = [[(clause_atoms(clause, task), clause.negated) for clause in query.clauses] for query in queries]
    clauses += [[([_NEVER], False)]] * (steps - len(queries))
    padded = [[*listed, *[([], False)] * (width - len(listed))] for listed in clauses]
    atoms = dict.fromkeys([_ALWAYS, *(atom for listed in padded for found, _ in listed for atom in found)])
    place = {atom: number for number, atom in enumerate(atoms)}
    places = [[[place[atom] for atom in found] for found, _ in row] for row in padded]
    return list(atoms), places, [[negated for _, negated in row] for row in padded]


MOST_FACTS = 63  # of a task; the last bit of 64 is never true
_FALSE = 1 << MOST_FACTS
Bits = NDArray[np.uint64]


class QueryFacts(NamedTuple):
    """The facts (F) of all tasks, one after another: a task's comparisons of lengths, then those of one coordinate;
    then its conjunctions (D). A query holds where the bits of its task's facts that it cares for are those it wants."""

    ids: NDArray[np.int64]  # (T,), of the tasks, ascending
    row_of: NDArray[np.int64]  # (50,), the row of each of the 50 tasks, -1 for one without
    ends: Bits  # (T, 5): a task's lengths begin and end, its coordinates end, its conjunctions begin and end
    places: Bits  # (F, 6), of x, y and z of both positions in turn; of a coordinate's, the first two alone
    metres: NDArray[np.floating[Any]]  # (F, 5): the shift along x, y and z, the length's sign, the threshold
    bit: Bits  # (F,)
    flipped: Bits  # (T,)
    conjunction: Bits  # (D, 2): the bits that must be true, and the bit that this makes true
    care: Bits  # (T, S)
    want: Bits  # (T, S)
    constants: NDArray[np.floating[Any]]  # (C,), read as if they followed the observation

    def of(self, dtype: Any) -> QueryFacts:
        return self._replace(metres=self.metres.astype(dtype), constants=self.constants.astype(dtype))


def _task_facts(task: Task, queries: Sequence[Query]) -> tuple[dict[Atom, int], dict[int, int], list[tuple[int, int]]]:
    """A task's atoms' places; the bit that all atoms of some bits hold; each query's care bits, and which are true."""
    places: dict[Atom, int] = {}

    def bits(clause: Clause) -> int:
        return sum({1 << places.setdefault(atom, len(places)) for atom in clause_atoms(clause, task)})

    asked = [[(bits(clause), clause.negated) for clause in query.clauses] for query in queries]
    conjunctions: dict[int, int] = {}
    literals = []
    for clauses in asked:
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
    """The facts of the queries of tasks, in the order of their ids; None where a task has too many for 64 bits."""
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
    whole = {"ends": ends, "places": places, "bit": bits, "flipped": flipped, "care": care, "want": want}
    facts = {name: np.array(table, np.uint64, order="C") for name, table in whole.items()}
    facts["conjunction"] = np.array(conjunctions, np.uint64).reshape(-1, 2)
    return QueryFacts(ids=np.array(ids), row_of=row_of, metres=np.array(metres), constants=np.array(constants), **facts)
