"""Tables for :class:`~lw_torchrl.QueryProgram`: queries compiled to tensors, and to bitmasks for the Numba kernel."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lw_torchrl.language.expressions import FALSE, Expression, Once, any_of, leaves, map_leaves, negate
from lw_torchrl.language.gates import Operand, Shapes, compile_gates, inner_gates
from lw_torchrl.language.objects import TypedPosition, coordinate_indices, typed_position
from lw_torchrl.language.queries import Clause, Query
from lw_torchrl.language.relations import STATES, Comparison, comparisons
from lw_torchrl.language.tasks import MT50, Task, one_layout, task_id


class Atom(NamedTuple):
    """A comparison of two positions in the form "value < threshold".

    For the operators ">" and "<=", the value and the threshold are negated. Swapping the positions negates the value.
    """

    first: TypedPosition
    second: TypedPosition
    shift: tuple[float, float, float]  # metres, added to first - second
    part: Comparison

    def coordinates(self, side: int, constants: list[float], size: int) -> list[int]:
        """Return each coordinate's index for position ``side`` (0 or 1), or the index of 0.0 for unused axes."""
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
        """The threshold (m): the atom is true for smaller values or, if :attr:`flipped`, for equal or larger ones."""
        return self.part.threshold if self.part.sense == "<" else -self.part.threshold

    @property
    def far(self) -> bool:
        """Whether to negate the value explicitly: swapping the positions negates a coordinate, but not a length."""
        return self.part.length and self.part.sense != "<"

    @property
    def flipped(self) -> bool:
        """True if the atom holds when its value is at or above the threshold, instead of below it."""
        return self.part.sense == "<="


_ORIGIN = typed_position((0.0, 0.0, 0.0))
_NO_SHIFT = (0.0, 0.0, 0.0)
# The padding atom compares the origin with itself; it is always true, and its margin is extreme.
_ALWAYS = Atom(_ORIGIN, _ORIGIN, _NO_SHIFT, Comparison("xyz", "<", 1e4, temperature=1e-6))


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


@dataclass(frozen=True)
class Before:
    """A leaf: the value of latch ``number`` before the current time step."""

    number: int


def unroll(queries: Iterable[Query]) -> tuple[list[Expression], list[Expression]]:
    """Return queries without latches, and the expression of each latch, inner latches first.

    Latch n becomes the disjunction of ``Before(n)`` and the latch's condition.
    """
    latches: dict[Once, Expression] = {}

    def unrolled(leaf: Any) -> Any:
        if isinstance(leaf, Once) and leaf not in latches:
            now = map_leaves(leaf.condition, unrolled)
            latches[leaf] = any_of([Before(len(latches)), now])
        return latches.get(leaf, leaf)

    return [map_leaves(query.expression, unrolled) for query in queries], list(latches.values())


def _columns(queries: Mapping[Task, Sequence[Query]]) -> tuple[list[list[Expression]], int]:
    """Return the expressions of each task, and the largest number L of latches.

    With latches, each list begins with S query expressions, padded with expressions that are never true, and ends with
    the task's latch expressions. Tables of plans without latches are not padded.
    """
    unrolled = [unroll(listed) for listed in queries.values()]
    latches = max(len(own) for _, own in unrolled)
    steps = max(map(len, queries.values())) if latches else 0
    return [own + [FALSE] * (steps - len(own)) + latched for own, latched in unrolled], latches


class QueryTables(NamedTuple):
    """Tensors that encode queries: the A atoms of each task, and gates.

    The gates compute S queries and L latches from the atoms and the latches' L previous values.

    The first dimension indexes the tasks (T) or, in tables selected for a batch, the rows of the batch (B).
    """

    first: Tensor  # (T, 3*A) int64, index of each coordinate of the first position; the index of 0.0 for unused axes
    second: Tensor  # (T, 3*A) int64, the same for the second position
    shift: Tensor  # (T, 3, A) float64, metres added to the difference
    length: Tensor  # (T, A) bool, compare the length of the difference instead of one coordinate
    far: Tensor  # (T, A) bool, negate the length
    threshold: Tensor  # (T, A) float64, metres; an atom is true where its value is below
    flipped: Tensor  # (T, A) bool, negate the atom
    temperature: Tensor  # (T, A) float64, metres per logit
    inputs: Tensor  # (T, N) int64, see Gates
    negated: Tensor  # (T, M) bool, see Gates
    constants: Tensor  # (T, C) float64, indexed as if they followed the observation


