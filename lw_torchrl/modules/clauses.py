"""A plan's conditions as clauses in tensors: what each compares, and where in an observation its objects stand."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from lw_torchrl._checks import unknown_name
from lw_torchrl.language.observation import OBSERVATION_SIZE, OPENING
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.tasks import Task

NOTHING = OBSERVATION_SIZE
"""The index of a 0 that stands behind an observation's 39 numbers."""


class Clauses(NamedTuple):
    """Clauses (...,), of whatever tasks. Where its objects stand is the tasks' table's word, not an answer: the
    difference of a clause's two positions is ``observation[first] - observation[second] + shift``."""

    first: Tensor  # (..., 3) int64, indices into the observation and the 0 behind it
    second: Tensor  # (..., 3) int64
    shift: Tensor  # (..., 3) float32, metres
    predicate: Tensor  # (...) int64, its number in the list of predicates
    negated: Tensor  # (...) bool
    text: Tensor  # (...) int64, its number in the list of texts
    subject: Tensor  # (...) int64, its name's number in the list of names
    object: Tensor  # (...) int64, likewise; the number behind the last for none

    def pick(self, which: Tensor) -> Clauses:
        """Of (G,) clauses those of these numbers, (...) int64."""
        return Clauses(*(table[which] for table in self))


class PlanClauses(NamedTuple):
    """The clauses (T, C) of T tasks' plans, each once, and which of them make up each condition; the first eight
    are those of :class:`Clauses`."""

    first: Tensor
    second: Tensor
    shift: Tensor
    predicate: Tensor
    negated: Tensor
    text: Tensor
    subject: Tensor
    object: Tensor
    parts: Tensor  # (T, S, K) int64, which of its task's clauses
    said: Tensor  # (T, S, K) bool, those that there are

    @property
    def clauses(self) -> Clauses:
        return Clauses(*self[:8])


def _position(task: Task, name: str) -> tuple[list[int], list[float]]:
    """Where in an observation an object's three numbers stand, and what is added to them."""
    found = task.object(name)
    index = [at if isinstance(at, int) else NOTHING for at in found.position]
    fixed = [0.0 if isinstance(at, int) else at for at in found.position]
    return index, [one + offset for one, offset in zip(fixed, found.offset, strict=True)]


def _ends(clause: Clause, task: Task) -> tuple[list[int], list[int], list[float]]:
    nothing = [NOTHING] * 3
    if clause.predicate in ("open", "closed"):
        return [NOTHING, NOTHING, OPENING], nothing, [0.0] * 3
    first, shift = _position(task, clause.subject)
    if clause.object is None:
        return first, nothing, shift
    second, other = _position(task, clause.object)
    return first, second, [a - b for a, b in zip(shift, other, strict=True)]


def code_clauses(
    clauses: Sequence[tuple[Task, Clause]],
    predicates: Sequence[str],
    texts: Sequence[str] | None,
    names: Sequence[str] = (),
) -> Clauses:
    """Clauses as tensors, (G,).

    Args:
        clauses: each of a task.
        predicates: the list that ``predicate`` numbers; empty for none, and all are number 0.
        texts: the list that ``text`` numbers; None for none, and all are number 0.
        names: the list that ``subject`` and ``object`` number; empty for none, and all are number 0.

    Raises:
        ValueError: a predicate, or a thing's name, is none of the list.
    """
    number = {name: place for place, name in enumerate(predicates)}
    place = {} if texts is None else {text: where for where, text in enumerate(texts)}
    called = {name: where for where, name in enumerate(names)}
    for task, clause in clauses:
        if predicates and clause.predicate not in number:
            error = unknown_name(f"predicate of {str(clause)!r}, in {task.name}", clause.predicate, predicates)
            raise ValueError(f"{error}; an evaluator answers what it was made for: make and train one that has it")
        for thing in (clause.subject, clause.object):
            if names and thing is not None and thing not in called:
                error = unknown_name(f"thing in {str(clause)!r}, in {task.name}", thing, names)
                raise ValueError(f"{error}; an evaluator sees what it was made for: make and train one that has it")
    ends = [_ends(clause, task) for task, clause in clauses]
    return Clauses(
        first=torch.tensor([first for first, _, _ in ends]),
        second=torch.tensor([second for _, second, _ in ends]),
        shift=torch.tensor([shift for _, _, shift in ends], dtype=torch.float32),
        predicate=torch.tensor([number.get(clause.predicate, 0) for _, clause in clauses]),
        negated=torch.tensor([clause.negated for _, clause in clauses]),
        text=torch.tensor([place.get(str(clause), 0) for _, clause in clauses]),
        subject=torch.tensor([called.get(clause.subject, 0) for _, clause in clauses]),
        object=torch.tensor([called.get(clause.object or "", len(names)) for _, clause in clauses]),
    )


def texts_of(clauses: Iterable[tuple[Task, Clause]]) -> list[str]:
    """The different texts of clauses, sorted."""
    return sorted({str(clause) for _, clause in clauses})


def clauses_of(plans: Plans) -> list[tuple[Task, Clause]]:
    """All clauses of plans' conditions, each once in a task, task by task in the plans' order."""
    return [(plan.definition, clause) for plan in plans.values() for clause in _clauses_of(plan)]


def _clauses_of(plan: ConditionalPlan) -> list[Clause]:
    return list(dict.fromkeys(clause for step in plan.steps for clause in step.condition.clauses))


def code_plans(
    plans: Plans,
    tasks: Sequence[str],
    predicates: Sequence[str],
    texts: Sequence[str] | None,
    names: Sequence[str] = (),
) -> PlanClauses:
    """The clauses of plans as tensors, with a row for each of ``tasks``; errors as of :func:`code_clauses`."""
    listed = [_clauses_of(plans[task]) for task in tasks]
    flat = [(plans[task].definition, clause) for task, found in zip(tasks, listed, strict=True) for clause in found]
    most = max(map(len, listed))
    width = max(len({*step.condition.clauses}) for task in tasks for step in plans[task].steps)
    number = torch.zeros(len(tasks), most, dtype=torch.int64)
    parts = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.int64)
    said = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.bool)
    start = 0
    for row, (task, found) in enumerate(zip(tasks, listed, strict=True)):
        number[row, : len(found)] = torch.arange(start, start + len(found))
        start += len(found)
        for column, step in enumerate(plans[task].steps):
            own = [found.index(clause) for clause in dict.fromkeys(step.condition.clauses)]
            parts[row, column, : len(own)] = torch.tensor(own)
            said[row, column, : len(own)] = True
    return PlanClauses(*code_clauses(flat, predicates, texts, names).pick(number), parts, said)
