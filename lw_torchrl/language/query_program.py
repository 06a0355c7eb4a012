"""QueryProgram: the queries of many tasks as index tensors, evaluated for a mixed batch in one call."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from typing import Any, NamedTuple

import torch
from torch import Tensor

from lw_torchrl.language.observation import OBSERVATION_SIZE, OPENING
from lw_torchrl.language.queries import Clause, Query, check_query
from lw_torchrl.language.relations import PREDICATES, Comparison
from lw_torchrl.language.task_index import TaskIndex, TaskTables, readable
from lw_torchrl.language.tasks import Coordinate, Task, coordinate_index, get_task

_ORIGIN = (0.0, 0.0, 0.0)
# Of the origin and itself, the padding of the tables: far from changing its truth at any temperature.
_ALWAYS = Comparison("xyz", "<", 1e4, temperature=1e-6)
_NEVER = Comparison("xyz", "<", -1e4, temperature=1e-6)
_LEAST, _MOST = 1e-6, 1e4  # of the size of a logit, and of metres where a length has a gradient

_Position = tuple[Coordinate, Coordinate, Coordinate]
_Atom = tuple[_Position, _Position, tuple[float, float, float], Comparison]
_NO_SHIFT = (0.0, 0.0, 0.0)


class _Tables(NamedTuple):
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


def _clause_atoms(clause: Clause, task: Task) -> list[_Atom]:
    first: _Position = (0.0, 0.0, OPENING)
    second: _Position = _ORIGIN
    shift = _NO_SHIFT
    if clause.predicate not in ("open", "closed"):
        subject = task.object(clause.subject)
        first, shift = subject.position, subject.offset
        if clause.object is not None:
            other = task.object(clause.object)
            second = other.position
            x, y, z = (a - b for a, b in zip(shift, other.offset, strict=True))
            shift = (x, y, z)
    return [(first, second, shift, part) for part in PREDICATES[clause.predicate]]


def _task_atoms(task: Task, queries: Sequence[Query], steps: int, width: int) -> tuple[list[_Atom], list, list]:
    """The atoms of one task, each once; those of each clause (steps, width, J); what is negated (steps, width)."""
    clauses = [[(_clause_atoms(clause, task), clause.negated) for clause in query.clauses] for query in queries]
    clauses += [[([(_ORIGIN, _ORIGIN, _NO_SHIFT, _NEVER)], False)]] * (steps - len(queries))
    always = (_ORIGIN, _ORIGIN, _NO_SHIFT, _ALWAYS)
    padded = [[*listed, *[([], False)] * (width - len(listed))] for listed in clauses]
    atoms = dict.fromkeys([always, *(atom for listed in padded for found, _ in listed for atom in found)])
    place = {atom: number for number, atom in enumerate(atoms)}
    places = [[[place[atom] for atom in found] for found, _ in row] for row in padded]
    return list(atoms), places, [[negated for _, negated in row] for row in padded]


def _compile(queries: Mapping[Task, Sequence[Query]]) -> _Tables:
    steps = max(map(len, queries.values()))
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    found = [_task_atoms(task, listed, steps, width) for task, listed in queries.items()]
    most = max(len(atoms) for atoms, _, _ in found)
    parts = max(2, *(len(each) for _, places, _ in found for row in places for each in row))
    filled = [[[[*each, *[0] * (parts - len(each))] for each in row] for row in places] for _, places, _ in found]
    listed = [atoms + [(_ORIGIN, _ORIGIN, _NO_SHIFT, _ALWAYS)] * (most - len(atoms)) for atoms, _, _ in found]
    constants = [0.0]

    def index(atom: _Atom, side: int) -> list[int]:
        first, second, _, part = atom
        position = (first, second)[side if part.sense == "<" else 1 - side]
        return [
            coordinate_index(c if axis in part.axes else 0.0, constants)
            for axis, c in zip("xyz", position, strict=True)
        ]

    def shift(atom: _Atom) -> list[float]:
        *_, found, part = atom
        sign = 1.0 if part.sense == "<" else -1.0
        moved = (found[0], found[1], found[2] + part.raise_z)
        return [sign * metres if axis in part.axes else 0.0 for axis, metres in zip("xyz", moved, strict=True)]

    def table(value: Callable[[_Atom], Any], dtype: torch.dtype = torch.int64) -> Tensor:
        values = torch.tensor([[value(atom) for atom in atoms] for atoms in listed], dtype=dtype)
        return values.movedim(1, -1).contiguous()

    return _Tables(
        first=table(lambda atom: index(atom, 0)).flatten(1),
        second=table(lambda atom: index(atom, 1)).flatten(1),
        shift=table(shift, torch.float64),
        length=table(lambda atom: atom[3].length, torch.bool),
        far=table(lambda atom: atom[3].length and atom[3].sense != "<", torch.bool),
        threshold=table(lambda atom: atom[3].threshold * (1 if atom[3].sense == "<" else -1), torch.float64),
        flipped=table(lambda atom: atom[3].sense == "<=", torch.bool),
        temperature=table(lambda atom: atom[3].temperature, torch.float64),
        atoms=torch.tensor(filled).permute(0, 3, 2, 1).flatten(1),
        negated=torch.tensor([negated for _, _, negated in found]).transpose(1, 2).contiguous(),
        constants=torch.tensor([constants] * len(listed), dtype=torch.float64),
    )


class QueryProgram:
    """Queries compiled once, answered for any batch of mixed tasks in one call.

    Args:
        queries: task name (or :class:`Task`) to its queries, each a :class:`Query` or any accepted spelling.

    Attributes:
        tasks: the names of the tasks it answers for, sorted.
        num_queries: S, the length of the longest list.

    Raises:
        ValueError: an unknown task, the same task twice, a text outside the query language, or a task without
            queries.

    Example:
        >>> import torch
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = QueryProgram({"reach": ["the gripper is near the reach target", "the gripper is open"]})
        >>> observation = torch.zeros(1, 39)
        >>> observation[0, 3] = 1.0
        >>> program(observation, torch.tensor([task_id("reach")]))
        tensor([[True, True]])

    Source: paper section 'Query Answering Function'.
    """

    def __init__(self, queries: Mapping[str | Task, Sequence[str | Query]]) -> None:
        if not isinstance(queries, Mapping):
            raise TypeError(f"queries must map task names to lists of queries, got {type(queries).__name__}")
        if not queries:
            raise ValueError("queries must name at least one task, got an empty mapping")
        compiled: dict[Task, tuple[Query, ...]] = {}
        for key, listed in queries.items():
            task = get_task(key)
            if any(task.name == other.name for other in compiled):
                raise ValueError(f"queries must name each task once, got {task.name!r} twice")
            if isinstance(listed, (str, Query)) or not listed:
                raise ValueError(f"queries[{task.name!r}] must be a list of at least one query, got {listed!r}")
            compiled[task] = tuple(check_query(query, task) for query in listed)
        self.queries = dict(sorted(((task.name, found) for task, found in compiled.items())))
        self.tasks = tuple(self.queries)
        self.num_queries = max(map(len, compiled.values()))
        index = TaskIndex(self.tasks)
        in_order = dict(sorted(compiled.items(), key=lambda item: index.row(item[0].name)))
        tables = _compile(in_order)
        self._any_far = bool(tables.far.any())
        self._tables = TaskTables(index, tables, f"tasks without queries in {self!r}")

    def __repr__(self) -> str:
        return f"QueryProgram({len(self.tasks)} tasks, num_queries={self.num_queries})"

    def __call__(self, observation: Tensor, task_id: Tensor) -> Tensor:
        """Answer the queries.

        Args:
            observation: (..., 39) float, Meta-World's vector, metres.
            task_id: (...) int64.

        Returns:
            (..., S) bool on the observation's device, on the order of the task's list; padding is false.

        Raises:
            ValueError: wrong shape or dtype, NaN or infinity in the observation, or a task without queries.
        """
        _check_batch(observation, task_id)
        tables = self._tables.select(task_id.reshape(-1), observation)
        holds = (self._values(observation, tables) < tables.threshold) ^ tables.flipped
        # & of a few is far faster than all() over a short axis.
        clauses = reduce(torch.logical_and, self._parts(holds, tables)) ^ tables.negated
        return reduce(torch.logical_and, clauses.unbind(1)).reshape(*task_id.shape, self.num_queries)

    def logits(self, observation: Tensor, task_id: Tensor, *, temperature: float = 1.0) -> Tensor:
        """Soft truth: how far each query is from changing its truth, differentiable in the observation.

        A comparison's margin is the distance to its threshold, divided by its temperature (see
        :class:`~lw_torchrl.language.relations.Comparison`); a conjunction has the least margin of its parts, a
        negation the opposite one. The sign is the hard truth: positive where the query holds, negative where it does
        not, never zero. The gradient is that of the comparison that decides; it is finite everywhere.

        Args:
            observation: (..., 39) float, Meta-World's vector, metres.
            task_id: (...) int64.
            temperature: multiplies every comparison's own, between 1e-6 and 1e6.

        Returns:
            (..., S) float32 logits on the observation's device, of size 1e-6 to 1e4; padding is -1e4.

        Raises:
            ValueError: as for the hard truth; or the temperature is out of range.

        Example:
            >>> import torch, lw_torchrl as lw
            >>> program = QueryProgram({"reach": ["the gripper is near the reach target"]})
            >>> state = torch.zeros(1, 39, requires_grad=True)
            >>> logit = program.logits(state, torch.tensor([lw.task_id("reach")]))
            >>> logit.item() > 0, torch.autograd.grad(logit.sum(), state)[0].isfinite().all().item()
            (True, True)
        """
        if not isinstance(temperature, (int, float)) or not 1e-6 <= temperature <= 1e6:
            raise ValueError(f"temperature must be a number between 1e-6 and 1e6, got {temperature!r}")
        holds = self(observation.detach(), task_id)
        near = observation if observation.dtype in (torch.float32, torch.float64) else observation.float()
        near = near.clamp(-_MOST, _MOST)  # squares of larger numbers overflow
        tables = self._tables.select(task_id.reshape(-1), near)
        margin = (tables.threshold - self._values(near, tables, floor=_LEAST)) / tables.temperature / temperature
        clause = reduce(torch.minimum, self._parts(torch.where(tables.flipped, -margin, margin), tables))
        soft = torch.where(tables.negated, -clause, clause).amin(1).float().reshape(holds.shape)
        size = torch.where(holds, soft, -soft).detach().clamp(_LEAST, _MOST)
        # On a threshold, the side that the hard truth takes; the gradient is that of soft everywhere.
        return soft - soft.detach() + torch.where(holds, size, -size)

    def _parts(self, atoms: Tensor, tables: _Tables) -> tuple[Tensor, ...]:
        """(B, A) of the atoms to J of (B, K, S), the atoms of each clause."""
        return atoms.gather(1, tables.atoms).unflatten(1, (-1, *tables.negated.shape[1:])).unbind(1)

    def _values(self, observation: Tensor, tables: _Tables, floor: float = 0.0) -> Tensor:
        """What each atom compares, (B, A) metres. The length of nothing has no gradient: ``floor`` keeps away from
        it."""
        numbers = torch.cat((observation.reshape(-1, OBSERVATION_SIZE), tables.constants), 1)
        d = (numbers.gather(1, tables.first) - numbers.gather(1, tables.second)).unflatten(1, (3, -1)) + tables.shift
        x, y, z = d.unbind(1)
        squared = x.square() + y.square() + z.square()
        length = (squared.clamp(min=floor**2) if floor else squared).sqrt()
        if self._any_far:
            length = torch.where(tables.far, -length, length)
        return torch.where(tables.length, length, x + y + z)


def _check_batch(observation: Tensor, task_id: Tensor) -> None:
    if observation.shape[-1:] != (OBSERVATION_SIZE,) or not observation.is_floating_point():
        raise ValueError(
            f"observation must be float of shape (..., {OBSERVATION_SIZE}), got {observation.dtype} of shape "
            f"{tuple(observation.shape)}"
        )
    if task_id.shape != observation.shape[:-1] or task_id.dtype not in (torch.int64, torch.int32):
        raise ValueError(
            f"task_id must be int64 of shape {tuple(observation.shape[:-1])}, one per observation, got "
            f"{task_id.dtype} of shape {tuple(task_id.shape)}"
        )
    problem = "observation must hold finite numbers, got NaN or infinity"
    if torch.compiler.is_compiling():
        torch._assert_async(observation.isfinite().all(), problem)
    elif readable(observation) and not (
        math.isfinite(observation.sum().item()) or observation.isfinite().all()  # the sum is fast; it may overflow
    ):
        raise ValueError(problem)
