"""StateQueryEvaluator: a network that answers plans' conditions from the observation."""

from __future__ import annotations

from collections.abc import Sequence
from math import sqrt
from typing import ClassVar, NamedTuple

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from lw_torchrl._util.checks import Count, check_value, shown, typed, unknown_name
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES, STATES
from lw_torchrl.language.task_index import TaskIndex, TaskTables
from lw_torchrl.language.tasks import Task
from lw_torchrl.modules.features import check_observation
from lw_torchrl.modules.query_evaluator import Answers, QueryEvaluator

_PADDING = -1e4  # as QueryProgram.logits has it


class Clauses(NamedTuple):
    """Clauses (...,) of any tasks. A clause compares two positions of an observation, whose difference is
    ``observation[first] - observation[second] + shift``."""

    first: Tensor  # (..., 3) int64, indices into the observation; one beyond its end stands for 0
    second: Tensor  # (..., 3) int64
    shift: Tensor  # (..., 3) float32, metres
    predicate: Tensor  # (...) int64, an index into the list of predicates
    negated: Tensor  # (...) bool
    subject: Tensor  # (...) int64, an index into the list of names
    object: Tensor  # (...) int64, likewise; beyond the last for a clause without an object
    # Only of the plans of T tasks, each of whose clauses (T, C) is listed once:
    parts: Tensor = torch.empty(0)  # (T, S, K) int64, which of its task's clauses make up each condition
    mask: Tensor = torch.empty(0)  # (T, S, K) bool, true where there is such a clause

    def pick(self, which: Tensor) -> Clauses:
        """Select from (G,) clauses by their indices, (...) int64."""
        return Clauses(*(table[which] for table in self[:7]))


def conjunction(logits: Tensor, mask: Tensor) -> Tensor:
    """Return the logit (...) that all statements with logits (..., K) hold, where ``mask`` (..., K) bool is true.

    The statements are taken as independent, so their probabilities sigmoid(l) multiply to p, and the logit of p is
    -log(expm1(sum(softplus(-l)))). Logits are at most 30 in size; without any statement the result is 30.
    """
    doubt = torch.where(mask, nn.functional.softplus(-logits), 0.0).sum(-1).clamp(min=1e-13)
    return -(doubt + torch.log(-torch.expm1(-doubt)))


class ClauseEvaluator(QueryEvaluator):
    """Answers conditions by a network that was trained on the answers of the query answering function.

    Reads a view of a state and ``task_id``; writes as :class:`QueryEvaluator`, -1e4 beyond a plan's last step. Clauses
    are answered one by one and combined by :func:`conjunction`. A subclass sets ``network``, from views of B states and
    their clauses (B, C) to logits (B, C), and ``seen_dims``, the number of dimensions of a view.

    Args:
        plans, answers: as for :class:`QueryEvaluator`.
        predicates: the relations and predicates that it can answer; None for all.
        names: the objects that it can tell apart; None if it does not tell them apart by name.

    Raises:
        ValueError: a plan uses another predicate or object; at call time, a wrong shape, or a task_id without a plan.
    """

    network: nn.Module
    seen_dims: ClassVar[int] = 1

    def __init__(
        self,
        plans: Plans,
        *,
        answers: Answers = "soft",
        predicates: Sequence[str] | None = None,
        names: Sequence[str] | None = None,
    ) -> None:
        super().__init__(plans, answers=answers)
        self.predicates = _different("predicates", sorted(PREDICATES) if predicates is None else predicates)
        self.names = () if names is None else _different("names", names)
        self.config |= {"predicates": list(self.predicates)}
        index = TaskIndex(plans.task_ids)
        tables = _plan_clauses(plans, index.tasks, self.predicates, self.names)
        self.tables: TaskTables[Clauses] = TaskTables(index, tables, f"tasks without a plan in {plans!r}")

    def check_seen(self, seen: Tensor) -> None:
        """Raise :class:`ValueError` unless the view has the shape and dtype that the network reads."""
        raise NotImplementedError(f"{type(self).__name__} must override check_seen")

    def logits(self, *read: Tensor) -> Tensor:
        """Return (..., S) float32 from views (..., ...) and task_id (...) int64."""
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
        logits = torch.where(tables.mask.any(-1), conjunction(parts, tables.mask), _PADDING)
        return logits.reshape(*task_id.shape, self.plans.num_steps)

    def code(self, clauses: Sequence[tuple[Task, Clause]]) -> Clauses:
        """Return clauses (G,) of any tasks as tensors for the network."""
        return _as_tensors(clauses, self.predicates, self.names)


def _different(argument: str, given: Sequence[str]) -> tuple[str, ...]:
    if isinstance(given, str) or not given or len({*given}) < len(given):
        raise ValueError(f"{argument} must be different names, at least one, got {shown(given)}")
    return tuple(given)


def _position(task: Task, name: str) -> tuple[list[int], list[float]]:
    """Return the indices of an object's three coordinates in an observation, and what is added to them."""
    thing = task.object(name)
    index = [at if isinstance(at, int) else task.layout.size for at in thing.position]
    fixed = [0.0 if isinstance(at, int) else at for at in thing.position]
    return index, [value + offset for value, offset in zip(fixed, thing.offset, strict=True)]


def _ends(clause: Clause, task: Task) -> tuple[list[int], list[int], list[float]]:
    zeros = [task.layout.size] * 3
    if clause.predicate in STATES:
        return [*zeros[:2], task.openings[clause.subject]], zeros, [0.0] * 3
    first, shift = _position(task, clause.subject)
    if clause.object is None:
        return first, zeros, shift
    second, other = _position(task, clause.object)
    return first, second, [a - b for a, b in zip(shift, other, strict=True)]


