"""AdvantageWeightedLoss: imitation of the rows that did better than others."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.utils import distance_loss

from lw_torchrl._checks import check_choice, check_scale, checked
from lw_torchrl._keys import read
from lw_torchrl.language.value_checks import check_finite
from lw_torchrl.objectives.reduction import Reduction, let_go, set_reduction

DISTANCES = ("l2", "l1", "smooth_l1", "log_prob")


class AdvantageWeightedLoss(LossModule):
    """Imitation of a batch's actions, each row as much as its advantage A says: weight exp(β·A), at most
    ``max_weight``, and the mean over the batch by these weights.

    Reads what the actor reads, ``action`` (B, 4) float32, the action to imitate, and ``advantage`` (B, 1) float32,
    which :meth:`ExpectileValueLoss.advantage` gives and :func:`standardize_by_task` makes comparable. Gives
    ``loss_actor`` () float32, (B,) by ``reduction="none"``, and, detached, ``weight_clipped`` () float32, the share of
    rows whose weight is the largest that may be, and ``ESS`` () float32, in (0, 1], the effective sample size over B,
    as TorchRL's PPO gives.

    Args:
        actor_network: an actor; its mode is compared where it has a distribution.
        beta: β, in one over the advantage's unit. With 0 this is :class:`torchrl.objectives.BCLoss`.
        max_weight: the largest weight, over 0.
        loss_function: "l2", "l1" or "smooth_l1", the distance to the action, the mean over its numbers, or "log_prob",
            less the action's log-probability, for an actor with a distribution.
        reduction: "mean", by the weights; "none", each row's distance times its weight; or "sum", the sum of these.

    Raises:
        ValueError: a wrong option; at call time, a missing key, an advantage that is not (B, 1) or not finite.
        RuntimeError: the actor's action has another shape than the one to imitate.
        TypeError: "log_prob" for an actor of ours without a distribution.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> loss = lw.objectives.AdvantageWeightedLoss(lw.DescriptorConditionedActor("MT10"), beta=3.0)
        >>> reach = torch.full((5,), lw.task_id("reach"))
        >>> batch = TensorDict(observation=torch.rand(5, 39), task_id=reach, action=torch.rand(5, 4))
        >>> batch["advantage"] = torch.randn(5, 1)
        >>> sorted(loss(batch.auto_batch_size_(1)).keys())
        ['ESS', 'loss_actor', 'weight_clipped']

    Source: Peng, Kumar, Zhang, Levine, "Advantage-Weighted Regression", 2019, equation 10 and section 3.3; Nair et al.,
    "AWAC", 2020, for the mean by weights.
    """

    @dataclass
    class _AcceptedKeys:
        action: NestedKey = "action"
        advantage: NestedKey = "advantage"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys = ["loss_actor", "weight_clipped", "ESS"]
    reduction = "mean"

    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    @checked
    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        *,
        beta: float = 1.0,
        max_weight: float = 20.0,
        loss_function: Literal["l2", "l1", "smooth_l1", "log_prob"] = "l2",
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__()
        set_reduction(self, reduction)
        self.beta = check_scale("beta", beta)
        self.max_weight = check_scale("max_weight", max_weight)
        if not self.max_weight:
            raise ValueError("max_weight must be over 0, got 0")
        self.loss_function = check_choice("loss_function", loss_function, DISTANCES)
        self.convert_to_functional(actor_network, "actor_network")

    @property
    def in_keys(self) -> list[NestedKey]:
        keys = [*self.actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.advantage]
        return list(dict.fromkeys(keys))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The loss; what is given stays as it is."""
        action, advantage = read(tensordict, [self.tensor_keys.action, self.tensor_keys.advantage])
        if advantage.shape != (*tensordict.batch_size, 1) or advantage.dtype != action.dtype:
            raise ValueError(
                f"advantage must be {(*tensordict.batch_size, 1)}, a number for each row, in the action's "
                f"{action.dtype}, got shape {tuple(advantage.shape)} in {advantage.dtype}"
            )
        check_finite("advantage", advantage)
        logs, most = self.beta * advantage.detach().squeeze(-1), math.log(self.max_weight)
        # In a mean only the weights' ratios count: over the largest of the batch they cannot all vanish.
        largest = logs.max().clamp(max=most) if self.reduction == "mean" else 0.0
        weights = (logs.clamp(max=most) - largest).exp()
        loss = self._reduce_loss(self._distance(tensordict, action), tensordict, weights=weights)
        found = TensorDict(
            loss_actor=loss,
            weight_clipped=(logs > most).to(weights.dtype).mean(),
            ESS=weights.sum().square() / weights.square().sum() / weights.numel(),
        )
        let_go(tensordict, found, self.actor_network_params)
        return found

    def _distance(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """(B,)"""
        seen = tensordict.exclude(self.tensor_keys.action)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            if self.loss_function == "log_prob":
                return -self.actor_network.get_dist(seen).log_prob(action)
            (predicted,) = read(self.actor_network(seen), [self.tensor_keys.action])
        return distance_loss(predicted, action, self.loss_function).mean(-1)


@checked
def standardize_by_task(advantage: Tensor, task_id: Tensor) -> Tensor:
    """Advantages in standard deviations of their task, about its mean.

    Rewards of tasks differ in scale, and a mean weight should be no task's alone.

    Args:
        advantage: (R, 1) float32, finite.
        task_id: (R,) int64, the task of each row.

    Returns:
        (R, 1) float32, of each task with mean 0 and standard deviation 1 (over its rows, not one less); 0 where all
        rows of a task have the same, or it has one row.

    Raises:
        ValueError: other shapes or types, NaN or infinity.

    Example:
        >>> import torch
        >>> standardize_by_task(torch.tensor([[1.0], [3.0], [7.0]]), torch.tensor([4, 4, 9])).tolist()
        [[-1.0], [1.0], [0.0]]
    """
    if advantage.dtype != torch.float32 or advantage.ndim != 2 or advantage.shape[1] != 1:
        raise ValueError(f"advantage must be (R, 1) float32, got {tuple(advantage.shape)} {advantage.dtype}")
    if task_id.dtype != torch.int64 or task_id.shape != advantage.shape[:1]:
        raise ValueError(
            f"task_id must be ({len(advantage)},) int64, a task for each row of advantage, got "
            f"{tuple(task_id.shape)} {task_id.dtype}"
        )
    if not advantage.isfinite().all():
        raise ValueError("advantage must hold finite numbers, got NaN or infinity")
    found = torch.zeros_like(advantage)
    for task in task_id.unique():
        rows = task_id == task
        own = advantage[rows].detach().double()
        if own.max() > own.min():  # else the mean's rounding would be all there is
            found[rows] = ((own - own.mean()) / own.std(correction=0)).to(found.dtype)
    return found
