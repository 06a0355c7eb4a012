"""ClauseEvaluator: answers conditions by a network, clause by clause; and plans' clauses as tensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn

from lw_torchrl._checks import shown, unknown_name
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES, STATES
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.query_evaluator import QueryEvaluator

_PADDING = -1e4  # as QueryProgram.logits has it


class Clauses(NamedTuple):
    """Clauses (...,), of whatever tasks. The tasks' table says where the objects stand, the answer does not: the
    difference of a clause's two positions is ``observation[first] - observation[second] + shift``."""

    first: Tensor  # (..., 3) int64, indices into the observation and the 0 behind it
    second: Tensor  # (..., 3) int64
    shift: Tensor  # (..., 3) float32, metres
    predicate: Tensor  # (...) int64, its number in the list of predicates
    negated: Tensor  # (...) bool
    subject: Tensor  # (...) int64, its name's number in the list of names
    object: Tensor  # (...) int64, likewise; the number behind the last for none
    # Of T tasks' plans alone, whose clauses (T, C) come once each:
    parts: Tensor = torch.empty(0)  # (T, S, K) int64, which of its task's clauses make up each condition
    mask: Tensor = torch.empty(0)  # (T, S, K) bool, the parts that there are

    def pick(self, which: Tensor) -> Clauses:
        """Of (G,) clauses those of these numbers, (...) int64."""
        return Clauses(*(table[which] for table in self[:7]))

    def to(self, device: torch.device) -> Clauses:
        return Clauses(*(table.to(device, non_blocking=True) for table in self))


def conjunction(logits: Tensor, mask: Tensor) -> Tensor:
    """The logit (...) of all of some statements, of logits (..., K) of size 30 at most, where ``mask`` (..., K) bool is
    true; of none it is 30. Of independent statements the probabilities sigmoid(l) have the product p, whose logit
    log(p / (1 - p)) is -log(expm1(sum(softplus(-l)))): of several sure ones nearly the least."""
    doubt = torch.where(mask, nn.functional.softplus(-logits), 0.0).sum(-1).clamp(min=1e-13)
    return -(doubt + torch.log(-torch.expm1(-doubt)))


class ClauseEvaluator(QueryEvaluator):
    """Answers conditions by a network that was trained on the query answering function's answers, and never asks it.

    Reads what is seen of a state and ``task_id`` (B,) int64; writes ``qaf_logits`` (B, S) float32, positive where a
    condition of the row's plan holds, -1e4 beyond its last step. A condition's clauses are answered one by one, and put
    together as :func:`conjunction` says. A subclass gives ``network``, from what is seen of B states and their clauses
    (B, C) to logits (B, C), and in ``seen_dims`` how many dimensions a state has.

    Args:
        plans: whose conditions it answers.
        predicates, names: the relations and predicates, and the things, that it can tell; None for all predicates, and
            for no names where things are not told apart by name.

    Raises:
        ValueError: a plan asks for what it cannot tell; at call time, another shape, or a task_id without a plan.

    Source: paper section 'Differentiability and Optimization', which names a visual question answering model.
    """

    network: nn.Module
    seen_dims: ClassVar[int] = 1

    def __init__(
        self, plans: Plans, *, predicates: Sequence[str] | None = None, names: Sequence[str] | None = None
    ) -> None:
        super().__init__(plans)
        self.predicates = _different("predicates", sorted(PREDICATES) if predicates is None else predicates)
        self.names = () if names is None else _different("names", names)
        self.config = {"predicates": list(self.predicates)}
        index = TaskIndex(plans.task_ids)
        tables = _plan_clauses(plans, index.tasks, self.predicates, self.names)
        self.tables: TaskTables[Clauses] = TaskTables(index, tables, f"tasks without a plan in {plans!r}")

    def check_seen(self, seen: Tensor) -> None:
        """Raise :class:`ValueError` unless it is what the network was made for."""
        raise NotImplementedError(f"{type(self).__name__} must override check_seen")

    def logits(self, *read: Tensor) -> Tensor:
        """What is seen (..., ...) and task_id (...) int64 to (..., S) float32."""
        seen, task_id = read
        self.check_seen(seen)
        shape = seen.shape[: -self.seen_dims]
        if task_id.shape != shape:
            each = f"one for each row of {self.in_keys[0]!r}"
            raise ValueError(f"task_id must be of shape {tuple(shape)}, {each}, got {tuple(task_id.shape)}")
        rows = seen.reshape(-1, *seen.shape[-self.seen_dims :])
        tables = self.tables.select(task_id.reshape(-1), rows)
        clauses = self.network(rows, tables)
        parts = clauses.gather(-1, tables.parts.flatten(1)).reshape(tables.parts.shape)
        found = torch.where(tables.mask.any(-1), conjunction(parts, tables.mask), _PADDING)
        return found.reshape(*task_id.shape, self.plans.num_steps)

    def code(self, clauses: Sequence[tuple[Task, Clause]]) -> Clauses:
        """Return any clauses of tasks as tensors, (G,), for the network."""
        return _as_tensors(clauses, self.predicates, self.names)


