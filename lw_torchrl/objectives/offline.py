"""Offline losses: state values by expectile regression, advantage-weighted imitation, and n-step targets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import IQLLoss, LossModule, REDQLoss, ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss

from lw_torchrl._util.checks import Positive, Probability, Scale, typed
from lw_torchrl._util.devices import check_finite
from lw_torchrl._util.keys import read
from lw_torchrl.modules.parts import evaluating

Reduction = Literal["none", "mean", "sum"]


class ExpectileValueLoss(LossModule):
    """A loss that trains a state-value network V by expectile regression, without a state-action value network.

    The loss of a row is |τ - 1(u < 0)|·u², where u is the target minus V. The target is the reward plus the discounted
    value of the target network in the next state (n time steps ahead if the rows have ``steps_to_next_obs``). With an
    expectile above 0.5, V approaches the value of the better actions. :class:`AdvantageWeightedLoss` uses u as the
    advantage.

    Reads the network's input keys, also in ``next``; ``("next", "reward")`` (B, 1) float32; ``("next", "done")`` and
    ``("next", "terminated")`` (B, 1) bool; and, if present, ``steps_to_next_obs`` (B,) int64 and ``priority_weight``
    (B,) float32. Returns ``loss_value`` () float32, or (B,) with ``reduction="none"``, and ``value`` () float32, the
    detached mean of V. Writes ``td_error`` (B,) float32, a row's largest u², into its input.

    Args:
        value_network: a module that writes ``state_value`` (B, 1) float32. If it also writes ``state_values`` (B, E)
            float32, like a :class:`PlanConditionedValue` ensemble, each member has its own loss; the losses are added.
        expectile: τ, from 0 to 1.
        delay_value: compute targets with a target network, which :class:`torchrl.objectives.SoftUpdate` updates.
        reduction: "mean", "none" or "sum" over the rows.

    Raises:
        ValueError: at call time, the network does not write a required key, or the rows lack a key.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import SoftUpdate
        >>> plans = lw.load_plans("MT10")
        >>> loss = lw.objectives.ExpectileValueLoss(lw.PlanConditionedValue(plans, ensemble=2), expectile=0.7)
        >>> loss = loss.make_value_estimator(gamma=0.99)
        >>> targets = SoftUpdate(loss, eps=0.995)
        >>> state = {"observation": torch.rand(5, 39), "task_id": torch.full((5,), lw.task_id("reach"))}
        >>> state["qaf"] = torch.rand(5, plans.num_steps) > 0.5
        >>> ended = torch.zeros(5, 1, dtype=torch.bool)
        >>> next = TensorDict(**state, reward=torch.ones(5, 1), done=ended, terminated=ended)
        >>> batch = TensorDict(**state, next=next).auto_batch_size_(1)
        >>> loss(batch)["loss_value"].shape, loss.advantage(batch).shape
        (torch.Size([]), torch.Size([5, 1]))

    Source: Kostrikov, Nair, Levine, "Offline Reinforcement Learning with Implicit Q-Learning", 2021, equation 5,
    without Q; n-step targets as in Sutton, Barto, "Reinforcement Learning", section 7.1.
    """

    @dataclass
    class _AcceptedKeys:
        value: NestedKey = "state_value"
        values: NestedKey = "state_values"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    _value_estimator_default_keys = ("value", "reward", "done", "terminated", "steps_to_next_obs")
    out_keys = ["loss_value", "value"]
    reduction = "mean"

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    @typed
    def __init__(
        self,
        value_network: TensorDictModuleBase,
        *,
        expectile: Probability = 0.7,
        delay_value: bool = True,
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__()
        if reduction not in (None, self.reduction):  # checkpoints describe only attributes that differ from the class
            self.reduction = reduction
        self.expectile = expectile
        self.convert_to_functional(value_network, "value_network", create_target_params=delay_value)

    @property
    def in_keys(self) -> list[NestedKey]:
        inputs, keys = self.value_network.in_keys, self.tensor_keys
        following = [*inputs, keys.reward, keys.done, keys.terminated]
        return list(dict.fromkeys([*inputs, *(unravel_key(("next", key)) for key in following)]))

    def make_value_estimator(self, value_type: Any = None, **hyperparams: Any) -> ExpectileValueLoss:
        """Set the estimator of the targets, and return this loss.

        Args:
            value_type: an estimator, an estimator class, or ``ValueEstimators.TD0``; None for TD0. Other members of
                ``ValueEstimators`` need rows in time order, and raise a :class:`NotImplementedError`.
            **hyperparams: ``gamma``, the discount per time step, by default 0.99.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        if not isinstance(value_type, (str, ValueEstimators)):
            return super().make_value_estimator(value_type, **hyperparams)
        keys = {name: getattr(self.tensor_keys, name) for name in self._value_estimator_default_keys}
        options = {"supported": (ValueEstimators.TD0,), "tensor_keys": keys, "value_network": None}
        dispatch_value_estimator(self, value_type, **options, **hyperparams)
        return self

    def train(self, mode: bool = True) -> ExpectileValueLoss:
        """Set the mode of the loss and of the network, which is not a submodule of the loss."""
        self.value_network.train(mode)
        return super().train(mode)

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the losses, and write ``td_error``."""
        target = self._target(tensordict)
        values = self._values(tensordict, self.value_network_params)
        error = target - values  # (B, E)
        weight = torch.where(error < 0, 1.0 - self.expectile, self.expectile)
        tensordict.set(self.tensor_keys.priority, error.detach().square().amax(-1))
        by_row, weights = (weight * error.square()).sum(-1), self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(by_row, tensordict, weights=weights)
        losses = TensorDict(loss_value=loss, value=values.detach().mean())
        self._clear_weakrefs(tensordict, losses, "value_network_params", "target_value_network_params")
        return losses

    @torch.no_grad()
    def advantage(self, tensordict: TensorDictBase) -> Tensor:
        """Return each row's advantage (B, 1) float32: the target minus the mean value of the target network in eval
        mode."""
        with evaluating(self.value_network):
            value = self._values(tensordict, self.target_value_network_params).mean(-1, keepdim=True)
            return self._target(tensordict) - value

    @torch.no_grad()
    def _target(self, tensordict: TensorDictBase) -> Tensor:
        next_value = self._values(tensordict.get("next"), self.target_value_network_params).mean(-1, keepdim=True)
        # The estimator may write averaged rewards into its input, so pass a copy.
        return self.value_estimator.value_estimate(tensordict.copy(), next_value=next_value)

    def _values(self, tensordict: TensorDictBase, params: TensorDictParams) -> Tensor:
        """Return the values (B, E) of the ensemble's members."""
        network, keys = self.value_network, self.tensor_keys
        key = keys.values if unravel_key(keys.values) in network.out_keys else keys.value
        # An ensemble also writes the minimum, but each member needs a loss on its own value.
        is_ensemble = len(getattr(network, "heads", ())) > 1
        if unravel_key(key) not in network.out_keys or (is_ensemble and key != keys.values):
            needed = keys.values if is_ensemble else keys.value
            raise ValueError(f"value_network must write {needed!r}, got {network.out_keys}; use loss.set_keys(...)")
        with params.to_module(network, preserve_module_state=False):
            # Pass all keys, because networks also read optional keys: RandomYaw's angle, qaf_plan.
            (values,) = read(network(tensordict.copy()), [key])
        return values