def _as_tensors(clauses: Sequence[tuple[Task, Clause]], predicates: Sequence[str], names: Sequence[str]) -> Clauses:
    """Return clauses of tasks as tensors, (G,). Without ``names`` every object has index 0."""
    predicate, place = ({name: at for at, name in enumerate(known)} for known in (predicates, names))
    for task, clause in clauses:
        if clause.predicate not in predicate:
            error = unknown_name(f"predicate of {str(clause)!r}, in {task.name}", clause.predicate, predicates)
            raise ValueError(f"{error}; make and train an evaluator that has this predicate")
        for thing in (clause.subject, clause.object):
            if names and thing is not None and thing not in place:
                error = unknown_name(f"thing in {str(clause)!r}, in {task.name}", thing, names)
                raise ValueError(f"{error}; make and train an evaluator that has this object")
    first, second, shift = zip(*(_ends(clause, task) for task, clause in clauses), strict=True)
    return Clauses(
        first=torch.tensor(first),
        second=torch.tensor(second),
        shift=torch.tensor(shift, dtype=torch.float32),
        predicate=torch.tensor([predicate[clause.predicate] for _, clause in clauses]),
        negated=torch.tensor([clause.negated for _, clause in clauses]),
        subject=torch.tensor([place.get(clause.subject, 0) for _, clause in clauses]),
        object=torch.tensor([place.get(clause.object or "", len(names)) for _, clause in clauses]),
    )


def _clauses_of(plan: ConditionalPlan) -> list[Clause]:
    return list(dict.fromkeys(clause for step in plan.steps for clause in step.condition.clauses))


def _plan_clauses(plans: Plans, tasks: Sequence[str], predicates: Sequence[str], names: Sequence[str]) -> Clauses:
    """Return the clauses of plans as tensors, with a row for each of ``tasks``; errors as of :func:`_as_tensors`."""
    listed = [_clauses_of(plans[task]) for task in tasks]
    flat = [(plans[task].definition, clause) for task, own in zip(tasks, listed, strict=True) for clause in own]
    width = max(len({*step.condition.clauses}) for task in tasks for step in plans[task].steps)
    number = torch.zeros(len(tasks), max(map(len, listed)), dtype=torch.int64)
    parts = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.int64)
    mask = torch.zeros(len(tasks), plans.num_steps, width, dtype=torch.bool)
    start = 0
    for row, (task, own) in enumerate(zip(tasks, listed, strict=True)):
        number[row, : len(own)] = torch.arange(start, start + len(own))
        start += len(own)
        for column, step in enumerate(plans[task].steps):
            which = [own.index(clause) for clause in dict.fromkeys(step.condition.clauses)]
            parts[row, column, : len(which)] = torch.tensor(which)
            mask[row, column, : len(which)] = True
    return _as_tensors(flat, predicates, names).pick(number)._replace(parts=parts, mask=mask)


LARGEST_LOGIT = 30.0
"""The size of the largest logit of a clause, a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: the scales at which tanh squashes a difference


class ClauseNetwork(nn.Module):
    """The logit of a clause: a trunk reads the difference of two positions, and a learned vector of the predicate
    weighs its output. "not" changes the sign."""

    numbers: int = 3  # of a difference

    def __init__(self, width: int, depth: int, *, predicates: int) -> None:
        super().__init__()
        check_value("width", width, Count)
        check_value("depth", depth, Count)
        self.width = width
        self.trunk = MLP(
            in_features=self.numbers * len(_SCALES),
            out_features=width,
            num_cells=[width] * (depth - 1),
            activation_class=nn.ReLU,
            activate_last_layer=True,
        )
        self.predicates = nn.Embedding(predicates, width + 1)

    def forward(self, observation: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, C) of size 30 at most from observations (B, 39) and clauses (B, C)."""
        numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
        first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
        d = (first - second).unflatten(-1, (-1, 3)) + clauses.shift
        return self.judge(d, clauses)

    def judge(self, d: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, C) from differences d (B, C, 3) in metres."""
        asked = self.predicates.weight[clauses.predicate]
        features = torch.cat([torch.tanh(d / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(asked.dtype)) * asked[..., :-1]).sum(-1) / sqrt(self.width) + asked[..., -1]
        return torch.where(clauses.negated, -logits, logits).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)


class StateQueryEvaluator(ClauseEvaluator):
    """Answers conditions from the observation, by a network that was trained on exact answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` and ``qaf_logits`` (B, S) float32
    as :class:`QueryEvaluator` does. It looks objects' positions up in the observation, so it only learns what
    predicates mean.

    Args:
        plans, answers, predicates: as for :class:`~lw_torchrl.modules.state_query_evaluator.ClauseEvaluator`, with its
            errors and source.
        width, depth: hidden layers.

    Example:
        >>> import lw_torchrl as lw
        >>> from tensordict.nn import TensorDictSequential
        >>> plans = lw.load_plans("MT10")
        >>> policy = TensorDictSequential(StateQueryEvaluator(plans), lw.PlanConditionedActor(plans))
        >>> policy(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])
    """

    network: ClauseNetwork

    @typed
    def __init__(
        self,
        plans: Plans,
        *,
        width: int = 128,
        depth: int = 3,
        answers: Answers = "soft",
        predicates: Sequence[str] | None = None,
    ) -> None:
        super().__init__(plans, answers=answers, predicates=predicates)
        self.network = ClauseNetwork(width, depth, predicates=len(self.predicates))
        self.config |= {"width": width, "depth": depth}

    def check_seen(self, seen: Tensor) -> None:
        check_observation(seen, self.plans.layout)