def _different(argument: str, given: Sequence[str]) -> tuple[str, ...]:
    if isinstance(given, str) or not given or len({*given}) < len(given):
        raise ValueError(f"{argument} must be different names, at least one, got {shown(given)}")
    return tuple(given)


def _position(task: Task, name: str) -> tuple[list[int], list[float]]:
    """Where in an observation an object's three numbers stand, and what is added to them."""
    found = task.object(name)
    nothing = task.layout.size  # the index of a 0 that stands behind an observation's numbers
    index = [at if isinstance(at, int) else nothing for at in found.position]
    fixed = [0.0 if isinstance(at, int) else at for at in found.position]
    return index, [one + offset for one, offset in zip(fixed, found.offset, strict=True)]


def _ends(clause: Clause, task: Task) -> tuple[list[int], list[int], list[float]]:
    nothing = [task.layout.size] * 3
    if clause.predicate in STATES:
        return [*nothing[:2], task.openings[clause.subject]], nothing, [0.0] * 3
    first, shift = _position(task, clause.subject)
    if clause.object is None:
        return first, nothing, shift
    second, other = _position(task, clause.object)
    return first, second, [a - b for a, b in zip(shift, other, strict=True)]


def _as_tensors(clauses: Sequence[tuple[Task, Clause]], predicates: Sequence[str], names: Sequence[str]) -> Clauses:
    """Return clauses of tasks as tensors, (G,); without ``names`` all things are number 0."""
    predicate, place = ({name: at for at, name in enumerate(those)} for those in (predicates, names))
    for task, clause in clauses:
        if clause.predicate not in predicate:
            error = unknown_name(f"predicate of {str(clause)!r}, in {task.name}", clause.predicate, predicates)
            raise ValueError(f"{error}; an evaluator answers what it was made for: make and train one that has it")
        for thing in (clause.subject, clause.object):
            if names and thing is not None and thing not in place:
                error = unknown_name(f"thing in {str(clause)!r}, in {task.name}", thing, names)
                raise ValueError(f"{error}; an evaluator sees what it was made for: make and train one that has it")
    ends = [_ends(clause, task) for task, clause in clauses]
    return Clauses(
        first=torch.tensor([first for first, _, _ in ends]),
        second=torch.tensor([second for _, second, _ in ends]),
        shift=torch.tensor([shift for _, _, shift in ends], dtype=torch.float32),
        predicate=torch.tensor([predicate[clause.predicate] for _, clause in clauses]),
        negated=torch.tensor([clause.negated for _, clause in clauses]),
        subject=torch.tensor([place.get(clause.subject, 0) for _, clause in clauses]),
        object=torch.tensor([place.get(clause.object or "", len(names)) for _, clause in clauses]),
    )


def _of(plan: ConditionalPlan) -> list[Clause]:
    return list(dict.fromkeys(clause for step in plan.steps for clause in step.condition.clauses))


def _plan_clauses(plans: Plans, tasks: Sequence[str], predicates: Sequence[str], names: Sequence[str]) -> Clauses:
    """The clauses of plans as tensors, with a row for each of ``tasks``; errors as of :func:`_as_tensors`."""
    listed = [_of(plans[task]) for task in tasks]
    flat = [(plans[task].definition, clause) for task, found in zip(tasks, listed, strict=True) for clause in found]
    width = max(len({*step.condition.clauses}) for task in tasks for step in plans[task].steps)
    number = torch.zeros(len(tasks), max(map(len, listed)), dtype=torch.int64)
    parts = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.int64)
    mask = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.bool)
    start = 0
    for row, (task, found) in enumerate(zip(tasks, listed, strict=True)):
        number[row, : len(found)] = torch.arange(start, start + len(found))
        start += len(found)
        for column, step in enumerate(plans[task].steps):
            own = [found.index(clause) for clause in dict.fromkeys(step.condition.clauses)]
            parts[row, column, : len(own)] = torch.tensor(own)
            mask[row, column, : len(own)] = True
    return _as_tensors(flat, predicates, names).pick(number)._replace(parts=parts, mask=mask)
