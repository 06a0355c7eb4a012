"""Query evaluators: modules in front of a policy that answer the plans' conditions instead of the exact function."""

from __future__ import annotations

from collections.abc import Sequence
from inspect import signature
from math import sqrt
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import Transform
from torchrl.modules import MLP

from lw_torchrl._util.checks import Count, check_choice, shown, typed, unknown_name
from lw_torchrl._util.keys import dispatched, key_beside, read, write
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES, STATES
from lw_torchrl.language.task_index import PlanTables, TaskIndex, TaskTables, pick
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.features import check_observation

Answers = Literal["soft", "hard"]


class QueryEvaluator(TensorDictModuleBase):
    """Base class of modules that answer plans' conditions for a policy: ``TensorDictSequential(evaluator, actor)``.

    Training the sequence trains both. A subclass implements :meth:`logits`, and adds the keyword arguments that rebuild
    it to ``config``.

    Reads ``in_keys``, by default ``observation`` (B, 39) float32 and ``task_id`` (B,) int64. Writes ``qaf_logits``
    (B, S) float32, positive where a condition of the row's plan holds, in the order of its steps, and ``qaf`` (B, S)
    float32 in [0, 1], which the policy reads.

    Args:
        plans: the plans whose conditions it answers.
        answers: "soft": ``qaf`` is the probability, the sigmoid of the logit. "hard": ``qaf`` is 1 where the logit is
            positive and 0 elsewhere, with the gradient of "soft"; for a policy that was trained on exact answers. A
            subclass with a constructor of its own must accept ``answers`` to be "hard".

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict.nn import TensorDictSequential
        >>> class Guess(QueryEvaluator):
        ...     def logits(self, observation, task_id):
        ...         return torch.zeros(*task_id.shape, self.plans.num_steps)
        >>> plans = lw.load_plans("MT10")
        >>> policy = TensorDictSequential(Guess(plans), lw.PlanConditionedActor(plans))
        >>> policy.in_keys
        ['observation', 'task_id']

    Source: paper section 'Differentiability and Optimization', which names a visual question answering model.
    """

    text_encoder: TextEncoder | None = None
    plan_number: Tensor

    @typed
    def __init__(self, plans: Plans, *, answers: Answers = "soft") -> None:
        super().__init__()
        self.plans, self.tasks, self.layout = plans, tuple(plans), plans.layout
        self.config, self.answers = {}, answers
        self.plan_tables = PlanTables(plans)
        self.register_buffer("plan_number", self.plan_tables.number, persistent=False)
        self.in_keys: list[NestedKey] = ["observation", "task_id"]
        self.out_keys: list[NestedKey] = ["qaf", "qaf_logits"]

    @property
    def _accepts_answers(self) -> bool:
        parameters = signature(type(self)).parameters.values()
        return any(each.name == "answers" or each.kind is each.VAR_KEYWORD for each in parameters)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that rebuild it, as JSON."""
        return {**self._config, "answers": self.answers} if self._accepts_answers else self._config

    @config.setter
    def config(self, config: dict[str, Any]) -> None:
        self._config = config

    @property
    def answers(self) -> Answers:
        """Whether ``qaf`` is "soft" or "hard"; it can be set."""
        return self._answers

    @answers.setter
    def answers(self, answers: Answers) -> None:
        self._answers: Answers = check_choice("answers", answers, ("soft", "hard"))
        if answers != "soft" and not self._accepts_answers:  # a file would lose it
            raise TypeError(f"the constructor of {type(self).__name__} must accept answers=, got answers={answers!r}")

    def logits(self, *read: Any, **_: Any) -> Tensor:  # a subclass may have any signature
        """Return (B, S) float32 from the tensors of ``in_keys``."""
        raise NotImplementedError(f"{type(self).__name__} must override logits")

    def logits_of(self, tensordict: TensorDictBase) -> Tensor:
        """Return :meth:`logits` for the rows of a tensordict as float32; raise unless they are floats (B, S)."""
        logits = self.logits(*read(tensordict, self.in_keys))
        name = f"logits of {type(self).__name__}"
        if not logits.is_floating_point():
            raise TypeError(f"{name} must be float32, above 0 where a condition holds, got {logits.dtype}")
        if logits.shape[-1:] != (self.plans.num_steps,):
            raise ValueError(f"{name} must be (B, {self.plans.num_steps}), got shape {tuple(logits.shape)}")
        return logits.to(torch.float32)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        logits = self.logits_of(tensordict)
        qaf = logits.sigmoid()
        if self.answers == "hard":
            qaf = (logits > 0).to(qaf.dtype) + (qaf - qaf.detach())  # straight-through: the gradient of the sigmoid
        if "task_id" in self.in_keys:  # with the plan's number, an actor of other plans refuses the answers
            rows = self.plan_tables.rows(tensordict.get("task_id"))
            tensordict.set(key_beside(self.out_keys_source[0], "_plan"), pick(self.plan_number, rows))
        return write(tensordict, self, [qaf, logits])

    def transform(self) -> Transform | None:
        """Return a new transform that writes the keys that it reads and an environment lacks; None if none."""
        return None

    def with_plans(self, plans: AnyPlans) -> QueryEvaluator:
        """Return an evaluator on the same weights for other plans; RuntimeError if the weights differ in shape."""
        options: dict[str, Any] = dict(self.config)
        if "text_encoder" in signature(type(self)).parameters:
            options["text_encoder"] = self.text_encoder
        other = type(self)(as_plans(plans), **options)
        other.load_state_dict(self.state_dict())  # checks names and shapes
        # Share the weights and saved buffers themselves, so that training either trains both. Tables of the plans are
        # buffers that are not saved: they stay the other's own.
        for name, module in other.named_modules():
            own, tables = self.get_submodule(name), module._non_persistent_buffers_set
            module._parameters.update(own._parameters)
            module._buffers.update({key: buffer for key, buffer in own._buffers.items() if key not in tables})
        return other.train(self.training)


def evaluators_of(policy: Any) -> list[QueryEvaluator]:
    """Return the evaluators inside a policy, for example in a TensorDictSequential."""
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    return [module for module in modules if isinstance(module, QueryEvaluator)]


# --- evaluators of clauses -----------------------------------------------------------------------------------------

_PADDING = -1e4  # the logit beyond a plan's last step, as in QueryProgram.logits
LARGEST_LOGIT = 30.0
"""The size of the largest logit of a clause, a probability of 1e-13."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres: the scales at which tanh squashes a difference


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
    # Only for the plans of T tasks, each of whose clauses (T, C) is listed once:
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
    """Base class of query evaluators whose network was trained on exact answers.

    Reads a view of a state, such as an observation or pictures, and ``task_id``; writes as :class:`QueryEvaluator`,
    -1e4 beyond a plan's last step. Clauses are answered one by one and combined by :func:`conjunction`. A subclass sets
    ``network``, from views of B states and their clauses (B, C) to logits (B, C), and ``seen_dims``, the number of
    dimensions of a view.

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
        tables = self._clauses_of_plans(index.tasks)
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
        """Return clauses (G,) of any tasks as tensors. An evaluator without ``names`` gives every object index 0."""
        predicate_index = {name: number for number, name in enumerate(self.predicates)}
        name_index = {name: number for number, name in enumerate(self.names)}
        for task, clause in clauses:
            where = f"of {str(clause)!r}, in {task.name}"
            if clause.predicate not in predicate_index:
                error = unknown_name(f"predicate {where}", clause.predicate, self.predicates)
                raise ValueError(f"{error}; make and train an evaluator that has this predicate")
            for name in (clause.subject, clause.object):
                if self.names and name is not None and name not in name_index:
                    error = unknown_name(f"object {where}", name, self.names)
                    raise ValueError(f"{error}; make and train an evaluator that has this object")
        first, second, shift = zip(*(_compared(clause, task) for task, clause in clauses), strict=True)
        return Clauses(
            first=torch.tensor(first),
            second=torch.tensor(second),
            shift=torch.tensor(shift, dtype=torch.float32),
            predicate=torch.tensor([predicate_index[clause.predicate] for _, clause in clauses]),
            negated=torch.tensor([clause.negated for _, clause in clauses]),
            subject=torch.tensor([name_index.get(clause.subject, 0) for _, clause in clauses]),
            object=torch.tensor([name_index.get(clause.object or "", len(self.names)) for _, clause in clauses]),
        )

    def _clauses_of_plans(self, tasks: Sequence[str]) -> Clauses:
        """Return the clauses of the plans as tensors, with a row for each of ``tasks``."""
        plans = [self.plans[task] for task in tasks]
        # The different clauses of each plan, in the order of its steps.
        by_plan = [list(dict.fromkeys(c for step in plan.steps for c in step.condition.clauses)) for plan in plans]
        width = max(len({*step.condition.clauses}) for plan in plans for step in plan.steps)
        number = torch.zeros(len(tasks), max(map(len, by_plan)), dtype=torch.int64)
        parts = torch.zeros(len(tasks), self.plans.num_steps, width, dtype=torch.int64)
        mask = torch.zeros(len(tasks), self.plans.num_steps, width, dtype=torch.bool)
        start = 0
        for row, (plan, clauses) in enumerate(zip(plans, by_plan, strict=True)):
            number[row, : len(clauses)] = torch.arange(start, start + len(clauses))
            start += len(clauses)
            for column, step in enumerate(plan.steps):
                which = [clauses.index(clause) for clause in dict.fromkeys(step.condition.clauses)]
                parts[row, column, : len(which)] = torch.tensor(which)
                mask[row, column, : len(which)] = True
        pairs = [(plan.definition, c) for plan, clauses in zip(plans, by_plan, strict=True) for c in clauses]
        return self.code(pairs).pick(number)._replace(parts=parts, mask=mask)


def _different(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str) or not names or len({*names}) < len(names):
        raise ValueError(f"{argument} must be different names, at least one, got {shown(names)}")
    return tuple(names)


def _compared(clause: Clause, task: Task) -> tuple[list[int], list[int], list[float]]:
    """Return ``first``, ``second`` and ``shift`` of :class:`Clauses` for one clause."""
    zeros = [task.layout.size] * 3
    if clause.predicate in STATES:
        return [*zeros[:2], task.openings[clause.subject]], zeros, [0.0] * 3
    first, shift = _position(task, clause.subject)
    if clause.object is None:
        return first, zeros, shift
    second, other_shift = _position(task, clause.object)
    return first, second, [a - b for a, b in zip(shift, other_shift, strict=True)]


def _position(task: Task, name: str) -> tuple[list[int], list[float]]:
    """Return the indices of an object's three coordinates in an observation, and what is added to them."""
    item = task.object(name)
    index = [at if isinstance(at, int) else task.layout.size for at in item.position]
    fixed = [0.0 if isinstance(at, int) else at for at in item.position]
    return index, [value + offset for value, offset in zip(fixed, item.offset, strict=True)]


