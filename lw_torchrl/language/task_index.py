"""From task ids to rows of tables that have a row for each task, and the table of plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from lw_torchrl._util.devices import asserted, plain, readable, waits

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans, Plans

_Kind = tuple[torch.device, torch.dtype, bool]
_KEPT_ROWS = 4096  # of the last batch, the most to keep the tables of
Tables = TypeVar("Tables", bound=tuple[Tensor, ...])


def one_per_row(task_id: Tensor, values: Tensor) -> Tensor:
    """Return task ids (...) int64 for rows of ``values`` (..., N), also if they are (..., 1)."""
    return task_id.squeeze(-1) if task_id.dim() == values.dim() and task_id.shape[-1] == 1 else task_id


def pick(table: Tensor, rows: Tensor) -> Tensor:
    """Return ``table[rows]``, also for one row inside of ``vmap``: (T, ...) and (B...) int64 to (B..., ...)."""
    return table.index_select(0, rows.reshape(-1)).reshape((*rows.shape, *table.shape[1:]))


class TaskIndex:
    """The rows that tasks have in a table, in the order of their ids.

    Args:
        task_ids: task name to id, as :attr:`Plans.task_ids`; ValueError if two tasks have the same id.
    """

    def __init__(self, task_ids: Mapping[str, int]) -> None:
        names: dict[int, str] = {}
        for name, number in task_ids.items():
            if number in names:
                raise ValueError(f"tasks {names[number]!r} and {name!r} have the same id; choose another name")
            names[number] = name
        self.tasks = tuple(names[number] for number in sorted(names))
        self._ids = torch.tensor([*sorted(names), -1])  # -1 is no task's, for ids beyond the last

    def row(self, task: str) -> int:
        return self.tasks.index(task)

    def rows(self, task_id: Tensor, problem: str) -> Tensor:
        """The row of each task, (...) int64 to (...) int64. An id without one is a ValueError that names the
        ``problem``, "tasks without a plan"; compiled or on a GPU a RuntimeError; in ``vmap`` a row beyond the last."""
        if task_id.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"task_id must be int64, got {task_id.dtype}")
        kept = plain(task_id)
        ids = self._ids.to(task_id.device)
        if plain(ids):  # also inside of vmap, where task_id is not
            self._ids = ids
        given = task_id.long().contiguous()
        if kept or asserted(task_id):
            rows = torch.searchsorted(ids[:-1], given)
        else:  # inside of vmap searchsorted warns of how the rows lie in memory
            rows = (given.unsqueeze(-1) > ids[:-1]).sum(-1)
        found = ids.index_select(0, rows.reshape(-1)).reshape(rows.shape)
        if kept and not waits(task_id):
            if torch.equal(found, given):
                return rows
            from lw_torchrl.language.tasks import MT50  # here: only the message needs the names of other tasks

            wrong = given[found != given].unique().tolist()[:5]
            names = (MT50[i] if 0 <= i < len(MT50) else f"{i} (none of the 50)" for i in wrong)
            raise ValueError(f"task_id names {problem}: {', '.join(names)}")
        if asserted(task_id):
            torch._assert_async((found == given).all(), f"task_id names {problem}")
        return torch.where(found == given, rows, len(self.tasks))


def as_plans(plans: AnyPlans) -> Plans:
    """Call :func:`lw_torchrl.language.plans.as_plans`, importing it only if ``plans`` are not Plans yet."""
    if isinstance(plans, Mapping) and hasattr(plans, "task_ids"):
        return plans  # type: ignore[return-value]
    from lw_torchrl.language import plans as library

    return library.as_plans(plans)


class PlanTables:
    """Tables of plans that transforms, attention and actors read.

    Attributes:
        index: from task ids to rows, T of them.
        mask: (T, S) bool, true for the steps that exist, false for padding.
        turns: (T, 2, S) bool, the plan's own steps, and its fallback steps (its own, if it has no fallback steps).
        skill_index: (T, S) int64, the number of each step's skill in ``plans.skills``; 0 beyond the last step.
        number: (T,) int64, the number of each plan, as in :attr:`Plans.numbers`.
    """

    def __init__(self, plans: Plans) -> None:
        self.index = TaskIndex(plans.task_ids)
        self._problem = f"tasks without a plan in {plans!r}"
        self.mask = torch.zeros(len(plans), plans.num_steps, dtype=torch.bool)
        self.turns = torch.zeros(len(plans), 2, plans.num_steps, dtype=torch.bool)
        self.skill_index = torch.zeros(len(plans), plans.num_steps, dtype=torch.int64)
        skill = {text: number for number, text in enumerate(plans.skills)}
        for row, task in enumerate(self.index.tasks):
            steps = plans[task].steps
            self.mask[row, : len(steps)] = True
            fallback = torch.tensor([step.role is not None and step.role.fallback for step in steps])
            self.turns[row, 0, : len(steps)] = ~fallback
            self.turns[row, 1, : len(steps)] = fallback if fallback.any() else ~fallback
            self.skill_index[row, : len(steps)] = torch.tensor([skill[step.skill] for step in steps])
        numbers = plans.numbers
        self.number = torch.tensor([numbers[task] for task in self.index.tasks])

    def rows(self, task_id: Tensor) -> Tensor:
        """The row of each task, (...) int64 to (...) int64; a task without a plan is a :class:`ValueError`."""
        return self.index.rows(task_id, self._problem)

    def refuse_others(self, number: Tensor | None, rows: Tensor) -> None:
        """Raise :class:`ValueError` where queries of other plans than those of ``rows``, (...) int64, were answered:
        ``number``, (...) int64, is that plan's; 0 where unknown, None for all."""
        if number is None:
            return
        numbers = self.number.to(number.device)
        if numbers is not self.number and plain(numbers):
            self.number = numbers
        if asserted(number, rows):
            own = numbers[rows]
            torch._assert_async(((own == number) | (number == 0)).all(), "qaf answers other plans than the actor's")
        if not readable(number, rows):
            return
        own = numbers[rows]
        if not torch.equal(own, number) and (wrong := (own != number) & (number != 0)).any():
            tasks = ", ".join(self.index.tasks[row] for row in rows[wrong].unique().tolist()[:5])
            hint = "give QAFTransform the actor's plans: QAFTransform(actor.plans)"
            raise ValueError(f"qaf answers other plans than the actor's, for {tasks}; {hint}")


