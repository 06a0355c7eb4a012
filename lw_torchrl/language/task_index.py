"""Tables with one row per task: the mapping from task ids to rows, and the tables of plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import torch
from torch import Tensor, nn

from lw_torchrl._util.devices import asserted, plain, readable, waits

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans, Plans

_Kind = tuple[torch.device, torch.dtype, bool]
_KEPT_ROWS = 4096  # maximum batch size for which the selected rows are cached
Tables = TypeVar("Tables", bound=tuple[Tensor, ...])


def as_plans(plans: AnyPlans, argument: str = "plans") -> Plans:
    """Convert a mapping to :class:`Plans`. Importing this function does not import the parsers of plans."""
    from lw_torchrl.language.plans import as_plans as convert  # here, so that modules of policies import no parser

    return convert(plans, argument)


def one_per_row(task_id: Tensor, values: Tensor) -> Tensor:
    """Return task ids (...) with the batch shape of ``values`` (..., N), squeezed from (..., 1) if necessary."""
    return task_id.squeeze(-1) if task_id.dim() == values.dim() and task_id.shape[-1] == 1 else task_id


def pick(table: Tensor, rows: Tensor) -> Tensor:
    """Return ``table[rows]`` (B..., ...) for a table (T, ...) and rows (B...) int64; this also works in ``vmap``."""
    return table.index_select(0, rows.reshape(-1)).reshape((*rows.shape, *table.shape[1:]))


class TaskIndex:
    """An index from task ids to table rows, which are in the order of the ids; ``task_ids`` maps names to ids."""

    def __init__(self, task_ids: Mapping[str, int]) -> None:
        names: dict[int, str] = {}
        for name, number in task_ids.items():
            if number in names:
                raise ValueError(f"tasks {names[number]!r} and {name!r} have the same id, {number}; rename one of them")
            names[number] = name
        self.tasks = tuple(names[number] for number in sorted(names))
        self._ids = torch.tensor([*sorted(names), -1])  # -1 is never an id and ends the table

    def row(self, task: str) -> int:
        """Return the row of a task's name."""
        return self.tasks.index(task)

    def rows(self, task_id: Tensor, problem: str) -> Tensor:
        """Map task ids (...) int64 to rows (...) int64.

        An id without a row raises a ValueError that states the ``problem``, such as "tasks without a plan", or a
        RuntimeError in compiled code and on a GPU. In ``vmap``, which cannot raise, such an id has row T, past the end.
        """
        if task_id.dtype not in (torch.int64, torch.int32):
            raise ValueError(f"task_id must be int64, got {task_id.dtype}")
        is_plain = plain(task_id)
        ids = self._ids.to(task_id.device)
        if plain(ids):  # also true in vmap, where task_id is not plain
            self._ids = ids
        wanted = task_id.long().contiguous()
        if is_plain or asserted(task_id):
            rows = torch.searchsorted(ids[:-1], wanted)
        else:  # in vmap, searchsorted would warn about the memory layout
            rows = (wanted.unsqueeze(-1) > ids[:-1]).sum(-1)
        nearest = ids.index_select(0, rows.reshape(-1)).reshape(rows.shape)
        if is_plain and not waits(task_id):
            if torch.equal(nearest, wanted):
                return rows
            wrong = wanted[nearest != wanted].unique().tolist()[:5]
            from lw_torchrl.language.tasks import MT50

            names = (MT50[i] if 0 <= i < len(MT50) else f"{i} (not a Meta-World task)" for i in wrong)
            raise ValueError(f"task_id contains {problem}: {', '.join(names)}")
        if asserted(task_id):
            torch._assert_async((nearest == wanted).all(), f"task_id contains {problem}")
        return torch.where(nearest == wanted, rows, len(self.tasks))


