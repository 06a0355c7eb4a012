"""Queries compiled to bits: what the compiled path of :class:`~lw_torchrl.QueryProgram` answers from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lw_torchrl.language.queries import Query
from lw_torchrl.language.query_tables import (
    Atom,
    atom_index,
    atom_shift,
    atom_threshold,
    clause_atoms,
    is_far,
    is_flipped,
)
from lw_torchrl.language.tasks import MT50, Task, task_id

MOST_FACTS = 63  # of a task; the last bit of 64 is never true
_NEVER = 1 << MOST_FACTS

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
        """The same for observations of another precision."""
        return self._replace(metres=self.metres.astype(dtype), constants=self.constants.astype(dtype))


class _TaskFacts:
    """The facts of one task, and the bits of its queries."""

    def __init__(self, task: Task, queries: Sequence[Query]) -> None:
        self.atoms: dict[Atom, int] = {}
        self.conjunctions: dict[int, int] = {}  # the bits of some atoms to the bit that says that all hold
        asked = [self._clauses(query, task) for query in queries]
        self.queries = [self._literals(clauses) for clauses in asked]

    @property
    def count(self) -> int:
        return len(self.atoms) + len(self.conjunctions)

    def _clauses(self, query: Query, task: Task) -> list[tuple[list[int], bool]]:
        """The bits of the atoms of each clause, and whether it is negated."""
        return [
            ([1 << self.atoms.setdefault(atom, len(self.atoms)) for atom in clause_atoms(clause, task)], clause.negated)
            for clause in query.clauses
        ]

    def _literals(self, clauses: list[tuple[list[int], bool]]) -> tuple[int, int]:
        """The bits that a query cares for, and which of them must be true."""
        true = false = 0
        for bits, negated in clauses:
            together = sum({*bits})
            if not negated:
                true |= together
            elif together.bit_count() == 1:
                false |= together
            else:
                place = len(self.atoms) + len(self.conjunctions)
                false |= self.conjunctions.setdefault(together, 1 << place)
        return (_NEVER, _NEVER) if true & false else (true | false, true)


def compile_facts(queries: Mapping[Task, Sequence[Query]]) -> QueryFacts | None:
    """The facts of the queries of tasks, in the order of their ids; None where a task has too many for 64 bits."""
    ids = [task_id(task.name) for task in queries]
    row_of = np.full(len(MT50), -1)
    for row, number in enumerate(ids):
        if number < len(MT50):
            row_of[number] = row
    tasks = [_TaskFacts(task, listed) for task, listed in queries.items()]
    if max(task.count for task in tasks) > MOST_FACTS:
        return None
    constants = [0.0]
    places: list[list[int]] = []
    conjunctions: list[tuple[int, int]] = []
    ends, metres, bits, flipped = [], [], [], []
    for task in tasks:
        begin = len(places)
        for atom in sorted(task.atoms, key=lambda atom: not atom[3].length):
            first, second = (atom_index(atom, side, constants) for side in (0, 1))
            shift = atom_shift(atom)
            axes = [0, 1, 2] if atom[3].length else ["xyz".index(atom[3].axes)] * 3
            places.append([place for axis in axes for place in (first[axis], second[axis])])
            metres.append([*(shift[axis] for axis in axes), -1.0 if is_far(atom) else 1.0, atom_threshold(atom)])
            bits.append(task.atoms[atom])
        lengths = sum(atom[3].length for atom in task.atoms)
        flipped.append(sum(1 << bit for atom, bit in task.atoms.items() if is_flipped(atom)))
        ends.append(
            [begin, begin + lengths, len(places), len(conjunctions), len(conjunctions) + len(task.conjunctions)]
        )
        conjunctions += task.conjunctions.items()
    steps = max(len(task.queries) for task in tasks)
    literals = [task.queries + [(_NEVER, _NEVER)] * (steps - len(task.queries)) for task in tasks]
    care, want = np.moveaxis(np.array(literals, np.uint64), 2, 0)
    return QueryFacts(
        ids=np.array(ids),
        row_of=row_of,
        ends=np.array(ends, np.uint64),
        places=np.array(places, np.uint64),
        metres=np.array(metres),
        bit=np.array(bits, np.uint64),
        flipped=np.array(flipped, np.uint64),
        conjunction=np.array(conjunctions, np.uint64).reshape(-1, 2),
        care=np.ascontiguousarray(care),
        want=np.ascontiguousarray(want),
        constants=np.array(constants),
    )
