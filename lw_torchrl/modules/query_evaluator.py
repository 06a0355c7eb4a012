"""QueryEvaluator: a module in front of a policy that answers the plans' conditions instead of the exact function."""

from __future__ import annotations

from inspect import signature
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._util.checks import check_choice, typed
from lw_torchrl._util.keys import dispatched, key_beside, read, write
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.task_index import PlanTables, pick
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import with_weights_of

Answers = Literal["soft", "hard"]


class QueryEvaluator(TensorDictModuleBase):
    """Answers the plans' conditions in front of a policy: ``TensorDictSequential(evaluator, actor)``.

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
        what = f"logits of {type(self).__name__} must be"
        if not logits.is_floating_point():
            raise TypeError(f"{what} float32, above 0 where a condition holds, got {logits.dtype}")
        if logits.shape[-1:] != (self.plans.num_steps,):
            needed = f"(B, {self.plans.num_steps}), a column for each step of the longest plan"
            raise ValueError(f"{what} {needed}, got shape {tuple(logits.shape)}")
        return logits.to(torch.float32)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        logits = self.logits_of(tensordict)
        qaf = logits.sigmoid()
        if self.answers == "hard":
            qaf = (logits > 0).to(qaf.dtype) + (qaf - qaf.detach())
        rows = self.plan_tables.rows(tensordict.get("task_id")) if "task_id" in self.in_keys else None
        if rows is not None:  # an actor of other plans then refuses the answers, as QAFTransform's
            tensordict.set(key_beside(self.out_keys_source[0], "_plan"), pick(self.plan_number, rows))
        return write(tensordict, self, [qaf, logits])

    def transform(self) -> Transform | None:
        """Return a new transform that writes what it reads and an environment does not; None if there is nothing."""
        return None

    def with_plans(self, plans: AnyPlans) -> QueryEvaluator:
        """Return an evaluator on the same weights for other plans; RuntimeError if the weights differ in shape."""
        options: dict[str, Any] = dict(self.config)
        if "text_encoder" in signature(type(self)).parameters:
            options["text_encoder"] = self.text_encoder
        return with_weights_of(self, type(self)(as_plans(plans), **options))


def evaluators_of(policy: Any) -> list[QueryEvaluator]:
    """Return the evaluators inside a policy, for example in a TensorDictSequential."""
    modules = policy.modules() if isinstance(policy, nn.Module) else ()
    return [module for module in modules if isinstance(module, QueryEvaluator)]
