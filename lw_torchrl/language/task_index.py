"""Tables with a row for each task: from task ids to rows, and the tables of plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from lw_torchrl._util.devices import asserted, plain, readable, waits
from lw_torchrl.language.plans import Plans
from lw_torchrl.language.tasks import MT50

_Kind = tuple[torch.device, torch.dtype, bool]
_KEPT_ROWS = 4096  # the largest batch whose tables are kept for the next call
Tables = TypeVar("Tables", bound=tuple[Tensor, ...])


def one_per_row(task_id: Tensor, values: Tensor) -> Tensor:
    """Return task ids (...) int64 for rows of ``values`` (..., N); the ids may also be (..., 1)."""
    return task_id.squeeze(-1) if task_id.dim() == values.dim() and task_id.shape[-1] == 1 else task_id


def pick(table: Tensor, rows: Tensor) -> Tensor:
    """Return ``table[rows]``: (T, ...) and (B...) int64 to (B..., ...). It works in ``vmap`` too."""
    return table.index_select(0, rows.reshape(-1)).reshape((*rows.shape, *table.shape[1:]))


class TaskIndex:
    """The rows of tasks in a table, in the order of their ids; ``task_ids`` is as :attr:`Plans.task_ids`."""

    def __init__(self, task_ids: Mapping[str, int]) -> None:
        names: dict[int, str] = {}
        for name, number in task_ids.items():
            if number in names:
                raise ValueError(f"tasks {names[number]!r} and {name!r} have the same id; choose another name")
            names[number] = name
        self.tasks = tuple(names[number] for number in sorted(names))
        self._ids = torch.tensor([*sorted(names), -1])  # -1 is not an id; ids beyond the last find it

    def row(self, task: str) -> int:
        return self.tasks.index(task)

    def rows(self, task_id: Tensor, problem: str) -> Tensor:
        """Return the row of each task, (...) int64 to (...) int64.

        An id without a row is a ValueError that names the ``problem``, "tasks without a plan". It is a RuntimeError in
        compiled code and on a GPU. In ``vmap``, which cannot raise, the row is T, beyond the last one.
        """
        if task_id.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"task_id must be int64, got {task_id.dtype}")
        is_plain = plain(task_id)
        ids = self._ids.to(task_id.device)
        if plain(ids):  # in vmap too, where task_id is not plain
            self._ids = ids
        wanted = task_id.long().contiguous()
        if is_plain or asserted(task_id):
            rows = torch.searchsorted(ids[:-1], wanted)
        else:  # in vmap searchsorted warns about the memory layout
            rows = (wanted.unsqueeze(-1) > ids[:-1]).sum(-1)
        nearest = ids.index_select(0, rows.reshape(-1)).reshape(rows.shape)
        if is_plain and not waits(task_id):
            if torch.equal(nearest, wanted):
                return rows
            wrong = wanted[nearest != wanted].unique().tolist()[:5]
            names = (MT50[i] if 0 <= i < len(MT50) else f"{i} (none of the 50)" for i in wrong)
            raise ValueError(f"task_id names {problem}: {', '.join(names)}")
        if asserted(task_id):
            torch._assert_async((nearest == wanted).all(), f"task_id names {problem}")
        return torch.where(nearest == wanted, rows, len(self.tasks))


class PlanTables:
    """Tables of plans for transforms, attention and actors.

    Attributes:
        index: from task ids to rows, T of them.
        mask: (T, S) bool, true for steps, false for padding.
        turns: (T, 2, S) bool, the plan's own steps, then its fallback steps (its own again if it has none).
        skill_index: (T, S) int64, the index of each step's skill in ``plans.skills``; 0 for padding.
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
        """Return the row of each task, (...) int64 to (...) int64; raise :class:`ValueError` for tasks without one."""
        return self.index.rows(task_id, self._problem)

    def refuse_others(self, number: Tensor | None, rows: Tensor) -> None:
        """Raise :class:`ValueError` if queries of plans other than those of ``rows``, (...) int64, were answered.

        ``number``, (...) int64, is the number of the answered plan, 0 if it is unknown; None if all are unknown.
        """
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
    """Return ``qaf`` (..., S) and the row of each task, (...) int64, in the tables of plans with S steps.

    ``qaf`` may have been answered for more plans, some of them longer. It is cut to S if ``number``, its ``qaf_plan``,
    shows that the rows' plans are equal. A task without a plan, or with another plan, is a :class:`ValueError`.
    """
    rows = tables.rows(one_per_row(task_id, qaf))
    tables.refuse_others(number, rows)
    steps = tables.mask.shape[-1]
    return (qaf[..., :steps] if number is not None and qaf.shape[-1] > steps else qaf), rows


class TaskTables(nn.Module, Generic[Tables]):
    """A named tuple of tables (T, ...) with a row for each task, and the selection of rows for a batch.

    The tables are buffers that follow the module to a device, keep their precision and are not saved. The rows of the
    last batch are kept, since the next one often has the same tasks. ``problem`` is as for :meth:`TaskIndex.rows`.
    """

    def __init__(self, index: TaskIndex, tables: Tables, problem: str) -> None:
        super().__init__()
        self.index, self.problem, self._kind = index, problem, type(tables)
        for name, table in tables._asdict().items():  # type: ignore[attr-defined]
            self.register_buffer(name, table, persistent=False)
        self._moved: dict[_Kind, Tables] = {}
        self._last: tuple[Tensor, _Kind, Tables] | None = None

    def plain(self, *tensors: Tensor) -> bool:
        """Return whether the tensors and the tables are plain: a loss may give each ensemble member its own tables."""
        return plain(*tensors, next(iter(self._buffers.values())))  # type: ignore[arg-type]

    def select(self, task_id: Tensor, observation: Tensor) -> Tables:
        """Return the rows (B, ...) for task ids (B,) int64, on the observation's device and with its dtype."""
        device, dtype = observation.device, observation.dtype
        if not self.plain(observation, task_id):
            return self._pick(self._to(device, dtype), task_id)
        kind = device, dtype, torch.is_inference_mode_enabled()  # autograd refuses tensors made in inference mode
        is_compared = not waits(task_id)
        if self._last is not None and is_compared:
            ids, last_kind, selected = self._last
            if last_kind == kind and ids.device == task_id.device and torch.equal(ids, task_id):
                return selected
        if kind not in self._moved:
            self._moved[kind] = self._to(device, dtype)
        selected = self._pick(self._moved[kind], task_id)
        if is_compared and len(task_id) <= _KEPT_ROWS:
            self._last = (task_id.clone(), kind, selected)
        return selected

    def _to(self, device: torch.device, dtype: torch.dtype) -> Tables:
        tables = self.buffers(recurse=False)
        return self._kind(*(table.to(device, dtype if table.is_floating_point() else None) for table in tables))

    def _pick(self, tables: Tables, task_id: Tensor) -> Tables:
        rows = self.index.rows(task_id, self.problem)
        return self._kind(*(table.index_select(0, rows) for table in tables))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> TaskTables[Tables]:
        device = fn(torch.empty(0, dtype=torch.int64)).device  # an integer, which a cast to half precision ignores
        self._moved, self._last = {}, None
        for name, table in self.named_buffers(recurse=False):
            setattr(self, name, table.to(device))
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_moved": {}, "_last": None}
