"""QueryProgram: the queries of many tasks as index tensors, evaluated for a mixed batch in one call."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from lw_torchrl.language.queries import Clause, Query, check_query
from lw_torchrl.language.relations import PREDICATES, Comparison
from lw_torchrl.language.tasks import TASKS, Coordinate, Task, get_task, task_id

_OBSERVATION = 39
_OPENING = 3  # index of the gripper's opening in the observation
_NEVER = Comparison("x", "<", -1.0)  # a length is never under -1: the padding of the tables
_ALWAYS = Comparison("x", ">", -1.0)


@dataclass
class _Tables:
    """Per task (T), query (S), clause (K) and comparison (2): where to read and what to compare."""

    row: Tensor  # (50,) int64, the row of a task_id in the tables below, -1 for tasks without queries
    constants: Tensor  # (C,) float64, metres, read as if they followed the 39 numbers of the observation
    first: Tensor  # (T, S*K*3) int64, index of each coordinate of the first position
    second: Tensor  # (T, S*K*3) int64
    negated: Tensor  # (T, S, K) bool
    axes: Tensor  # (T, S, K, 2, 3) float64, 1 for the axes that count
    raised: Tensor  # (T, S, K, 2, 3) float64, metres added to d
    length: Tensor  # (T, S, K, 2) bool
    below: Tensor  # (T, S, K, 2) bool, the sense is "<"
    flipped: Tensor  # (T, S, K, 2) bool, the sense is "<=", the complement of ">"
    threshold: Tensor  # (T, S, K, 2) float64, metres

    def to(self, device: torch.device, dtype: torch.dtype) -> _Tables:
        moved = {f.name: getattr(self, f.name) for f in fields(self)}
        return _Tables(**{k: v.to(device, dtype if v.is_floating_point() else None) for k, v in moved.items()})


def _clause_reads(clause: Clause, task: Task) -> tuple[tuple[Coordinate, ...], tuple[Coordinate, ...]]:
    origin = (0.0, 0.0, 0.0)
    if clause.predicate in ("open", "closed"):
        return (0.0, 0.0, _OPENING), origin
    first = task.object(clause.subject).position
    return first, origin if clause.object is None else task.object(clause.object).position


def _compile(queries: Mapping[Task, Sequence[Query]]) -> _Tables:
    tasks = list(queries)
    steps = max(len(listed) for listed in queries.values())
    width = max(len(query.clauses) for listed in queries.values() for query in listed)
    constants = [0.0]
    shape = (len(tasks), steps, width)
    row = torch.full((len(TASKS),), -1)
    first, second = torch.full((*shape, 3), _OBSERVATION), torch.full((*shape, 3), _OBSERVATION)
    negated = torch.zeros(shape, dtype=torch.bool)
    axes, raised = (
        torch.zeros(*shape, 2, 3, dtype=torch.float64),
        torch.zeros(*shape, 2, 3, dtype=torch.float64),
    )
    length, below, flipped = (torch.zeros(*shape, 2, dtype=torch.bool) for _ in range(3))
    threshold = torch.zeros(*shape, 2, dtype=torch.float64)

    def index(coordinate: Coordinate) -> int:
        if isinstance(coordinate, int):
            return coordinate
        if coordinate not in constants:
            constants.append(coordinate)
        return _OBSERVATION + constants.index(coordinate)

    for t, task in enumerate(tasks):
        row[task_id(task.name)] = t
        for s in range(steps):
            query = queries[task][s] if s < len(queries[task]) else None
            for k in range(width):
                at = (t, s, k)
                comparisons: tuple[Comparison, ...] = (_NEVER if query is None else _ALWAYS,)
                if query is not None and k < len(query.clauses):
                    clause = query.clauses[k]
                    comparisons = PREDICATES[clause.predicate]
                    reads = _clause_reads(clause, task)
                    first[at], second[at] = (torch.tensor([index(c) for c in read]) for read in reads)
                    negated[at] = clause.negated
                for c, part in enumerate((*comparisons, _ALWAYS)[:2]):
                    axes[(*at, c)] = torch.tensor([float(axis in part.axes) for axis in "xyz"])
                    raised[(*at, c, 2)] = part.raise_z
                    length[(*at, c)], threshold[(*at, c)] = part.length, part.threshold
                    below[(*at, c)], flipped[(*at, c)] = part.sense == "<", part.sense == "<="
    return _Tables(
        row=row,
        constants=torch.tensor(constants, dtype=torch.float64),
        first=first.flatten(1),
        second=second.flatten(1),
        negated=negated,
        axes=axes,
        raised=raised,
        length=length,
        below=below,
        flipped=flipped,
        threshold=threshold,
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
        d = (numbers.gather(-1, tables.first[row]) - numbers.gather(-1, tables.second[row])).unflatten(
            -1, (*tables.negated.shape[1:], 1, 3)
        )
        axes = tables.axes[row]
        parts = (d + tables.raised[row]) * axes
        value = torch.where(tables.length[row], torch.linalg.vector_norm(parts, dim=-1), parts.sum(-1))
        threshold = tables.threshold[row]
        below = tables.below[row]
        holds = torch.where(below, value < threshold, (value > threshold) ^ tables.flipped[row]).all(-1)
        return (holds ^ tables.negated[row]).all(-1)
