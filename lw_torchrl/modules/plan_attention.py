"""PlanAttention: the truth of the conditions gives attention over the plan's steps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor

from lw_torchrl._checks import missing_keys
from lw_torchrl._keys import as_keys
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.task_index import TaskIndex


def attend(logits: Tensor, steps: Tensor) -> Tensor:
    """Softmax of logits (B, S) over the steps that there are, (B, S) bool; 0 on the others."""
    return logits.masked_fill(~steps, -torch.inf).softmax(-1)


class PlanAttention(TensorDictModuleBase):
    """Softmax over a plan's real steps of the logits 10·truth - 5; uniform over them where no condition holds.

    Reads ``qaf`` (B, S) bool, or float in [0, 1] for soft truth, and ``task_id`` (B,) int64; writes
    ``skill_weights`` (B, S) float32, which sum to 1 and are 0 on padding.

    Args:
        plans: the plans whose steps are attended to.
        in_keys, out_keys: other names for what it reads and writes, in the order above; nested ones too.

    Raises:
        ValueError: at call time, ``qaf`` of another number of steps, or a task_id without a plan.

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

    def __init__(
        self,
        plans: Plans | Mapping[str, ConditionalPlan],
        *,
        in_keys: Sequence[NestedKey] | None = None,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.in_keys = as_keys("in_keys", in_keys, ("qaf", "task_id"))
        self.out_keys = as_keys("out_keys", out_keys, ("skill_weights",))
        self.plans = as_plans(plans)
        self.index = TaskIndex(self.plans)
        lengths = torch.tensor([len(self.plans[task].steps) for task in self.index.tasks])
        self.register_buffer("mask", torch.arange(self.plans.num_steps) < lengths.unsqueeze(-1), persistent=False)

    def rows(self, task_id: Tensor) -> Tensor:
        """The row of each task in tables that have one for each plan, (...) int64; :class:`ValueError` for a task
        without a plan."""
        return self.index.rows(task_id, f"tasks without a plan in {self.plans!r}")

    def weights(self, qaf: Tensor, task_id: Tensor) -> Tensor:
        """(B, S) truth and (B,) int64 to (B, S) float32 attention."""
        return self.over_steps(qaf, self.rows(task_id))

    def over_steps(self, qaf: Tensor, rows: Tensor) -> Tensor:
        """:meth:`weights` from what :meth:`rows` gives."""
        if qaf.shape != (*rows.shape, self.mask.shape[-1]):
            raise ValueError(
                f"qaf must have shape {(*rows.shape, self.mask.shape[-1])}, one column for each step of the actor's "
                f"plans, got {tuple(qaf.shape)}; give QAFTransform the same plans"
            )
        return attend(10.0 * qaf.to(torch.float32) - 5.0, self.mask[rows])

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        qaf, task_id = (tensordict.get(key, None) for key in self.in_keys)
        if qaf is None or task_id is None:
            raise missing_keys(tensordict.keys(True, True), *self.in_keys)
        return tensordict.set(self.out_keys[0], self.weights(qaf, task_id))
