"""QueryProgram: the queries of many tasks as index tensors, evaluated for a mixed batch in one call."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, reduce
from numbers import Real

import numpy as np
import torch
from torch import Tensor, nn

from lw_torchrl._util.checks import check_choice, shown
from lw_torchrl._util.devices import check_finite
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.query_tables import QueryTables, compile_facts, compile_queries
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import TASKS, Task, one_layout, task_ids

_LEAST, _MOST = 1e-6, 1e4  # of the size of a logit, and of metres where a length has a gradient
_COMPILED = {torch.float32: np.float32, torch.float64: np.float64}


@cache
def find_kernel() -> Callable[..., bool] | None:
    """The kernel of one compiled pass, if Numba is installed and can compile."""
    try:
        from lw_torchrl.language.query_kernel import answer
    except (ImportError, RuntimeError):  # the latter where it finds no folder to keep what it compiled
        return None
    return answer


class QueryProgram(nn.Module):
    """Queries compiled once, answered for any batch of mixed tasks in one call.

    Its tables are buffers that are not saved and keep their precision. With Numba installed (``lw_torchrl[fast]``) a
    compiled loop answers batches on the CPU, with the same bits; its first call takes about a second to compile.

    Args:
        queries: task name (or :class:`Task`) to its queries, each a :class:`Query` or any accepted spelling.

    Attributes:
        tasks: the names of the tasks it answers for, sorted.
        num_queries: S, the length of the longest list.
        layout: of the tasks.

    Example:
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = QueryProgram({"reach": ["the gripper is near the reach target", "the gripper is open"]})
        >>> program(torch.zeros(1, 39), torch.tensor([task_id("reach")]))
        tensor([[ True, False]])

    Source: paper section 'Query Answering Function'.
    """

    def __init__(self, queries: Mapping[str | Task, Sequence[str | Query]]) -> None:
        what = "queries must map task names to lists of queries, got"
        if not isinstance(queries, Mapping):
            raise TypeError(f"{what} {type(queries).__name__}")
        if not queries:
            raise ValueError("queries must name at least one task, got an empty mapping")
        compiled: dict[Task, tuple[Query, ...]] = {}
        for key, listed in queries.items():
            if not isinstance(key, (str, Task)):
                raise TypeError(f"{what} {shown(key)} for a name")
            task = key if isinstance(key, Task) else TASKS[check_choice("queries", key, TASKS)]
            if any(task.name == other.name for other in compiled):
                raise ValueError(f"queries must name each task once, got {task.name!r} twice")
            if isinstance(listed, (str, Query)) or not isinstance(listed, Iterable) or not listed:
                raise ValueError(f"queries[{task.name!r}] must be a list of at least one query, got {listed!r}")
            if wrong := [query for query in listed if not isinstance(query, (str, Query))]:
                raise TypeError(f"queries[{task.name!r}] must hold strings or Query, got {shown(wrong[0])}")
            compiled[task] = tuple(check_query(query, task) for query in listed)
        super().__init__()
        self.layout = one_layout(compiled)
        self.queries = dict(sorted(((task.name, found) for task, found in compiled.items())))
        self.tasks = tuple(self.queries)
        self.num_queries = max(map(len, compiled.values()))
        index = TaskIndex(task_ids(self.tasks))
        in_order = dict(sorted(compiled.items(), key=lambda item: index.row(item[0].name)))
        tables = compile_queries(in_order)
        self._any_far = bool(tables.far.any())
        self._tables = TaskTables(index, tables, f"tasks without queries in {self!r}")
        facts = compile_facts(in_order)
        self._facts = {} if facts is None else {dtype: facts.of(kind) for dtype, kind in _COMPILED.items()}

    def __repr__(self) -> str:
        return f"QueryProgram({len(self.tasks)} tasks, num_queries={self.num_queries})"

    def forward(self, observation: Tensor, task_id: Tensor) -> Tensor:
        """Answer the queries.

        Args:
            observation: (..., D) float, as the tasks' layout says; Meta-World's 39 numbers, metres. NaN or infinity is
                a :class:`ValueError`.
            task_id: (...) int64, of tasks with queries.

        Returns:
            (..., S) bool on the observation's device, in the order of the task's list; padding is false.
        """
        _check_batch(observation, task_id, self.layout.size)
        if (kernel := self._kernel(observation, task_id)) is not None:
            return self._answer(kernel, observation, task_id)
        check_finite("observation", observation)
        tables = self._tables.select(task_id.reshape(-1), observation)
        holds = (self._values(observation, tables) < tables.threshold) ^ tables.flipped
        # & of a few is far faster than all() over a short axis.
        clauses = reduce(torch.logical_and, self._parts(holds, tables)) ^ tables.negated
        return reduce(torch.logical_and, clauses.unbind(1)).reshape(*task_id.shape, self.num_queries)

    def logits(self, observation: Tensor, task_id: Tensor, *, temperature: float = 1.0) -> Tensor:
        """Soft truth: how far each query is from changing its truth, differentiable in the observation.

        A comparison's margin is the distance to its threshold, divided by its temperature (see
        :class:`~lw_torchrl.language.relations.Comparison`). A conjunction has the least margin of its parts, a
        negation the opposite one. The sign is the hard truth, never zero. The gradient, of what decides, is finite.

        Args:
            observation, task_id: as for :meth:`forward`.
            temperature: multiplies every comparison's own, between 1e-6 and 1e6.

        Returns:
            (..., S) float32 logits on the observation's device, of size 1e-6 to 1e4; padding is -1e4.
        """
        if not isinstance(temperature, Real) or not 1e-6 <= temperature <= 1e6:
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

    def _kernel(self, observation: Tensor, task_id: Tensor) -> Callable[..., bool] | None:
        here = observation.dtype in self._facts and observation.is_cpu and task_id.is_cpu
        right = here and self._tables.plain(observation, task_id) and not observation.is_neg()
        return find_kernel() if right else None

    def _answer(self, kernel: Callable[..., bool], observation: Tensor, task_id: Tensor) -> Tensor:
        """Few operations of PyTorch: after the physics, which empties the processor's caches, each is slow."""
        states = observation.numpy(force=observation.requires_grad).reshape(-1, self.layout.size)
        ids = task_id.numpy().reshape(-1)
        truth = np.empty((len(ids), self.num_queries), dtype=bool)
        given = np.ascontiguousarray(states), np.ascontiguousarray(ids, dtype=np.int64)
        if not kernel(*given, *self._facts[observation.dtype], truth):
            check_finite("observation", observation)
            self._tables.select(task_id.reshape(-1), observation)  # one of the two raises
        return torch.from_numpy(truth.reshape(*task_id.shape, self.num_queries))

    def _parts(self, atoms: Tensor, tables: QueryTables) -> tuple[Tensor, ...]:
        """(B, A) of the atoms to J of (B, K, S), the atoms of each clause."""
        return atoms.gather(1, tables.atoms).unflatten(1, (-1, *tables.negated.shape[1:])).unbind(1)

    def _values(self, observation: Tensor, tables: QueryTables, floor: float = 0.0) -> Tensor:
        """What each atom compares, (B, A) metres; a length of 0 has no gradient, so ``floor`` bounds it from below."""
        numbers = torch.cat((observation.reshape(-1, self.layout.size), tables.constants), 1)
        d = (numbers.gather(1, tables.first) - numbers.gather(1, tables.second)).unflatten(1, (3, -1)) + tables.shift
        x, y, z = d.unbind(1)
        squared = x.square() + y.square() + z.square()
        length = (squared.clamp(min=floor**2) if floor else squared).sqrt()
        if self._any_far:
            length = torch.where(tables.far, -length, length)
        return torch.where(tables.length, length, x + y + z)


def _check_batch(observation: Tensor, task_id: Tensor, size: int) -> None:
    for name, given in (("observation", observation), ("task_id", task_id)):
        if not isinstance(given, Tensor):
            raise TypeError(f"{name} must be a tensor, got {type(given).__name__}; torch.as_tensor makes one")
    shape, ids = tuple(observation.shape), tuple(task_id.shape)
    if shape[-1:] != (size,) or not observation.is_floating_point():
        raise ValueError(f"observation must be float of shape (..., {size}), got {observation.dtype} of shape {shape}")
    if ids != shape[:-1] or task_id.dtype not in (torch.int64, torch.int32):
        raise ValueError(f"task_id must be int64 of shape {shape[:-1]}, got {task_id.dtype} of shape {ids}")
