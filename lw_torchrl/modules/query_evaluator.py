"""Query evaluators: learned modules that answer plan conditions, as replacements of the exact condition checker."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
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

from lw_torchrl._util.checks import Count, check_choice, shown, typed
from lw_torchrl._util.keys import dispatched, key_beside, read, write
from lw_torchrl.language.expressions import Expression
from lw_torchrl.language.gates import Gates, Operand, Shapes, compile_gates, evaluate_gates
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.queries import Clause
from lw_torchrl.language.relations import PREDICATES, STATES
from lw_torchrl.language.task_index import PlanTables, TaskIndex, TaskTables, pick
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.features import check_observation

Answers = Literal["soft", "hard"]


class QueryEvaluator(TensorDictModuleBase):
    """Base class for modules that answer plan conditions for a policy.

    Training ``TensorDictSequential(evaluator, actor)`` trains both modules. A subclass implements :meth:`logits`, and
    adds the keyword arguments of its constructor to ``config``.

    Reads ``in_keys``, by default ``observation`` (B, 39) float32 and ``task_id`` (B,) int64. Writes ``qaf_logits``
    (B, S) float32, positive where the condition of a plan step holds, in the order of the plan, and ``qaf`` (B, S)
    float32 in [0, 1], which the policy reads.

    Args:
        plans: the plans whose conditions the module answers.
        answers: the kind of answers in ``qaf``. "soft" is the probability, the sigmoid of the logit. "hard" is 1 where
            the logit is positive and 0 elsewhere, with the gradient of "soft"; choose "hard" for a policy trained on
            exact answers. A subclass that overrides the constructor must accept ``answers`` to support "hard".

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

    Source: paper section 'Differentiability and Optimization', which suggests a visual question answering model.
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
        """The keyword arguments that reconstruct this module, as JSON."""
        return {**self._config, "answers": self.answers} if self._accepts_answers else self._config

    @config.setter
    def config(self, config: dict[str, Any]) -> None:
        self._config = config

    @property
    def answers(self) -> Answers:
        """The kind of answers in ``qaf``, "soft" or "hard". The attribute can be assigned."""
        return self._answers

    @answers.setter
    def answers(self, answers: Answers) -> None:
        self._answers: Answers = check_choice("answers", answers, ("soft", "hard"))
        if answers != "soft" and not self._accepts_answers:  # a saved file would lose the value
            name = type(self).__name__
            raise TypeError(f"{name} supports only answers='soft', got {answers!r}; add answers= to its constructor")

    def logits(self, *read: Any, **_: Any) -> Tensor:  # a subclass may have any signature
        """Return the logits (B, S) float32 for the tensors of ``in_keys``."""
        raise NotImplementedError(f"{type(self).__name__} must override logits")

    def logits_of(self, tensordict: TensorDictBase) -> Tensor:
        """Compute :meth:`logits` of a tensordict as float32; raise a ValueError unless they are floats (B, S)."""
        logits = self.logits(*read(tensordict, self.in_keys))
        if not logits.is_floating_point() or logits.shape[-1:] != (self.plans.num_steps,):
            name, got = type(self).__name__, f"{logits.dtype} of shape {tuple(logits.shape)}"
            raise ValueError(f"logits of {name} must be float32 (B, {self.plans.num_steps}), got {got}")
        return logits.to(torch.float32)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        logits = self.logits_of(tensordict)
        qaf = logits.sigmoid()
        if self.answers == "hard":
            qaf = (logits > 0).to(qaf.dtype) + (qaf - qaf.detach())  # straight-through: the gradient of the sigmoid
        if "task_id" in self.in_keys:  # the plan's number lets an actor reject answers to other plans
            rows = self.plan_tables.rows(tensordict.get("task_id"))
            tensordict.set(key_beside(self.out_keys_source[0], "_plan"), pick(self.plan_number, rows))
        return write(tensordict, self, [qaf, logits])

    def transform(self) -> Transform | None:
        """Return a new transform that writes the ``in_keys`` missing from an environment; None if none are missing."""
        return None

    def with_plans(self, plans: AnyPlans) -> QueryEvaluator:
        """Return an evaluator for another set of plans with the same weights; raise RuntimeError if they do not fit."""
        options: dict[str, Any] = dict(self.config)
        if "text_encoder" in signature(type(self)).parameters:
            options["text_encoder"] = self.text_encoder
        other = type(self)(as_plans(plans), **options)
        other.load_state_dict(self.state_dict())  # checks names and shapes
        # Share the parameters and the persistent buffers, so that training one also trains the other. The tables of the
        # plans are non-persistent buffers, and are not shared.
        for name, module in other.named_modules():
            own, tables = self.get_submodule(name), module._non_persistent_buffers_set
            module._parameters.update(own._parameters)
            module._buffers.update({key: buffer for key, buffer in own._buffers.items() if key not in tables})
        return other.train(self.training)


