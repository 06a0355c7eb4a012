"""Actor-critic losses whose actor also imitates the demonstrations in a minibatch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, TD3BCLoss

from lw_torchrl._util.checks import Scale, typed
from lw_torchrl._util.keys import read
from lw_torchrl.objectives.offline import Reduction

if TYPE_CHECKING:
    from torchrl.objectives import LossModule as _Loss
else:
    _Loss = object  # the metaclass of LossModule would wrap the methods of this class


class _ImitatesDemonstrations(_Loss):
    _fixed: Mapping[str, Any] = {}  # options that users cannot change
    _in_keys: list[NestedKey]

    @typed
    def __init__(
        self,
        actor_network: TensorDictModuleBase,
        qvalue_network: TensorDictModuleBase | list[TensorDictModuleBase],
        *,
        bc_weight: Scale = 2.0,
        reduction: Reduction | None = None,
        **options: Any,
    ) -> None:
        spec = options.get("action_spec")
        if spec is not None and not isinstance(spec, Composite) and len(spec.shape) > 1:
            got = f"shape {tuple(spec.shape)}; use env.action_spec_unbatched"
            raise ValueError(f"action_spec must have no batch dimension, got {got}")
        if isinstance(qvalue_network, list) and not qvalue_network:
            raise ValueError("qvalue_network must be at least one critic, got none")
        super().__init__(actor_network, qvalue_network, reduction=reduction, **self._fixed, **options)
        self.bc_weight = bc_weight

    def _set_in_keys(self) -> None:  # TorchRL calls this method when in_keys are first read, and in set_keys
        super()._set_in_keys()
        self._in_keys.append(self.tensor_keys.is_demonstration)

    def _imitation(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Return the squared distance (B,) float32 of actions (B, A) to the demonstrated actions; 0 for all other rows.
        The distance is scaled so that the mean over all rows equals the mean over the demonstrations."""
        key = self.tensor_keys.is_demonstration
        (is_demonstration,) = read(tensordict, [key])
        if is_demonstration.dtype != torch.bool:
            raise ValueError(f"{key!r} must be torch.bool, true for demonstrations, got {is_demonstration.dtype}")
        rows = is_demonstration.reshape(action.shape[:-1])
        distance = (action - tensordict.get(self.tensor_keys.action)).square().mean(-1) * rows
        return distance * (rows.numel() / rows.sum().clamp(min=1))


