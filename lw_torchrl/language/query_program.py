"""Compiled queries: the queries of many tasks as index tensors, evaluated for a mixed batch in one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from numbers import Real
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn

from lw_torchrl._util.checks import check_choice, check_value
from lw_torchrl._util.devices import check_finite
from lw_torchrl.language.gates import Gates, Truth, evaluate_gates
from lw_torchrl.language.queries import Query, check_query
from lw_torchrl.language.query_tables import QueryTables, compile_facts, compile_queries, unroll
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task, lists_by_task, one_layout, task_ids

_LEAST, _MOST = 1e-6, 1e4  # bounds on the magnitude of a logit, and on differentiated lengths (metres)
_NO_LATCHES = np.empty((0, 0), dtype=bool)
_COMPILED = {torch.float32: np.float32, torch.float64: np.float64}


@cache
def find_kernel() -> Callable[..., bool] | None:
    """Return the Numba kernel, or None if Numba is not installed or cannot compile the kernel."""
    try:
        from lw_torchrl.language.query_kernel import answer
    except (ImportError, RuntimeError):  # RuntimeError: Numba finds no writable cache folder
        return None
    return answer


class QueryProgram(nn.Module):
    """A module that compiles queries once and answers them for any batch of mixed tasks in one call.

    The compiled tables are non-persistent buffers whose dtype never changes. With Numba (``lw_torchrl[fast]``) a
    compiled loop answers batches on the CPU, with identical results; the first call compiles for about a second.

    Args:
        queries: a mapping from task names (or :class:`Task`) to lists of queries, each a :class:`Query` or a text.

    Attributes:
        tasks: the names of the tasks, sorted.
        num_queries: the number of queries S in the longest list.
        num_latches: the largest number L of latches of a task ("the puck has been near the goal"); see
            :meth:`remember`.
        layout: the layout of the tasks' observations.

    Example:
        >>> from lw_torchrl.language.tasks import task_id
        >>> program = QueryProgram({"reach": ["the gripper is near the reach target", "the gripper is open"]})
        >>> program(torch.zeros(1, 39), torch.tensor([task_id("reach")]))
        tensor([[ True, False]])

    Source: paper section 'Query Answering Function'.
    """

    def __init__(self, queries: Mapping[str | Task, Sequence[str | Query]]) -> None:
        compiled = {
            task: tuple(check_query(check_value(f"queries[{task.name!r}]", each, str | Query), task) for each in listed)
            for task, listed in lists_by_task("queries", queries).items()
        }
        super().__init__()
        self.layout = one_layout(compiled)
        self.queries = dict(sorted(((task.name, parsed) for task, parsed in compiled.items())))
        self.tasks = tuple(self.queries)
        self.num_queries = max(map(len, compiled.values()))
        self.num_latches = max(len(unroll(listed)[1]) for listed in compiled.values())
        self._columns = self.num_queries + self.num_latches
        index = TaskIndex(task_ids(self.tasks))
        in_order = dict(sorted(compiled.items(), key=lambda item: index.row(item[0].name)))
        tables, self._shapes = compile_queries(in_order)
        self._any_far = bool(tables.far.any())
        self._tables = TaskTables(index, tables, f"tasks without queries in {self!r}")
        facts = compile_facts(in_order)
        self._facts = {} if facts is None else {dtype: facts.of(kind) for dtype, kind in _COMPILED.items()}

    def __repr__(self) -> str:
        return f"QueryProgram({len(self.tasks)} tasks, num_queries={self.num_queries})"

    def forward(self, observation: Tensor, task_id: Tensor, latches: Tensor | None = None) -> Tensor:
        """Answer the queries.

        Args:
            observation: (..., D) float, in the tasks' layout (39 numbers in metres for Meta-World).
            task_id: (...) int64, ids of tasks with queries.
            latches: (..., L) bool, the latches of the previous or the current step; only required if L > 0.

        Returns:
            (..., S) bool on the observation's device, in the order of the task's list of queries; padding is false.

        Raises:
            ValueError: the inputs have a wrong shape or dtype, a NaN or an infinity, or a task without queries; or
                latches are missing.
        """
        truth = self._columns_of(observation, task_id, latches)
        return truth[..., : self.num_queries] if self.num_latches else truth

    def remember(self, observation: Tensor, task_id: Tensor, latches: Tensor | None) -> tuple[Tensor, Tensor]:
        """Answer the queries and update the latches.

        A latch is true from the first step of an episode in which its condition was true, including that step.

        Args:
            observation, task_id: as for :meth:`forward`.
            latches: (..., L) bool, the latches of the previous step; false in the first step of an episode.

        Returns:
            the answers (..., S) bool, and the latches of this step (..., L) bool.

        Example:
            >>> from lw_torchrl.language.tasks import task_id
            >>> program = QueryProgram({"reach": ["the gripper has been open"]})
            >>> observation, ids = torch.zeros(1, 39), torch.tensor([task_id("reach")])
            >>> program.remember(observation, ids, torch.tensor([[False]]))
            (tensor([[False]]), tensor([[False]]))
            >>> program.remember(observation, ids, torch.tensor([[True]]))
            (tensor([[True]]), tensor([[True]]))
        """
        truth = self._columns_of(observation, task_id, latches)
        return truth[..., : self.num_queries], truth[..., self.num_queries :]

    def _columns_of(self, observation: Tensor, task_id: Tensor, latches: Tensor | None) -> Tensor:
        """Return the truth (..., S + L) bool of the queries and latches."""
        for name, value in (("observation", observation), ("task_id", task_id)):
            if not isinstance(value, Tensor):
                raise TypeError(f"{name} must be a tensor, got {type(value).__name__}; convert it with torch.as_tensor")
        shape, ids, size = tuple(observation.shape), tuple(task_id.shape), self.layout.size
        if shape[-1:] != (size,) or not observation.is_floating_point():
            raise ValueError(f"observation must be float (..., {size}), got {observation.dtype} of shape {shape}")
        if ids != shape[:-1] or task_id.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"task_id must be int64 of shape {shape[:-1]}, got {task_id.dtype} of shape {ids}")
        needed = (*ids, self.num_latches)
        got = None if latches is None else (latches.dtype, tuple(latches.shape))
        if self.num_latches and got != (torch.bool, needed):
            raise ValueError(f"latches must be bool of shape {needed}, for queries about earlier steps, got {got}")
        if (kernel := self._kernel(observation, task_id, latches)) is not None:
            return self._answer(kernel, observation, task_id, latches)
        check_finite("observation", observation)
        tables = self._tables.select(task_id.reshape(-1), observation)
        atoms = (self._values(observation, tables) < tables.threshold) ^ tables.flipped
        if latches is not None and self.num_latches:
            atoms = torch.cat((atoms, latches.reshape(-1, self.num_latches)), 1)
        return self._combine(atoms, tables, "exact").reshape(*task_id.shape, self._columns)

    def logits(
        self,
        observation: Tensor,
        task_id: Tensor,
        latches: Tensor | None = None,
        *,
        temperature: float = 1.0,
        truth: Literal["min-max", "product"] = "min-max",
    ) -> Tensor:
        """Return soft truth values: each query's margin as a logit, differentiable in the observation.

        A comparison's margin is its distance to the threshold, divided by its temperature (see
        :class:`~lw_torchrl.language.relations.Comparison`). A clause has the smallest margin of its comparisons, and a
        negation changes the sign.

        With "min-max", a conjunction has the smallest margin of its operands, and a disjunction the largest. The logit
        is positive if the query is true, otherwise negative, and never zero. Its gradient is the gradient of the
        comparison that determines it.

        With "product", the operands are treated as independent statements, whose probabilities are the sigmoids of
        their logits. Every operand then has a gradient, but a true query may have a negative logit near a threshold.
        Gradients are always finite.

        Args:
            observation, task_id, latches: as for :meth:`forward`. A latch that is already true has the logit 1e4.
            temperature: a factor on every comparison's temperature, between 1e-6 and 1e6.
            truth: how the operands of "and" and "or" are combined, "min-max" or "product".

        Returns:
            (..., S) float32 logits on the observation's device, with magnitudes from 1e-6 to 1e4; padding is -1e4.
        """
        if not isinstance(temperature, Real) or not 1e-6 <= temperature <= 1e6:  # a check that torch.compile can trace
            raise ValueError(f"temperature must be between 1e-6 and 1e6, got {temperature!r}")
        check_choice("truth", truth, ("min-max", "product"))
        exact = self._columns_of(observation.detach(), task_id, latches)
        state = observation if observation.dtype in _COMPILED else observation.float()
        state = state.clamp(-_MOST, _MOST)  # squares of larger numbers overflow
        tables = self._tables.select(task_id.reshape(-1), state)
        margin = (tables.threshold - self._values(state, tables, floor=_LEAST)) / tables.temperature / temperature
        margin = torch.where(tables.flipped, -margin, margin)
        if latches is not None and self.num_latches:
            before = torch.where(latches.reshape(-1, self.num_latches), _MOST, -_MOST)
            margin = torch.cat((margin, before.to(margin.dtype)), 1)
        soft = self._combine(margin, tables, truth).float().reshape(exact.shape)
        if self.num_latches:
            soft, exact = soft[..., : self.num_queries], exact[..., : self.num_queries]
        if truth == "product":
            return soft.clamp(-_MOST, _MOST)
        size = torch.where(exact, soft, -soft).detach().clamp(_LEAST, _MOST)
        # The value has the sign of the hard truth, even exactly on a threshold; the gradient is that of ``soft``.
        return soft - soft.detach() + torch.where(exact, size, -size)

    def _kernel(
        self, observation: Tensor, task_id: Tensor, latches: Tensor | None = None
    ) -> Callable[..., bool] | None:
        """Return the kernel if it supports these tensors; else None."""
        on_cpu = observation.dtype in self._facts and observation.is_cpu and task_id.is_cpu
        fits = on_cpu and self._tables.plain(observation, task_id) and not observation.is_neg()
        if latches is not None and self.num_latches:
            fits = fits and latches.is_cpu and self._tables.plain(latches)
        return find_kernel() if fits else None

    def _answer(
        self, kernel: Callable[..., bool], observation: Tensor, task_id: Tensor, latches: Tensor | None = None
    ) -> Tensor:
        """Answer with few PyTorch operations: they are slow here, as physics has just evicted the CPU's caches."""
        states = observation.numpy(force=observation.requires_grad).reshape(-1, self.layout.size)
        ids = task_id.numpy().reshape(-1)
        truth = np.empty((len(ids), self._columns), dtype=bool)
        before = _NO_LATCHES
        if latches is not None and self.num_latches:
            before = np.ascontiguousarray(latches.numpy().reshape(-1, self.num_latches))
        batch = np.ascontiguousarray(states), np.ascontiguousarray(ids, dtype=np.int64), before
        if not kernel(*batch, *self._facts[observation.dtype], truth):
            check_finite("observation", observation)
            self._tables.select(task_id.reshape(-1), observation)  # raises for a task without queries
        return torch.from_numpy(truth.reshape(*task_id.shape, self._columns))

    def _combine(self, atoms: Tensor, tables: QueryTables, truth: Truth) -> Tensor:
        """Combine the truth or the logits of all atoms (B, A) into those of the queries (B, S)."""
        return evaluate_gates(atoms, Gates(tables.inputs, tables.negated, self._shapes), truth)

    def _values(self, observation: Tensor, tables: QueryTables, floor: float = 0.0) -> Tensor:
        """Return each atom's value (B, A) in metres; ``floor`` is the least length, since 0 has no gradient."""
        numbers = torch.cat((observation.reshape(-1, self.layout.size), tables.constants), 1)
        d = (numbers.gather(1, tables.first) - numbers.gather(1, tables.second)).unflatten(1, (3, -1)) + tables.shift
        x, y, z = d.unbind(1)
        squared = x.square() + y.square() + z.square()
        length = (squared.clamp(min=floor**2) if floor else squared).sqrt()
        if self._any_far:
            length = torch.where(tables.far, -length, length)
        return torch.where(tables.length, length, x + y + z)
