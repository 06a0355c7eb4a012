"""PlanAttention: attention over a plan's steps, computed from the truth values of their conditions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._util.keys import Keys, dispatched, write
from lw_torchrl.language.task_index import PlanTables, as_plans, pick
from lw_torchrl.modules.parts import Part, in_mode_of
from lw_torchrl.transforms.qaf import read_truth

if TYPE_CHECKING:
    from lw_torchrl.language.plans import AnyPlans

TRUE_LOGIT = 5.0  # logit of a true condition; a false condition has -5 (paper, section "Plan Conditioning")


def attend(logits: Tensor, mask: Tensor) -> Tensor:
    """Return the softmax of ``logits`` (..., S) over the steps where ``mask`` (..., S) bool is true; 0 elsewhere."""
    return logits.masked_fill(~mask, -torch.inf).softmax(-1)


class PlanAttention(Part):
    """A module that computes attention over the steps of each row's plan: the softmax of 10·truth - 5.

    Padding steps get no attention. If no condition is true, the attention is uniform over the plan's steps.

    Reads ``qaf`` (B, S) bool, or float in [0, 1] for soft truth, and ``task_id`` (B,) int64. For plans with fallback
    steps, also reads ``turn`` (B,) int64 (0 if absent), see :class:`~lw_torchrl.transforms.FallbackTurns`. Writes
    ``skill_weights`` (B, S) float32, whose rows sum to 1.

    Args:
        plans: the plans whose steps the module attends to.
        in_keys, out_keys: replacements for the default keys, in the order above; nested keys are allowed.

    Raises:
        ValueError: at call time, if ``qaf`` has the wrong number of steps, holds values outside [0, 1] or belongs
            to other plans, or if a task has no plan. A wider ``qaf`` is accepted if ``qaf_plan`` shows that it belongs
            to the same plans.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> reach = torch.tensor([lw.task_id("reach")])
        >>> weights = lw.modules.PlanAttention(plans)(qaf=torch.zeros(1, plans.num_steps), task_id=reach)
        >>> len(plans["reach"].steps), int((weights > 0).sum())
        (3, 3)

    Source: paper section 'Plan Conditioning'.
    """

    _options = ("plans",)
    mask: Tensor

    def __init__(self, plans: AnyPlans, *, in_keys: Keys | None = None, out_keys: Keys | None = None) -> None:
        plans = as_plans(plans)
        tables = PlanTables(plans)
        has_fallback = not torch.equal(tables.turns[:, 0], tables.turns[:, 1])
        super().__init__(("qaf", "task_id", "turn")[: 2 + has_fallback], ("skill_weights",), in_keys, out_keys)
        self.plans, self.tasks, self.layout = plans, tuple(plans), plans.layout
        self.tables, self.has_fallback = tables, has_fallback
        # (T, 6, S) bool, the steps that each turn allows (see FallbackTurns); without a fallback plan, all steps.
        self.register_buffer("mask", tables.turns, persistent=False)

    @property
    def truth_keys(self) -> tuple[NestedKey, NestedKey]:
        """The keys of the conditions' truth values and of the task id."""
        return self.in_keys[0], self.in_keys[1]

    @property
    def turn_key(self) -> NestedKey | None:
        """The key of ``turn``; None for plans without fallback steps."""
        return self.in_keys[2] if self.has_fallback else None

    def with_plans(self, plans: AnyPlans) -> PlanAttention:
        """Return a :class:`PlanAttention` for another set of plans."""
        other = PlanAttention(plans, out_keys=self.out_keys_source)
        # Only one of the modules may read a turn. The key of the turn comes last.
        other.in_keys = [*self.in_keys, *other.in_keys[len(self.in_keys) :]][: len(other.in_keys)]
        return in_mode_of(self, other.to(self.mask.device))

    def weights(self, qaf: Tensor, rows: Tensor, turn: Tensor | None = None) -> Tensor:
        """Return the attention (..., S) float32 for truth (..., S), table rows (...) int64 and turns (...) int64."""
        # In the flattened mask (6T, S), row 6t + i marks the steps that turn i of task t allows.
        number = self.mask.shape[1]
        mask = pick(self.mask.flatten(0, 1), number * rows if turn is None else number * rows + turn % number)
        return attend(2 * TRUE_LOGIT * qaf.to(torch.float32) - TRUE_LOGIT, mask)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        qaf, rows = read_truth(tensordict, self.in_keys[:2], self.tables)
        turn = tensordict.get(self.in_keys[2], None) if self.has_fallback else None
        return write(tensordict, self, [self.weights(qaf, rows, turn)])
