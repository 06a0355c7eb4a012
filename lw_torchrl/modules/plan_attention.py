"""PlanAttention: the truth of the conditions gives attention over the plan's steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import checked
from lw_torchrl._keys import as_keys, check_apart, dispatched, read, write
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.task_index import PlanTables
from lw_torchrl.language.value_checks import check_values
from lw_torchrl.transforms.qaf import plan_number_key

Answers = Literal["logit", "tanh", "hard"]


def attend(logits: Tensor, steps: Tensor) -> Tensor:
    """Softmax of logits (B, S) over the steps that there are, (B, S) bool; 0 on the others."""
    return logits.masked_fill(~steps, -torch.inf).softmax(-1)


def attention_logits(logits: Tensor, answers: Answers) -> Tensor:
    """Return an evaluator's logits (...,) as logits of the attention, where exact truth counts 5 and -5.

    They stay as they are ("logit"), become 5·tanh(logit / 2) ("tanh"), or 5 above 0 and else -5, with the gradient of
    "tanh" ("hard").
    """
    if answers == "logit":
        return logits
    soft = 5.0 * torch.tanh(0.5 * logits)
    if answers == "tanh":
        return soft
    return torch.where(logits > 0, 5.0, -5.0) + (soft - soft.detach())


def check_truth(qaf: Tensor, shape: tuple[int, ...]) -> None:
    """Raise :class:`ValueError` unless truth has a column for each step, and soft truth is from 0 to 1."""
    if qaf.shape != shape:
        got = f"got {tuple(qaf.shape)}; give QAFTransform the same plans"
        raise ValueError(f"qaf must have shape {shape}, one column for each step of the actor's plans, {got}")
    if qaf.dtype != torch.bool:  # of bool, there is nothing to look at
        problem = "qaf must be bool, or numbers from 0 to 1 for soft truth, got others, or NaN"
        check_values(lambda truth: ((truth >= 0) & (truth <= 1)).all(), qaf, problem)


class PlanAttention(TensorDictModuleBase):
    """Softmax over a plan's real steps of the logits 10·truth - 5; uniform over them where no condition holds.

    Reads ``qaf`` (B, S) bool, or float in [0, 1] for soft truth, and ``task_id`` (B,) int64; writes
    ``skill_weights`` (B, S) float32, which sum to 1 and are 0 on padding.

    Args:
        plans: the plans whose steps are attended to.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Raises:
        ValueError: at call time, ``qaf`` of other steps, outside [0, 1] or of other plans; a task_id without a plan.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> from tensordict import TensorDict
        >>> plans = lw.load_plans("MT10")
        >>> reach = torch.tensor([lw.task_id("reach")])
        >>> state = TensorDict(qaf=torch.zeros(1, plans.num_steps, dtype=torch.bool), task_id=reach)
        >>> weights = PlanAttention(plans)(state)["skill_weights"]
        >>> len(plans["reach"].steps), int((weights > 0).sum())
        (3, 3)

    Source: paper section 'Plan Conditioning'.
    """

    mask: Tensor

    @checked
    def __init__(
        self,
        plans: AnyPlans,
        *,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = as_keys("in_keys", in_keys, ("qaf", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("skill_weights",))
        check_apart(self.in_keys, self.out_keys)
        self.plans = as_plans(plans)
        self.tables = PlanTables(self.plans)
        self.register_buffer("mask", self.tables.mask, persistent=False)

    def over_steps(self, qaf: Tensor, rows: Tensor, steps: Tensor | None = None) -> Tensor:
        """(B, S) truth and rows (B,) int64, as from :meth:`PlanTables.rows`, to (B, S) float32 attention, over
        ``steps`` (B, S) bool, or all that there are."""
        check_truth(qaf, (*rows.shape, self.mask.shape[-1]))
        return attend(10.0 * qaf.to(torch.float32) - 5.0, self.mask[rows] if steps is None else steps)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        qaf, task_id = read(tensordict, self.in_keys)
        rows = self.tables.rows(task_id)
        self.tables.refuse_others(tensordict.get(plan_number_key(self.in_keys[0]), None), rows)
        return write(tensordict, self, [self.over_steps(qaf, rows)])