class AdvantageWeightedLoss(LossModule):
    """An imitation loss that weights each row by exp(β·A), capped at ``max_weight``, where A is the row's advantage.

    Reads the actor's input keys, ``action`` (B, 4) float32, and ``advantage`` (B, 1) float32, which
    :meth:`ExpectileValueLoss.advantage` returns and :func:`standardize_by_task` standardizes. Returns ``loss_actor`` ()
    float32, or (B,) with ``reduction="none"``, and, detached, ``weight_clipped`` () float32, the fraction of rows with
    the maximum weight, and ``ESS`` () float32 in (0, 1], the effective sample size divided by B.

    Args:
        actor_network: an actor; for an actor with a distribution, the distance uses the mode.
        beta: β, in units of 1 / advantage. With 0, the loss is :class:`torchrl.objectives.BCLoss`.
        max_weight: maximum weight, above 0.
        loss_function: "l2", "l1" or "smooth_l1", the mean distance over the action's components; or "log_prob", the
            negative log-probability of the action, for an actor with a distribution.
        reduction: "mean", the weighted mean; "none", each row's distance times its weight; or "sum", the weighted sum.

    Raises:
        ValueError: at call time, a key is missing, or the advantage is not (B, 1) or not finite.
        RuntimeError: the shapes of the actor's action and of the action to imitate differ.
        TypeError: the loss function is "log_prob", but the actor has no distribution.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> loss = lw.objectives.AdvantageWeightedLoss(lw.modules.DescriptorConditionedActor("MT10"), beta=3.0)
        >>> reach = torch.full((5,), lw.task_id("reach"))
        >>> batch = TensorDict(observation=torch.rand(5, 39), task_id=reach, action=torch.rand(5, 4))
        >>> batch["advantage"] = torch.randn(5, 1)
        >>> sorted(loss(batch.auto_batch_size_(1)).keys())
        ['ESS', 'loss_actor', 'weight_clipped']

    Source: Peng, Kumar, Zhang, Levine, "Advantage-Weighted Regression", 2019, equation 10 and section 3.3; Nair et al.,
    "AWAC", 2020, for the weighted mean.
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

    @typed
    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        *,
        beta: Scale = 1.0,
        max_weight: Positive = 20.0,
        loss_function: Literal["l2", "l1", "smooth_l1", "log_prob"] = "l2",
        reduction: Reduction | None = None,
    ) -> None:
        super().__init__()
        if reduction not in (None, self.reduction):  # checkpoints describe only attributes that differ from the class
            self.reduction = reduction
        self.beta, self.max_weight, self.loss_function = beta, max_weight, loss_function
        self.convert_to_functional(actor_network, "actor_network")

    @property
    def in_keys(self) -> list[NestedKey]:
        return list(dict.fromkeys([*self.actor_network.in_keys, self.tensor_keys.action, self.tensor_keys.advantage]))

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return the loss and the logged values, without changing the input."""
        action, advantage = read(tensordict, [self.tensor_keys.action, self.tensor_keys.advantage])
        if advantage.shape != (*tensordict.batch_size, 1) or advantage.dtype != action.dtype:
            got = f"shape {tuple(advantage.shape)} in {advantage.dtype}"
            raise ValueError(f"advantage must be {(*tensordict.batch_size, 1)} in {action.dtype}, got {got}")
        check_finite("advantage", advantage)
        logs, most = self.beta * advantage.detach().squeeze(-1), math.log(self.max_weight)
        # A weighted mean depends only on the ratios of the weights. After division by the largest weight, they cannot
        # all underflow.
        largest = logs.max().clamp(max=most) if self.reduction == "mean" else 0.0
        weights = (logs.clamp(max=most) - largest).exp()
        loss = self._reduce_loss(self._distance(tensordict, action), tensordict, weights=weights)
        losses = TensorDict(
            loss_actor=loss,
            weight_clipped=(logs > most).to(weights.dtype).mean(),
            ESS=weights.sum().square() / weights.square().sum() / weights.numel(),
        )
        self._clear_weakrefs(tensordict, losses, "actor_network_params")
        return losses

    def _distance(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Return the distance (B,) between the actor's action and the action to imitate in each row."""
        inputs = tensordict.exclude(self.tensor_keys.action)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            if self.loss_function == "log_prob":
                return -self.actor_network.get_dist(inputs).log_prob(action)
            (predicted,) = read(self.actor_network(inputs), [self.tensor_keys.action])
        return distance_loss(predicted, action, self.loss_function).mean(-1)


@typed
def standardize_by_task(advantage: Tensor, task_id: Tensor) -> Tensor:
    """Standardize advantages to mean 0 and standard deviation 1 over each task's rows, to weight tasks equally.

    Args:
        advantage: (R, 1) float32, finite.
        task_id: (R,) int64, the task of each row.

    Returns:
        (R, 1) float32; 0 for a task whose advantages are all equal.

    Raises:
        ValueError: a shape or dtype is wrong, or an advantage is NaN or infinite.

    Example:
        >>> import torch
        >>> standardize_by_task(torch.tensor([[1.0], [3.0], [7.0]]), torch.tensor([4, 4, 9])).tolist()
        [[-1.0], [1.0], [0.0]]
    """
    given = [(tuple(tensor.shape), tensor.dtype) for tensor in (advantage, task_id)]
    if given != [((*task_id.shape[:1], 1), torch.float32), (tuple(task_id.shape[:1]), torch.int64)]:
        raise ValueError(f"advantage must be (R, 1) float32 and task_id (R,) int64, got {given}")
    check_finite("advantage", advantage)
    standardized = torch.zeros_like(advantage)
    for task in task_id.unique():
        rows = task_id == task
        own = advantage[rows].detach().double()
        if own.max() > own.min():  # otherwise only rounding errors would remain
            standardized[rows] = ((own - own.mean()) / own.std(correction=0)).to(advantage.dtype)
    return standardized


@typed
def with_n_steps(loss: LossModule, batch: TensorDictBase) -> TensorDictBase:
    """Prepare a batch of n-step rows and the loss's value estimator for ``loss(with_n_steps(loss, batch))``.

    TorchRL's :class:`~torchrl.objectives.IQLLoss` and :class:`~torchrl.objectives.REDQLoss` pass only ``next`` to the
    estimator, so this function copies ``steps_to_next_obs`` into ``next`` and sets the estimator's key. For any other
    loss, or without ``steps_to_next_obs``, nothing changes.

    Args:
        loss: any loss whose ``make_value_estimator`` was called.
        batch: rows of a replay buffer, with ``steps_to_next_obs`` (B,) int64.

    Returns:
        ``batch``, with ``("next", "steps_to_next_obs")`` (B,) int64 if the loss needs this key.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from tensordict import TensorDict
        >>> from torchrl.objectives import IQLLoss
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans).stochastic("normal")
        >>> loss = IQLLoss(actor, lw.PlanConditionedQValue(plans), lw.PlanConditionedValue(plans))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> batch = TensorDict(steps_to_next_obs=torch.tensor([5, 2]), next=TensorDict(), batch_size=[2])
        >>> with_n_steps(loss, batch)["next", "steps_to_next_obs"].tolist()
        [5, 2]

    Source: Sutton, Barto, "Reinforcement Learning", section 7.1.
    """
    steps = batch.get("steps_to_next_obs", None)
    if steps is None or not isinstance(loss, (IQLLoss, REDQLoss)):
        return batch
    key = ("next", "steps_to_next_obs")
    loss.value_estimator.set_keys(steps_to_next_obs=key)
    return batch.set(key, steps)
