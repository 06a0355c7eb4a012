"""TorchRL's IQL, TD3+BC and CQL with two features of our method: l1 imitation, and values standardized per task.

Values are standardized within each minibatch, in which all tasks have equally many rows.
"""

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import CQLLoss, IQLLoss, TD3BCLoss

from lw_torchrl.objectives import standardize_by_task


class L1IQLLoss(IQLLoss):
    """IQL with l1 imitation by the mode of the actor. A row's weight is exp(temperature * A), at most ``max_weight``,
    where A is the advantage in standard deviations of its task."""

    def __init__(self, *networks: Any, max_weight: float, **options: Any) -> None:
        super().__init__(*networks, **options)
        self.max_weight = max_weight

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        keys = self.tensor_keys
        with torch.no_grad():
            state = tensordict.select(*self.qvalue_network.in_keys, strict=False)
            each = self._vmap_qvalue_networkN0(state, self.target_qvalue_network_params)
            q = each.get(keys.state_action_value).min(0)[0]
            with self.value_network_params.to_module(self.value_network, preserve_module_state=False):
                state = tensordict.select(*self.value_network.in_keys, strict=False)
                advantage = standardize_by_task(q - self.value_network(state).get(keys.value), tensordict["task_id"])
            weight = (self.temperature * advantage).exp().clamp(max=self.max_weight).squeeze(-1)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            drawn_from = self.actor_network.get_dist(tensordict)
        action = tensordict.get(keys.action)
        tensordict.set(keys.log_prob, drawn_from.log_prob(action).detach())
        distance = (drawn_from.deterministic_sample - action).abs().mean(-1)
        return (weight * distance).sum() / weight.sum(), {}


class L1TD3BCLoss(TD3BCLoss):
    """TD3+BC with l1 imitation; ``alpha`` is the weight of values, in standard deviations of their task."""

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        keys = self.tensor_keys
        state = tensordict.select(*self.actor_network.in_keys, strict=False)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            acted = self.actor_network(state)
        seen = acted.select(*self.qvalue_network.in_keys, strict=False).expand(self.num_qvalue_nets, *acted.batch_size)
        values = self._vmap_qvalue_network00(seen, self._cached_detach_qvalue_network_params)
        q = in_deviations_of_task(values.get(keys.state_action_value)[0], tensordict["task_id"])
        distance = (acted.get(keys.action) - tensordict.get(keys.action)).abs().mean()
        return distance - self.alpha * q.mean(), {"bc_loss": distance.detach()}


class L1CQLLoss(CQLLoss):
    """CQL with additional l1 imitation; ``alpha`` is the weight of values, in standard deviations of their task."""

    def __init__(self, *networks: Any, alpha: float, **options: Any) -> None:
        super().__init__(*networks, **options)
        self.alpha = alpha

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Any]]:
        keys = self.tensor_keys
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            drawn_from = self.actor_network.get_dist(tensordict)
        drawn = drawn_from.rsample()
        log_prob = drawn_from.log_prob(drawn)
        state = tensordict.select(*self.qvalue_network.in_keys, strict=False).set(keys.action, drawn)
        values = self._vmap_qvalue_networkN0(state, self._cached_detach_qvalue_params).get(keys.state_action_value)
        q = in_deviations_of_task(values.min(0)[0], tensordict["task_id"]).squeeze(-1)
        distance = (drawn_from.deterministic_sample - tensordict.get(keys.action)).abs().mean(-1)
        return (distance - self.alpha * q + self._alpha * log_prob).mean(), {keys.log_prob: log_prob.detach()}


def in_deviations_of_task(q: Tensor, task_id: Tensor) -> Tensor:
    """Return values (B, 1) float32 divided by the standard deviation of their task's values in the minibatch."""
    deviation = torch.ones_like(q)
    for task in task_id.unique():
        rows = task_id == task
        deviation[rows] = q[rows].detach().std(correction=0).clamp(min=1e-3)
    return q / deviation