def answers_of(qaf: Tensor, task_id: Tensor, number: Tensor | None, tables: PlanTables) -> tuple[Tensor, Tensor]:
    """Return ``qaf`` (..., S) and each row's place (...) int64 in the tables of plans that have S steps.

    Answers for more plans, of which some are longer, are cut to S if ``number``, their ``qaf_plan``, shows that the
    rows' plans are equal. A task without a plan, and the answers of other plans, are a :class:`ValueError`.
    """
    rows = tables.rows(one_per_row(task_id, qaf))
    tables.refuse_others(number, rows)
    steps = tables.mask.shape[-1]
    return (qaf[..., :steps] if number is not None and qaf.shape[-1] > steps else qaf), rows


class TaskTables(nn.Module, Generic[Tables]):
    """Tables, a named tuple of tensors (T, ...) with a row for each task, and their rows for a batch.

    They are buffers that follow the module to a device, keep their precision and are not saved. What a batch selected
    is kept for the next. ``problem`` is as for :meth:`TaskIndex.rows`.
    """

    def __init__(self, index: TaskIndex, tables: Tables, problem: str) -> None:
        super().__init__()
        self.index, self.problem, self._kind = index, problem, type(tables)
        for name, table in tables._asdict().items():  # type: ignore[attr-defined]
            self.register_buffer(name, table, persistent=False)
        self._moved: dict[_Kind, Tables] = {}
        self._last: tuple[Tensor, _Kind, Tables] | None = None

    def plain(self, *tensors: Tensor) -> bool:
        """Whether the tensors are plain, and the tables: a loss may give each member of an ensemble its own tables."""
        return plain(*tensors, next(iter(self._buffers.values())))  # type: ignore[arg-type]

    def select(self, task_id: Tensor, observation: Tensor) -> Tables:
        """The tables' rows (B, ...) for a batch of ids, (B,) int64; the observation gives them its device and dtype."""
        device, dtype = observation.device, observation.dtype
        if not self.plain(observation, task_id):
            return self._pick(self._to(device, dtype), task_id)
        kind = device, dtype, torch.is_inference_mode_enabled()  # autograd refuses what was made in inference mode
        looked_at = not waits(task_id)
        if self._last is not None and looked_at:
            ids, of, selected = self._last
            if of == kind and ids.device == task_id.device and torch.equal(ids, task_id):
                return selected
        if kind not in self._moved:
            self._moved[kind] = self._to(device, dtype)
        selected = self._pick(self._moved[kind], task_id)
        if looked_at and len(task_id) <= _KEPT_ROWS:
            self._last = (task_id.clone(), kind, selected)
        return selected

    def _to(self, device: torch.device, dtype: torch.dtype) -> Tables:
        tables = self.buffers(recurse=False)
        return self._kind(*(table.to(device, dtype if table.is_floating_point() else None) for table in tables))

    def _pick(self, tables: Tables, task_id: Tensor) -> Tables:
        rows = self.index.rows(task_id, self.problem)
        return self._kind(*(table.index_select(0, rows) for table in tables))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> TaskTables[Tables]:
        device = fn(torch.empty(0, dtype=torch.int64)).device  # which a cast of floats leaves alone
        self._moved, self._last = {}, None
        for name, table in self.named_buffers(recurse=False):
            setattr(self, name, table.to(device))
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_moved": {}, "_last": None}