class PlanTables:
    """Plans as tensors with one row per task, for transforms, attention and actors.

    Attributes:
        index: the index from task ids to the T rows.
        mask: (T, S) bool, true for plan steps, false for padding.
        turns: (T, 6, S) bool, masks of the steps that a policy may choose in each turn of a cycle: (1) the plan's
            own steps, (2) the fallback steps that release the object, (3) the fallback steps with the first motion, and
            then (1) and (2) again, followed by the fallback steps with the second motion. Without a fallback, each turn
            has all steps.
        skill_index: (T, S) int64, the index of each plan step's skill in ``plans.skills``; 0 for padding.
        number: (T,) int64, the number of each plan, as in :attr:`Plans.numbers`.
    """

    def __init__(self, plans: Plans) -> None:
        self.index = TaskIndex(plans.task_ids)
        self._problem = f"tasks without a plan in {plans!r}"
        self.mask = torch.zeros(len(plans), plans.num_steps, dtype=torch.bool)
        self.turns = torch.zeros(len(plans), 6, plans.num_steps, dtype=torch.bool)
        self.skill_index = torch.zeros(len(plans), plans.num_steps, dtype=torch.int64)
        skill = {text: number for number, text in enumerate(plans.skills)}
        for row, task in enumerate(self.index.tasks):
            steps = plans[task].steps
            self.mask[row, : len(steps)] = True
            back = {n: step.role.verb for n, step in enumerate(steps) if step.role is not None and step.role.fallback}
            own = [n for n in range(len(steps)) if n not in back]
            let_go = [n for n, verb in back.items() if verb in ("approach", "reach")]
            motions = [n for n, verb in back.items() if verb in ("carry", "move")]  # one motion in old files
            first, second = ([n for n in back if n not in other] for other in (motions[1:], motions[:-1]))
            for turn, active in enumerate((own, let_go, first, own, let_go, second)):
                self.turns[row, turn, active or own] = True
            self.skill_index[row, : len(steps)] = torch.tensor([skill[step.skill] for step in steps])
        numbers = plans.numbers
        self.number = torch.tensor([numbers[task] for task in self.index.tasks])

    def rows(self, task_id: Tensor) -> Tensor:
        """Map task ids (...) int64 to rows (...) int64; raise ValueError for tasks without a plan."""
        return self.index.rows(task_id, self._problem)

    def refuse_others(self, number: Tensor | None, rows: Tensor) -> None:
        """Raise a ValueError if ``qaf`` was computed for plans other than the plans in ``rows`` (...) int64.

        ``number`` (...) int64 is the number of the plan behind ``qaf`` (0 if unknown); None if all are unknown.
        """
        if number is None:
            return
        numbers = self.number.to(number.device)
        if numbers is not self.number and plain(numbers):
            self.number = numbers
        if asserted(number, rows):
            own = numbers[rows]
            torch._assert_async(
                ((own == number) | (number == 0)).all(), "qaf was computed with plans other than the actor's"
            )
        if not readable(number, rows):
            return
        own = numbers[rows]
        if not torch.equal(own, number) and (wrong := (own != number) & (number != 0)).any():
            tasks = ", ".join(self.index.tasks[row] for row in rows[wrong].unique().tolist()[:5])
            hint = "pass the actor's plans to the transform: QAFTransform(actor.plans)"
            raise ValueError(f"qaf was computed with plans that differ from the actor's plans for {tasks}; {hint}")


def answers_of(qaf: Tensor, task_id: Tensor, number: Tensor | None, tables: PlanTables) -> tuple[Tensor, Tensor]:
    """Return ``qaf`` (..., S), and each task's row (...) int64 in ``tables`` of plans with S steps.

    ``qaf`` may be longer than S if it was computed for a larger set of plans. It is cut to S if ``number`` (the
    ``qaf_plan``) shows that each task has the same plan in both sets. Raise a ValueError if a task has no plan or a
    different one.
    """
    rows = tables.rows(one_per_row(task_id, qaf))
    tables.refuse_others(number, rows)
    steps = tables.mask.shape[-1]
    return (qaf[..., :steps] if number is not None and qaf.shape[-1] > steps else qaf), rows


class TaskTables(nn.Module, Generic[Tables]):
    """A module that holds a named tuple of tables (T, ...), one row per task, and selects the rows for a batch.

    The tables are buffers that move with the module, keep their precision and are not saved. The rows of the last batch
    are cached, since the next batch often has the same tasks. ``problem`` is as for :meth:`TaskIndex.rows`.
    """

    def __init__(self, index: TaskIndex, tables: Tables, problem: str) -> None:
        super().__init__()
        self.index, self.problem, self._kind = index, problem, type(tables)
        for name, table in tables._asdict().items():  # type: ignore[attr-defined]
            self.register_buffer(name, table, persistent=False)
        self._moved: dict[_Kind, Tables] = {}
        self._last: tuple[Tensor, _Kind, Tables] | None = None

    def plain(self, *tensors: Tensor) -> bool:
        """Return whether the tensors and the tables have concrete values, unlike in ``vmap`` or while compiling."""
        return plain(*tensors, next(iter(self._buffers.values())))  # type: ignore[arg-type]

    def select(self, task_id: Tensor, observation: Tensor) -> Tables:
        """Return the tables' rows (B, ...) for task ids (B,) int64, on the observation's device and in its dtype."""
        device, dtype = observation.device, observation.dtype
        if not self.plain(observation, task_id):
            return self._pick(self._to(device, dtype), task_id)
        kind = device, dtype, torch.is_inference_mode_enabled()  # autograd rejects tensors created in inference mode
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
        device = fn(torch.empty(0, dtype=torch.int64)).device  # an integer is exempt from dtype casts
        self._moved, self._last = {}, None
        for name, table in self.named_buffers(recurse=False):
            setattr(self, name, table.to(device))
        return self

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_moved": {}, "_last": None}