def evaluators_of(policy: Any) -> list[QueryEvaluator]:
    """Return the query evaluators inside a policy, except evaluators nested in another evaluator."""
    if isinstance(policy, QueryEvaluator):
        return [policy]
    children = policy.children() if isinstance(policy, nn.Module) else ()
    return list(dict.fromkeys(evaluator for child in children for evaluator in evaluators_of(child)))


# --- evaluators of clauses -----------------------------------------------------------------------------------------

_PADDING = -1e4  # the logit beyond a plan's last step, as in QueryProgram.logits
LARGEST_LOGIT = 30.0
"""The maximum absolute logit of a clause; it keeps probabilities within [1e-13, 1 - 1e-13]."""
_SCALES = (0.005, 0.02, 0.1, 0.5)  # metres, the scales at which tanh squashes a difference


class Clauses(NamedTuple):
    """A batch (...,) of clauses, possibly from different tasks. A clause applies a predicate to the
    difference ``observation[first] - observation[second] + shift``, a vector of three numbers."""

    first: Tensor  # (..., 3) int64, indices into the observation; index D (past the end) reads 0
    second: Tensor  # (..., 3) int64
    shift: Tensor  # (..., 3) float32, metres
    predicate: Tensor  # (...) int64, an index into the list of predicates
    negated: Tensor  # (...) bool
    subject: Tensor  # (...) int64, an index into the list of names
    object: Tensor  # (...) int64, an index into the list of names, or the list's length if there is no object
    # The logic gates (see Gates) that combine clauses into conditions. Only set for the clauses (T, C) of T tasks'
    # plans, where each distinct clause of a plan is listed once. Input C of the gates is the constant true.
    inputs: Tensor = torch.empty(0, dtype=torch.int64)
    flipped: Tensor = torch.empty(0, dtype=torch.bool)

    def pick(self, which: Tensor) -> Clauses:
        """Return the clauses (...) at indices ``which`` (...) int64 of these clauses (G,)."""
        return Clauses(*(table[which] for table in self[:7]))


class ClauseEvaluator(QueryEvaluator):
    """Base class for query evaluators whose networks are trained on exact answers.

    Reads a view of a state, such as an observation or pictures, and ``task_id``; writes the keys of
    :class:`QueryEvaluator`, with logits of -1e4 beyond a plan's last step. The network answers single clauses.
    The plans' conditions combine the answers as if the clauses were independent: P(A and B) = P(A) P(B), and
    P(A or B) = 1 - P(not A) P(not B). Gradients reach every clause. A subclass sets ``network``, which maps views of B
    states and their clauses (B, C) to logits (B, C), and ``seen_dims``, the number of dimensions of a view.

    Args:
        plans, answers: see :class:`QueryEvaluator`.
        predicates: the relations and predicates that the network can answer; None for all.
        names: the objects that the network can distinguish; None if it does not distinguish objects by name.

    Raises:
        ValueError: a plan uses an unknown predicate or object; at call time, a wrong shape, or a task without a plan.
    """

    network: nn.Module
    shapes: Shapes
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
        """Raise a :class:`ValueError` unless the view has the shape and dtype of the network's inputs."""
        check_observation(seen, self.plans.layout)

    def logits(self, *read: Tensor) -> Tensor:
        """Return the logits (..., S) float32 for views (..., *view shape) and task ids (...) int64."""
        seen, task_id = read
        self.check_seen(seen)
        shape = seen.shape[: -self.seen_dims]
        if task_id.shape != shape:
            each = f"one for each row of {self.in_keys[0]!r}"
            raise ValueError(f"task_id must be of shape {tuple(shape)}, {each}, got {tuple(task_id.shape)}")
        rows = seen.reshape(-1, *seen.shape[-self.seen_dims :])
        tables = self.tables.select(task_id.reshape(-1), rows)
        clauses = self.network(rows, tables)
        values = torch.cat((clauses, torch.full_like(clauses[..., :1], -_PADDING)), -1)
        logits = evaluate_gates(values, Gates(tables.inputs, tables.flipped, self.shapes), "product")
        return logits.reshape(*task_id.shape, self.plans.num_steps)

    def code(self, clauses: Sequence[tuple[Task, Clause]]) -> Clauses:
        """Encode clauses (G,) of any tasks as tensors. Without ``names``, every object has index 0."""
        name_index = {name: number for number, name in enumerate(self.names)}
        for task, clause in clauses:
            where = f"of {str(clause)!r}, in {task.name}"
            check_choice(f"predicate {where}", clause.predicate, self.predicates)
            for name in filter(None, (clause.subject, clause.object) if self.names else ()):
                check_choice(f"object {where}", name, self.names)
        first, second, shift = zip(*(_compared(clause, task) for task, clause in clauses), strict=True)
        return Clauses(
            first=torch.tensor(first),
            second=torch.tensor(second),
            shift=torch.tensor(shift, dtype=torch.float32),
            predicate=torch.tensor([self.predicates.index(clause.predicate) for _, clause in clauses]),
            negated=torch.tensor([clause.negated for _, clause in clauses]),
            subject=torch.tensor([name_index.get(clause.subject, 0) for _, clause in clauses]),
            object=torch.tensor([name_index.get(clause.object or "", len(self.names)) for _, clause in clauses]),
        )

    def _clauses_of_plans(self, tasks: Sequence[str]) -> Clauses:
        """Encode the clauses of the plans as tensors, with a row for each of ``tasks``."""
        plans = [self.plans[task] for task in tasks]
        # The distinct clauses of each plan, in the order of the steps.
        by_plan = [list(dict.fromkeys(c for step in plan.steps for c in step.condition.clauses)) for plan in plans]
        most, start = max(map(len, by_plan)), 0
        if latched := [plan.task for plan in plans if any(step.condition.has_latch for step in plan.steps)]:
            tasks = ", ".join(latched)
            raise ValueError(f"a learned evaluator cannot be used: plans of {tasks} depend on earlier steps")
        if not most:
            raise ValueError("plans must have a condition with a clause, got only 'always' and 'never'")
        number = torch.zeros(len(tasks), most, dtype=torch.int64)
        for row, clauses in enumerate(by_plan):
            number[row, : len(clauses)] = torch.arange(start, start + len(clauses))
            start += len(clauses)

        def operands(clauses: list[Clause]) -> Callable[[Expression], Operand]:
            places = {clause: place for place, clause in enumerate(clauses)}

            def operand(literal: Expression) -> Operand:
                clause = replace(literal.leaf, negated=literal.negated)
                if clause in places:
                    return (places[clause],), False
                return (places[replace(clause, negated=not clause.negated)],), True

            return operand

        conditions = [[step.condition.expression for step in plan.steps] for plan in plans]
        gates = compile_gates(conditions, list(map(operands, by_plan)), most + 1, true=most)
        self.shapes = gates.shapes
        pairs = [(plan.definition, c) for plan, clauses in zip(plans, by_plan, strict=True) for c in clauses]
        return self.code(pairs).pick(number)._replace(inputs=gates.inputs, flipped=gates.negated)


