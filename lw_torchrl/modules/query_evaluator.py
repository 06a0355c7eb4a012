"""QueryEvaluator: what answers a plan's conditions inside a policy, in the query answering function's place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform

from lw_torchrl._checks import checked
from lw_torchrl._keys import as_keys, check_apart, dispatched, write
from lw_torchrl._registry import Registry, is_class
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.networks import with_weights_of
from lw_torchrl.modules.policy import Prepared, kind_of
from lw_torchrl.modules.registry import class_of
from lw_torchrl.transforms.qaf import QAFTransform


class QueryEvaluator(Prepared):
    """A module inside a policy that answers the plans' conditions: saved with the policy, and trained by its loss.

    A subclass gives :meth:`logits` and, in ``config``, the keyword arguments that make it again beside the plans.

    Reads ``in_keys``, by default ``observation`` (B, 39) float32 and ``task_id`` (B,) int64; writes
    ``qaf_logits`` (B, S) float32, positive where a condition of the row's plan holds, in the order of its steps. The
    policy's attention is a softmax of the logits over the steps that there are, or of what ``answers`` of
    :class:`PlanConditionedActor` makes of them; exact truth is worth 5 and -5.

    Args:
        plans: whose conditions it answers.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> class Guess(QueryEvaluator):
        ...     def logits(self, observation, task_id):
        ...         return torch.zeros(*task_id.shape, self.plans.num_steps)
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, evaluator=Guess(plans))
        >>> actor.in_keys
        ['observation', 'task_id']

    Source: paper section 'Differentiability and Optimization', which names a visual question answering model.
    """

    plans: Plans
    text_encoder: TextEncoder | None = None

    @checked
    def __init__(self, plans: Plans) -> None:
        super().__init__()
        self.plans, self.tasks, self.layout, self.config = plans, tuple(plans), plans.layout, {}
        self.in_keys: list[NestedKey] = ["observation", "task_id"]
        self.out_keys: list[NestedKey] = ["qaf_logits"]

    def logits(self, *read: Any, **_: Any) -> Tensor:  # any signature overrides it
        """The tensors of ``in_keys`` to (B, S) float32."""
        raise NotImplementedError(f"{type(self).__name__} must override logits")

    def answers(self, *read: Tensor) -> Tensor:
        """Return :meth:`logits` as float32, checked to be floats (B, S)."""
        logits = self.logits(*read)
        what = f"logits of {type(self).__name__} must be"
        if not logits.is_floating_point():
            raise TypeError(f"{what} float32, above 0 where a condition holds, got {logits.dtype}")
        if logits.shape[-1:] != (self.plans.num_steps,):
            needed = f"(B, {self.plans.num_steps}), a column for each step of the longest plan"
            raise ValueError(f"{what} {needed}, got shape {tuple(logits.shape)}")
        return logits.to(torch.float32)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return write(tensordict, self, [self.answers(*(tensordict.get(key) for key in self.in_keys))])

    def with_plans(self, plans: Plans) -> QueryEvaluator:
        """One on the same weights for other plans; :class:`RuntimeError` if the weights differ in names or shapes."""
        return with_weights_of(self, self.from_options(plans, self.config, self.text_encoder))

    @classmethod
    def from_options(cls, plans: Plans, options: Mapping[str, Any], text_encoder: TextEncoder | None) -> QueryEvaluator:
        """One of the options in ``config``; one that reads texts hands on the text encoder."""
        return cls(plans, **options)

    def describe(self) -> dict[str, Any]:
        """All that :func:`evaluator_from_description` needs beside the plans, as JSON."""
        return {**kind_of(self), "options": self.config}


EVALUATORS = Registry(
    "evaluator",
    "lw_torchrl.evaluators",
    {
        "ImageQueryEvaluator": "lw_torchrl.modules.image_query_evaluator:ImageQueryEvaluator",
        "StateQueryEvaluator": "lw_torchrl.modules.state_query_evaluator:StateQueryEvaluator",
    },
    is_class("evaluator", QueryEvaluator),
)
"""The classes of evaluators by name, as in policy files."""


def evaluator_from_description(found: Any, plans: Plans, text_encoder: TextEncoder | None = None) -> QueryEvaluator:
    """Make the evaluator that was described, with fresh weights; :class:`ValueError` if it is no known one."""
    if not isinstance(found, Mapping) or not isinstance(found.get("options"), Mapping):
        raise ValueError(f"an evaluator's description must have kind and options, got {found!r:.80}")
    made: type[QueryEvaluator] = class_of("kind of evaluator", EVALUATORS, found)
    return made.from_options(plans, found["options"], text_encoder)


class ReadsPlans(Prepared):
    """What plan encoders and scripts share: an evaluator, or ``qaf``, tells which of a plan's steps is in force."""

    plans: Plans
    evaluator: QueryEvaluator | None

    def read_plans(
        self,
        plans: AnyPlans,
        evaluator: QueryEvaluator | None,
        in_keys: Sequence[NestedKey] | None,
        out_keys: Sequence[NestedKey] | None,
        written: Sequence[str],
    ) -> None:
        """Take the arguments that they share; ``own_keys`` are ``in_keys`` without those that the evaluator adds."""
        self.plans = as_plans(plans)
        self.tasks, self.layout = tuple(self.plans), self.plans.layout
        if evaluator is not None and evaluator.plans.fingerprint != self.plans.fingerprint:
            raise ValueError("evaluator must be of the actor's plans, it answers the conditions of others")
        self.evaluator = evaluator
        read = ["observation", "task_id"] + ["qaf"] * (evaluator is None)
        self.own_keys = as_keys("in_keys", in_keys, read)
        asked = [] if evaluator is None else evaluator.in_keys
        self.in_keys: list[NestedKey] = list(dict.fromkeys([*self.own_keys, *asked]))
        self.out_keys = as_keys("out_keys", out_keys, written)
        check_apart(self.in_keys, self.out_keys)

    def transform(self) -> Transform | None:
        """Query answers, or what the evaluator reads."""
        if self.evaluator is not None:
            return self.evaluator.transform()
        return QAFTransform(self.plans, in_keys=self.in_keys[:2], out_keys=self.in_keys[2:])

    def describe(self) -> dict[str, Any]:
        asked = {} if self.evaluator is None else {"evaluator": self.evaluator.describe()}
        return {**super().describe(), "plans": self.plans.to_json(), **asked}


def plans_and_evaluator(found: Mapping[str, Any], encoder: TextEncoder | None) -> tuple[Plans, QueryEvaluator | None]:
    """What :meth:`ReadsPlans.describe` described."""
    plans, asked = Plans.from_json(found["plans"]), found.get("evaluator")
    return plans, None if asked is None else evaluator_from_description(asked, plans, encoder)