class ClauseNetwork(nn.Module):
    """The logit of a clause: a trunk reads the difference of two positions, and a learned vector of the predicate
    weighs its output. "not" changes the sign."""

    numbers: int = 3  # of a difference

    def __init__(self, width: int, depth: int, *, predicates: int) -> None:
        super().__init__()
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
        return self.judge((first - second).unflatten(-1, (-1, 3)) + clauses.shift, clauses)

    def judge(self, difference: Tensor, clauses: Clauses) -> Tensor:
        """Return logits (B, C) from differences (B, C, 3) in metres."""
        predicates = self.predicates.weight[clauses.predicate]
        features = torch.cat([torch.tanh(difference / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(predicates.dtype)) * predicates[..., :-1]).sum(-1) / sqrt(self.width)
        logits = logits + predicates[..., -1]
        return torch.where(clauses.negated, -logits, logits).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)


class StateQueryEvaluator(ClauseEvaluator):
    """A query evaluator that answers conditions from the observation, by a network trained on exact answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` and ``qaf_logits`` (B, S) float32
    as :class:`QueryEvaluator` does. It looks objects' positions up in the observation, so it only learns what
    predicates mean.

    Args:
        plans, answers, predicates: as for :class:`~lw_torchrl.modules.query_evaluator.ClauseEvaluator`, with its
            errors and source.
        width, depth: units and number of the hidden layers.

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
        width: Count = 128,
        depth: Count = 3,
        answers: Answers = "soft",
        predicates: Sequence[str] | None = None,
    ) -> None:
        super().__init__(plans, answers=answers, predicates=predicates)
        self.network = ClauseNetwork(width, depth, predicates=len(self.predicates))
        self.config |= {"width": width, "depth": depth}

    def check_seen(self, seen: Tensor) -> None:
        check_observation(seen, self.plans.layout)