def compile_queries(queries: Mapping[Task, Sequence[Query]]) -> tuple[QueryTables, Shapes]:
    """Compile queries; return tables with one row per task, in the mapping's order, and the shapes of the gates."""
    expressions, latches = _columns(queries)
    atoms_of = [
        {leaf: clause_atoms(leaf, task) for leaf in chain(*map(leaves, listed)) if not isinstance(leaf, Before)}
        for task, listed in zip(queries, expressions, strict=True)
    ]
    compiled = [list(dict.fromkeys([_ALWAYS, *chain(*own.values())])) for own in atoms_of]
    most = max(map(len, compiled))

    def operand(own: dict[Clause, list[Atom]], place: dict[Atom, int]) -> Callable[[Expression], Operand]:
        def values(literal: Expression) -> Operand:
            leaf = literal.leaf
            numbers = [most + leaf.number] if isinstance(leaf, Before) else [place[atom] for atom in own[leaf]]
            return numbers, literal.negated

        return values

    places = [{atom: number for number, atom in enumerate(atoms)} for atoms in compiled]
    gates = compile_gates(expressions, list(map(operand, atoms_of, places)), most + latches, true=0)
    listed = [atoms + [_ALWAYS] * (most - len(atoms)) for atoms in compiled]
    constants, size = [0.0], one_layout(queries).size

    def table(value: Callable[[Atom], Any], dtype: torch.dtype = torch.int64) -> Tensor:
        values = torch.tensor([[value(atom) for atom in atoms] for atoms in listed], dtype=dtype)
        return values.movedim(1, -1).contiguous()

    tables = QueryTables(
        first=table(lambda atom: atom.coordinates(0, constants, size)).flatten(1),
        second=table(lambda atom: atom.coordinates(1, constants, size)).flatten(1),
        shift=table(lambda atom: atom.offset, torch.float64),
        length=table(lambda atom: atom.part.length, torch.bool),
        far=table(lambda atom: atom.far, torch.bool),
        threshold=table(lambda atom: atom.threshold, torch.float64),
        flipped=table(lambda atom: atom.flipped, torch.bool),
        temperature=table(lambda atom: atom.part.temperature, torch.float64),
        inputs=gates.inputs,
        negated=gates.negated,
        constants=torch.tensor([constants] * len(listed), dtype=torch.float64),
    )
    return tables, gates.shapes


MOST_FACTS = 63  # maximum number of facts of a task; the last of the 64 bits is never set
_FALSE = 1 << MOST_FACTS
Bits = NDArray[np.uint64]


class QueryFacts(NamedTuple):
    """The facts (F) of all tasks as bits, one task after another.

    A task's facts are the previous values of its L latches (the first bits), then length comparisons, then comparisons
    of single coordinates, then gates (D). A gate or query is true if ``facts & care == want``, where ``care`` masks the
    bits that matter.
    """

    ids: NDArray[np.int64]  # (T,), task ids, ascending
    row_of: NDArray[np.int64]  # (50,), the row of each Meta-World task; -1 for a task without queries
    ends: Bits  # (T, 5): first length, first coordinate, end of coordinates, first gate, end of gates
    places: Bits  # (F, 6), indices of x, x, y, y, z, z of the two positions; a coordinate uses only the first two
    metres: NDArray[np.floating[Any]]  # (F, 5): the shift along x, y and z, the length's sign, the threshold
    bit: Bits  # (F,), the bit number of each fact
    flipped: Bits  # (T,), the bits to negate
    gates: Bits  # (D, 3): care, want, and the bit to set if the gate is true; it depends only on earlier bits
    care: Bits  # (T, S), the bits that each query depends on
    want: Bits  # (T, S), the required values of these bits
    constants: NDArray[np.floating[Any]]  # (C,), indexed as if they followed the observation

    def of(self, dtype: Any) -> QueryFacts:
        """Return the facts with all metres and constants cast to ``dtype``."""
        return self._replace(metres=self.metres.astype(dtype), constants=self.constants.astype(dtype))