def _different(argument: str, names: Sequence[str]) -> tuple[str, ...]:
    if isinstance(names, str) or not names or len({*names}) < len(names):
        raise ValueError(f"{argument} must be one or more distinct names, got {shown(names)}")
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
    """Return the indices of an object's three coordinates in an observation, and offsets to add to the values."""
    item = task.object(name)
    index = [at if isinstance(at, int) else task.layout.size for at in item.position]
    fixed = [0.0 if isinstance(at, int) else at for at in item.position]
    return index, [value + offset for value, offset in zip(fixed, item.offset, strict=True)]


class ClauseNetwork(nn.Module):
    """A network that maps clauses to logits. A logit is a bias plus the dot product of the predicate's learned vector
    and the output of an MLP, whose input is the difference of two positions. "not" flips the sign."""

    numbers: int = 3  # components of a difference

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
        self.predicates = nn.Embedding(predicates, width + 1, dtype=torch.float32)

    def forward(self, observation: Tensor, clauses: Clauses) -> Tensor:
        """Return the logits (B, C), in [-30, 30], of clauses (B, C) for observations (B, 39)."""
        numbers = torch.cat((observation, torch.zeros_like(observation[..., :1])), -1)
        first, second = (numbers.gather(-1, index.flatten(-2)) for index in (clauses.first, clauses.second))
        return self.judge((first - second).unflatten(-1, (-1, 3)) + clauses.shift, clauses)

    def judge(self, difference: Tensor, clauses: Clauses) -> Tensor:
        """Return the logits (B, C) of clauses from differences (B, C, 3) in metres."""
        predicates = self.predicates.weight[clauses.predicate]
        features = torch.cat([torch.tanh(difference / scale) for scale in _SCALES], -1)
        logits = (self.trunk(features.to(predicates.dtype)) * predicates[..., :-1]).sum(-1) / sqrt(self.width)
        logits = logits + predicates[..., -1]
        return torch.where(clauses.negated, -logits, logits).clamp(-LARGEST_LOGIT, LARGEST_LOGIT)


class StateQueryEvaluator(ClauseEvaluator):
    """A query evaluator that predicts conditions from the observation, with a network trained on exact answers.

    Reads ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes ``qaf`` and ``qaf_logits`` (B, S) float32
    as :class:`QueryEvaluator` does. The evaluator looks up the objects' positions in the observation, so the network
    only learns the meaning of predicates.

    Args:
        plans, answers, predicates: see :class:`~lw_torchrl.modules.query_evaluator.ClauseEvaluator`, which also lists
            the errors.
        width, depth: units per hidden layer and number of hidden layers.

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
