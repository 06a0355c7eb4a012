"""How losses read a minibatch: n-step rows, a sampler's weights, and the reduction over rows."""

from __future__ import annotations

from typing import Literal

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import IQLLoss, LossModule, REDQLoss

from lw_torchrl._util.checks import typed

Reduction = Literal["none", "mean", "sum"]
_STEPS = "steps_to_next_obs"


def set_reduction(loss: LossModule, reduction: Reduction | None) -> None:
    """Set a reduction other than the class's "mean"; checkpoints describe only what differs from the class."""
    if reduction not in (None, loss.reduction):
        loss.reduction = reduction


def priority_weight(loss: LossModule, tensordict: TensorDictBase) -> Tensor | None:
    """Return the weights (B,) of a ``PrioritizedSampler``; None without them, or if the loss ignores them."""
    return tensordict.get(loss.tensor_keys.priority_weight, None) if loss.use_prioritized_weights else None


def clear_references(*tensordicts: TensorDictBase) -> None:
    """Drop the references of tensordicts to modules, which ``torch.compile`` cannot trace."""
    if torch.compiler.is_compiling():
        for tensordict in tensordicts:
            tensordict.clear_refs_for_compile_()


@typed
def with_n_steps(loss: LossModule, batch: TensorDictBase) -> TensorDictBase:
    """Make a loss's value estimator read n-step rows: ``loss(with_n_steps(loss, batch))``.

    TorchRL's :class:`~torchrl.objectives.IQLLoss` and :class:`~torchrl.objectives.REDQLoss` only pass ``next`` to the
    estimator, so this copies ``steps_to_next_obs`` there. Other losses and rows are left alone.

    Args:
        loss: any loss; call ``make_value_estimator`` before.
        batch: rows of a buffer, with ``steps_to_next_obs`` (B,) int64.

    Returns:
        ``batch``, with ``("next", "steps_to_next_obs")`` (B,) int64 if the loss needs it.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import IQLLoss
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans).stochastic("tanh_normal")
        >>> loss = IQLLoss(actor, lw.PlanConditionedQValue(plans), lw.PlanConditionedValue(plans))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> batch = TensorDict(steps_to_next_obs=torch.tensor([5, 2]), next=TensorDict(), batch_size=[2])
        >>> with_n_steps(loss, batch)["next", "steps_to_next_obs"].tolist()
        [5, 2]

    Source: Sutton, Barto, "Reinforcement Learning", section 7.1.
    """
    steps = batch.get(_STEPS, None)
    if steps is None or not isinstance(loss, (IQLLoss, REDQLoss)):
        return batch
    loss.value_estimator.set_keys(steps_to_next_obs=("next", _STEPS))
    return batch.set(("next", _STEPS), steps)
