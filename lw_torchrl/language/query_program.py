"""QueryProgram: the queries of many tasks as index tensors, evaluated for a mixed batch in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lw_torchrl.language.queries import Clause, Query, check_query
from lw_torchrl.language.relations import MEASURES, PREDICATES, Comparison, measure
from lw_torchrl.language.tasks import TASKS, Coordinate, Task, get_task, task_id

_OBSERVATION = 39
_OPENING = 3  # index of the gripper's opening in the observation
_ORIGIN = (0.0, 0.0, 0.0)
_NEVER = Comparison("xyz", "<", -1.0)  # a length is never under -1: the padding of the tables
_ALWAYS = Comparison("xyz", ">", -1.0)


@dataclass
class _Tables:
    """Per task (T): the pairs of positions to subtract (P), and for each query (S), clause (K) and comparison (2)
    which measure of which difference to compare with what. Every comparison is ``sign·measure < threshold``."""

    row: Tensor  # (50,) int64, the row of a task_id in the tables below, -1 for tasks without queries
    constants: Tensor  # (C,) float64, metres, read as if they followed the 39 numbers of the observation
    first: Tensor  # (T, P*3) int64, index of each coordinate of the first position
    second: Tensor  # (T, P*3) int64
    measure: Tensor  # (T, S*K*2) int64, index into the P*M measures
    sign: Tensor  # (T, S*K*2) float64
    threshold: Tensor  # (T, S*K*2) float64, metres
    flipped: Tensor  # (T, S*K*2) bool, take the complement
    negated: Tensor  # (T, S, K) bool, take the clause's complement

    def to(self, device: torch.device, dtype: torch.dtype) -> _Tables:
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        return _Tables(**{k: v.to(device, dtype if v.is_floating_point() else None) for k, v in moved.items()})


_Position = tuple[Coordinate, Coordinate, Coordinate]


def _clause_reads(clause: Clause, task: Task) -> tuple[_Position, _Position]:
    if clause.predicate in ("open", "closed"):
        return (0.0, 0.0, _OPENING), _ORIGIN
    first = task.object(clause.subject).position
    return first, _ORIGIN if clause.object is None else task.object(clause.object).position


def _task_entries(
    task: Task, queries: Sequence[Query], steps: int, width: int
) -> tuple[list[tuple[_Position, _Position]], list[tuple[int, Comparison]], list[bool]]:
    """The pairs of positions of one task, its comparisons with the pair of each, and which clauses are negated."""
    pairs: list[tuple[_Position, _Position]] = []
    entries: list[tuple[int, Comparison]] = []
    negated: list[bool] = []
    for s in range(steps):
        clauses = queries[s].clauses if s < len(queries) else ()
        for k in range(width):
            pair = 0
            comparisons: tuple[Comparison, ...] = (_ALWAYS if s < len(queries) else _NEVER,)
            if k < len(clauses):
                reads = _clause_reads(clauses[k], task)
                if reads not in pairs:
                    pairs.append(reads)
                pair, comparisons = pairs.index(reads), PREDICATES[clauses[k].predicate]
            entries += [(pair, part) for part in (*comparisons, _ALWAYS)[:2]]
            negated.append(k < len(clauses) and clauses[k].negated)
    return pairs, entries, negated


def _compile(queries: Mapping[Task, Sequence[Query]]) -> _Tables:
    steps = max(map(len, queries.values()))
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    constants = [0.0]

    def index(coordinate: Coordinate) -> int:
        if isinstance(coordinate, int):
            return coordinate
        if coordinate not in constants:
            constants.append(coordinate)
        return _OBSERVATION + constants.index(coordinate)

    found = [_task_entries(task, listed, steps, width) for task, listed in queries.items()]
    most = max(len(pairs) for pairs, _, _ in found)
    padded = [pairs + [(_ORIGIN, _ORIGIN)] * (most - len(pairs)) for pairs, _, _ in found]
    row = torch.full((len(TASKS),), -1)
    for t, task in enumerate(queries):
        row[task_id(task.name)] = t
    signs = [[1.0 if part.sense == "<" else -1.0 for _, part in entries] for _, entries, _ in found]
    sign = torch.tensor(signs, dtype=torch.float64)
    limits = torch.tensor([[part.threshold for _, part in entries] for _, entries, _ in found], dtype=torch.float64)
    first, second = (
        torch.tensor([[index(c) for pair in pairs for c in pair[side]] for pairs in padded]) for side in (0, 1)
    )
    return _Tables(
        row=row,
        constants=torch.tensor(constants, dtype=torch.float64),
        first=first,
        second=second,
        measure=torch.tensor(
            [
                [pair * len(MEASURES) + MEASURES.index(part.measured) for pair, part in entries]
                for _, entries, _ in found
            ]
        ),
        sign=sign,
        threshold=sign * limits,
        flipped=torch.tensor([[part.sense == "<=" for _, part in entries] for _, entries, _ in found]),
        negated=torch.tensor([negated for _, _, negated in found]).unflatten(-1, (steps, width)),
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
        self._source = _compile(compiled)
        self._moved: dict[tuple[torch.device, torch.dtype], _Tables] = {}

    def __repr__(self) -> str:
        return f"QueryProgram({len(self.tasks)} tasks, num_queries={self.num_queries})"

    def _tables(self, observation: Tensor) -> _Tables:
        key = (observation.device, observation.dtype)
        if key not in self._moved:
            self._moved[key] = self._source.to(*key)
        return self._moved[key]

    def _check(self, observation: Tensor, task_id: Tensor, tables: _Tables) -> None:
        if observation.shape[-1:] != (_OBSERVATION,) or not observation.is_floating_point():
            raise ValueError(
                f"observation must be float of shape (..., {_OBSERVATION}), got {observation.dtype} of shape "
                f"{tuple(observation.shape)}"
            )
        if task_id.shape != observation.shape[:-1] or task_id.dtype not in (torch.int64, torch.int32):
            raise ValueError(
                f"task_id must be int64 of shape {tuple(observation.shape[:-1])}, one per observation, got "
                f"{task_id.dtype} of shape {tuple(task_id.shape)}"
            )
        if torch.compiler.is_compiling():
            return
        if not observation.isfinite().all():
            raise ValueError("observation must hold finite numbers, got NaN or infinity")
        inside = (task_id >= 0) & (task_id < len(TASKS))
        if not inside.all() or (tables.row[task_id] < 0).any():
            known = inside & (tables.row[task_id.clamp(0, len(TASKS) - 1)] >= 0)
            wrong = sorted(set(task_id[~known].tolist()))[:5]
            names = [f"{i} ({list(TASKS)[i]})" if 0 <= i < len(TASKS) else str(i) for i in wrong]
            raise ValueError(f"task_id holds {', '.join(names)}, for which there are no queries; {self!r}")

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
        tables = self._tables(observation)
        self._check(observation, task_id, tables)
        row = tables.row[task_id]
        numbers = torch.cat((observation, tables.constants.expand(*observation.shape[:-1], -1)), -1)
        d = numbers.gather(-1, tables.first[row]) - numbers.gather(-1, tables.second[row])
        measures = measure(d.unflatten(-1, (-1, 3))).flatten(-2)
        value = measures.gather(-1, tables.measure[row]) * tables.sign[row]
        holds = (value < tables.threshold[row]) ^ tables.flipped[row]
        clauses = holds.unflatten(-1, (*tables.negated.shape[1:], 2)).all(-1) ^ tables.negated[row]
        return clauses.all(-1)
