"""n steps for the losses of TorchRL that hide them from their value estimators."""

from __future__ import annotations

from tensordict import TensorDictBase
from torchrl.objectives import IQLLoss, LossModule, REDQLoss

from lw_torchrl._checks import checked

_STEPS = "steps_to_next_obs"
_HIDE = (IQLLoss, REDQLoss)


@checked
def with_n_steps(loss: LossModule, batch: TensorDictBase) -> TensorDictBase:
    """A minibatch whose n steps the loss's value estimator sees: ``loss(with_n_steps(loss, batch))``.

    TorchRL's :class:`~torchrl.objectives.IQLLoss` and :class:`~torchrl.objectives.REDQLoss` show their estimator what
    is under ``"next"`` alone. ``steps_to_next_obs`` is not there, so that they would bootstrap as if one step lay
    between. This sets it there, too, and has the estimator read it. For other losses, and rows without
    ``steps_to_next_obs``, it does nothing.

    Args:
        loss: any loss; call ``make_value_estimator`` before.
        batch: rows of a buffer, ``steps_to_next_obs`` (B,) int64 among them.

    Returns:
        ``batch`` itself, with ``("next", "steps_to_next_obs")`` (B,) int64 where it is needed.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import IQLLoss
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans, distribution="tanh_normal")
        >>> loss = IQLLoss(actor, lw.PlanConditionedQValue(plans), lw.PlanConditionedValue(plans))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> batch = TensorDict(steps_to_next_obs=torch.tensor([5, 2]), next=TensorDict(), batch_size=[2])
        >>> with_n_steps(loss, batch)["next", "steps_to_next_obs"].tolist()
        [5, 2]

    Source: Sutton, Barto, "Reinforcement Learning", section 7.1.
    """
    steps = batch.get(_STEPS, None)
    if steps is None or not isinstance(loss, _HIDE):
        return batch
    loss.value_estimator.set_keys(steps_to_next_obs=("next", _STEPS))
    return batch.set(("next", _STEPS), steps)
