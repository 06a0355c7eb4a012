"""EvaluatorAnchor: what holds a policy's evaluator to the words while the loss of imitation trains it."""

from __future__ import annotations

from typing import Any

from tensordict import TensorDictBase
from torch import Tensor, nn

from lw_torchrl.language.plan_tables import PlanTables
from lw_torchrl.modules.query_evaluator import QueryEvaluator
from lw_torchrl.transforms.qaf import plan_program


class EvaluatorAnchor:
    """The cross entropy of an evaluator's answers to its plans' conditions with the query answering function's, the
    mean over the steps that there are.

    Args:
        actor: whose evaluator it is.

    Raises:
        ValueError: the actor has none.
    """

    def __init__(self, actor: Any) -> None:
        evaluator = getattr(actor, "evaluator", None)
        if not isinstance(evaluator, QueryEvaluator):
            raise ValueError(f"qaf_anchor is for a policy with an evaluator, this {type(actor).__name__} has none")
        self.evaluator = evaluator
        self.program, self.tables = plan_program(evaluator.plans), PlanTables(evaluator.plans)

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """Of a minibatch with ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and what the evaluator reads: ()
        float32."""
        task = batch.get("task_id")
        logits = self.evaluator.answers(*(batch.get(key) for key in self.evaluator.in_keys))
        truth = self.program(batch.get("observation"), task).to(logits.dtype)
        steps = self.tables.mask.to(task.device)[self.tables.rows(task)]
        return nn.functional.binary_cross_entropy_with_logits(logits[steps], truth[steps])