class DemonstratedTD3Loss(_ImitatesDemonstrations, TD3BCLoss):
    """A TD3 loss on demonstrations and collected rows, in which the actor also imitates the demonstrations.

    The actor's loss is -Q / mean(abs(Q)) over all rows, where Q is the mean over the critics, plus ``bc_weight``
    times the mean squared distance to ``action`` over the rows where ``is_demonstration`` is true (dataset rows, not
    collector rows). The critics' loss is TD3's.

    Reads the keys of TD3 and ``is_demonstration`` (B,) bool. Writes the keys of :class:`torchrl.objectives.TD3BCLoss`:
    ``loss_actor`` and ``loss_qvalue``, () float32 each, and, detached, the unweighted ``bc_loss`` (), ``lmbd`` (),
    which is 1 / mean(abs(Q)), ``state_action_value_actor`` (B,), ``pred_value`` (E, B), ``target_value`` and
    ``next_state_value`` (B,).

    Args:
        actor_network: a deterministic actor.
        qvalue_network: the critic, copied ``num_qvalue_nets`` times.
        bc_weight: weight of the imitation loss.
        **options: keyword arguments of :class:`torchrl.objectives.TD3BCLoss` except ``alpha``, which is 1: ``bounds``
            or ``action_spec``, ``num_qvalue_nets``, ``policy_noise``, ...

    Raises:
        ValueError: ``action_spec`` has a batch dimension; at call time, ``is_demonstration`` is missing.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor, critic = lw.PlanConditionedActor(plans), lw.PlanConditionedQValue(plans)
        >>> loss = lw.objectives.DemonstratedTD3Loss(actor, critic, bounds=(-1.0, 1.0))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> "is_demonstration" in loss.in_keys
        True

    Source: Fujimoto and Gu, 'A Minimalist Approach to Offline Reinforcement Learning' (TD3+BC); Ball et al., 'Efficient
    Online Reinforcement Learning with Offline Data', for batches that are half demonstrations, half collected rows.
    """

    @dataclass
    class _AcceptedKeys(TD3BCLoss._AcceptedKeys):
        is_demonstration: NestedKey = "is_demonstration"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    _fixed = {"alpha": 1.0}

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        """Return the actor's loss, () float32, and detached values to log."""
        outputs = tensordict.select(*self.actor_network.in_keys, strict=False)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            outputs = self.actor_network(outputs)
        rows = outputs.select(*self.qvalue_network.in_keys, strict=False)
        judged = self._vmap_qvalue_network00(
            rows.expand(self.num_qvalue_nets, *rows.batch_size), self._cached_detach_qvalue_network_params
        )
        # TD3BCLoss uses only the first critic; the mean over all critics is smoother.
        value = judged.get(self.tensor_keys.state_action_value).squeeze(-1).mean(0)
        bc = self._imitation(tensordict, outputs.get(self.tensor_keys.action))
        scale = self.alpha / value.abs().mean().detach().clamp(min=1e-6)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce_loss(self.bc_weight * bc - scale * value, tensordict=tensordict, weights=weights)
        self._clear_weakrefs(tensordict, "actor_network_params", "qvalue_network_params")
        return loss, {"state_action_value_actor": value.detach(), "bc_loss": bc.mean().detach(), "lmbd": scale}


class DemonstratedSACLoss(_ImitatesDemonstrations, SACLoss):
    """A SAC loss on demonstrations and collected rows, in which the actor also imitates the demonstrations.

    The actor's loss is SAC's over all rows, plus ``bc_weight`` times the imitation loss of
    :class:`DemonstratedTD3Loss`, computed for the distribution's mode. The imitation loss is a distance instead of a
    likelihood because half of the demonstrated actions have a component at ±1, where the likelihood of a TanhNormal
    explodes. Raises the same errors as :class:`DemonstratedTD3Loss`.

    Reads the keys of SAC and ``is_demonstration`` (B,) bool. Writes the keys of :class:`torchrl.objectives.SACLoss`:
    ``loss_actor``, ``loss_qvalue``, ``loss_alpha``, ``alpha`` and ``entropy``, () float32 each.

    Args:
        actor_network: a stochastic actor, for example ``actor.stochastic()``.
        qvalue_network: the critic, copied ``num_qvalue_nets`` times.
        bc_weight: weight of the imitation loss; Q is not normalized.
        **options: keyword arguments of :class:`torchrl.objectives.SACLoss`.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans).stochastic("tanh_normal", init_std=0.2)
        >>> loss = lw.objectives.DemonstratedSACLoss(actor, lw.PlanConditionedQValue(plans), bc_weight=2.0)
        >>> loss.make_value_estimator(gamma=0.99)

    Source: Haarnoja et al., 'Soft Actor-Critic Algorithms and Applications', with an imitation loss.
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        is_demonstration: NestedKey = "is_demonstration"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the actor's loss, () float32, and detached values to log."""
        loss, metadata = super().actor_loss(tensordict)
        with (
            set_exploration_type(ExplorationType.DETERMINISTIC),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            mode = self.actor_network.get_dist(tensordict.copy()).deterministic_sample
        bc = self._imitation(tensordict, mode)
        weights = self._maybe_get_priority_weight(tensordict)
        term = self._reduce_loss(self.bc_weight * bc, tensordict=tensordict, weights=weights)
        return loss + term, {**metadata, "bc_loss": bc.mean().detach()}