Condition = tuple[int, int]  # (care, want)


def _task_facts(
    task: Task, expressions: Sequence[Expression], latches: int
) -> tuple[dict[Atom, int], dict[Condition, int], list[Condition]]:
    """Return each atom's bit number, each gate's bit, and each expression's (care, want) bit masks."""
    places: dict[Atom, int] = {}
    bits: dict[Clause | Before, int] = {}
    # Number all atoms first, since the bits of gates follow the bits of atoms.
    for leaf in dict.fromkeys(chain(*map(leaves, expressions))):
        if isinstance(leaf, Before):
            bits[leaf] = 1 << leaf.number
        else:
            atoms = clause_atoms(leaf, task)
            bits[leaf] = sum({1 << places.setdefault(atom, latches + len(places)) for atom in atoms})
    gates: dict[Condition, int] = {}

    def gate(condition: Condition) -> int:
        return gates.setdefault(condition, 1 << latches + len(places) + len(gates))

    def conjunction(parts: Sequence[Expression]) -> Condition:
        true = false = 0
        for part in parts:
            if part.kind == "any":
                false |= inner[negate(part)]
            elif not part.negated:
                true |= bits[part.leaf]
            else:
                together = bits[part.leaf]
                false |= together if together.bit_count() == 1 else gate((together, together))
        return (_FALSE, _FALSE) if true & false else (true | false, true)

    inner: dict[Expression, int] = {}
    for each in inner_gates(expressions):
        inner[each] = gate(conjunction(each.parts))
    conditions = [
        (_FALSE, _FALSE) if each == FALSE else conjunction(each.parts if each.kind == "all" else [each])
        for each in expressions
    ]
    return places, gates, conditions


def compile_facts(queries: Mapping[Task, Sequence[Query]]) -> QueryFacts | None:
    """Compile the queries of tasks, sorted by task id, to facts; return None if a task has more than 63 facts."""
    ids = [task_id(task.name) for task in queries]
    row_of = np.full(len(MT50), -1)
    for row, number in enumerate(ids):
        if number < len(MT50):
            row_of[number] = row
    columns, latches = _columns(queries)
    tasks = [_task_facts(task, listed, latches) for task, listed in zip(queries, columns, strict=True)]
    if latches + max(len(atoms) + len(together) for atoms, together, _ in tasks) > MOST_FACTS:
        return None
    constants, size = [0.0], one_layout(queries).size
    places: list[list[int]] = []
    gates: list[tuple[int, int, int]] = []
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
        ends.append([begin, begin + lengths, len(places), len(gates), len(gates) + len(together)])
        gates += [(care, want, bit) for (care, want), bit in together.items()]
    steps = max(len(literals) for *_, literals in tasks)
    padded = [literals + [(_FALSE, _FALSE)] * (steps - len(literals)) for *_, literals in tasks]
    care, want = np.moveaxis(np.array(padded, np.uint64), 2, 0)
    tables = {"ends": ends, "places": places, "bit": bits, "flipped": flipped, "care": care, "want": want}
    facts = {name: np.array(table, np.uint64, order="C") for name, table in tables.items()}
    facts["places"] = facts["places"].reshape(-1, 6)  # needed if there are no atoms
    facts["gates"] = np.array(gates, np.uint64).reshape(-1, 3)
    lengths_of = np.array(metres, np.float64).reshape(-1, 5)
    return QueryFacts(ids=np.array(ids), row_of=row_of, metres=lengths_of, constants=np.array(constants), **facts)
