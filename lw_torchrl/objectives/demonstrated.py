"""Actor-critic losses with imitation, of those rows of a minibatch alone that are demonstrations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SACLoss, TD3BCLoss

from lw_torchrl._checks import check_scale


def imitation(action: Tensor, demonstrated: Tensor, is_target: Tensor) -> Tensor:
    """The squared distance to the demonstrated action, of each row: (B,) float32.

    It is 0 in rows that are no demonstrations, and scaled so that its mean over all rows is the mean over
    demonstrations; 0 where there are none.

    Args:
        action, demonstrated: (B, A) float32.
        is_target: (B,) or (B, 1) bool, false of demonstrations.

    Example:
        >>> import torch
        >>> one, other = torch.zeros(4, 2), torch.tensor([[9.0, 9.0], [9.0, 9.0], [1.0, 1.0], [0.0, 2.0]])
        >>> imitation(one, other, torch.tensor([True, True, False, False])).mean()
        tensor(1.5000)
    """
    rows = ~is_target.reshape(action.shape[:-1])
    distance = (action - demonstrated).square().mean(-1) * rows
    return distance * (rows.numel() / rows.sum().clamp(min=1))


class DemonstratedTD3Loss(TD3BCLoss):
    """TD3 on a collector's rows and demonstrations alike, whose actor also imitates the demonstrations.

    The actor's loss is -Q / mean(abs(Q)) over all rows, where Q is the mean of the critics, plus ``bc_weight`` times
    the mean squared distance to ``action`` over the rows that are demonstrations: those of which ``is_target`` is
    false, as :class:`~lw_torchrl.CoLearningSampler` of the target "grown" says. The critics' loss is TD3's.

    Reads what TD3 reads, and ``is_target`` (B,) bool; writes what :class:`torchrl.objectives.TD3BCLoss` does:
    ``loss_actor`` and ``loss_qvalue``, () float32 each, and, detached, ``bc_loss`` (), without its weight, ``lmbd`` (),
    what Q is divided by inverted, ``state_action_value_actor`` (B,), ``pred_value`` (E, B), ``target_value`` and
    ``next_state_value`` (B,).

    Args:
        actor_network: without a distribution.
        qvalue_network: of which ``num_qvalue_nets`` copies are made.
        bc_weight: of the imitation.
        **options: of :class:`torchrl.objectives.TD3BCLoss`, but for ``alpha``, which is 1: ``bounds`` or
            ``action_spec``, ``num_qvalue_nets``, ``policy_noise``, ...

    Raises:
        ValueError: ``bc_weight`` is negative or no number.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.objectives import SoftUpdate
        >>> plans = lw.load_plans("MT10")
        >>> actor, critic = lw.PlanConditionedActor(plans), lw.PlanConditionedQValue(plans)
        >>> loss = lw.DemonstratedTD3Loss(actor, critic, bounds=(-1.0, 1.0))
        >>> loss.make_value_estimator(gamma=0.99)
        >>> targets = SoftUpdate(loss, eps=0.995)
        >>> "is_target" in loss.in_keys
        True

    Source: Fujimoto and Gu, 'A Minimalist Approach to Offline Reinforcement Learning' (TD3+BC); Ball et al., 'Efficient
    Online Reinforcement Learning with Offline Data', for equal shares of demonstrations.
    """

    @dataclass
    class _AcceptedKeys(TD3BCLoss._AcceptedKeys):
        """The names that ``set_keys`` takes: TD3BCLoss's, and ``is_target``, false of rows that are demonstrations."""

        is_target: NestedKey = "is_target"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        bc_weight: float = 2.0,
        **options: Any,
    ) -> None:
        if "alpha" in options:
            raise ValueError("alpha is 1 here: give bc_weight, the weight of the imitation")
        super().__init__(actor_network, qvalue_network, alpha=1.0, **options)
        self.bc_weight = check_scale("bc_weight", bc_weight)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        self._in_keys: list[NestedKey] = list({*self._in_keys, self.tensor_keys.is_target})

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict]:
        """The actor's loss, () float32, and ``bc_loss``, ``lmbd`` and ``state_action_value_actor``, detached."""
        weights = self._maybe_get_priority_weight(tensordict)
        seen = tensordict.select(*self.actor_network.in_keys, strict=False)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            seen = self.actor_network(seen)
        asked = seen.select(*self.qvalue_network.in_keys, strict=False).expand(self.num_qvalue_nets, *seen.batch_size)
        values = self._vmap_qvalue_network00(asked, self._cached_detach_qvalue_network_params)
        value = values.get(self.tensor_keys.state_action_value).squeeze(-1).mean(0)
        key = self.tensor_keys.action
        bc = imitation(seen.get(key), tensordict.get(key), tensordict.get(self.tensor_keys.is_target))
        scale = self.alpha / value.abs().mean().detach().clamp(min=1e-6)
        loss = self._reduce_loss(self.bc_weight * bc - scale * value, tensordict=tensordict, weights=weights)
        self._clear_weakrefs(
            tensordict,
            "actor_network_params",
            "qvalue_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
        )
        return loss, {"state_action_value_actor": value.detach(), "bc_loss": bc.mean().detach(), "lmbd": scale}


class DemonstratedSACLoss(SACLoss):
    """SAC on a collector's rows and demonstrations alike, whose actor also imitates the demonstrations.

    The actor's loss is SAC's over all rows, plus ``bc_weight`` times the mean squared distance of the distribution's
    mode to ``action`` over the rows that are demonstrations, of which ``is_target`` is false. It is a distance and no
    likelihood, since half of the demonstrated actions have a component at ±1, where that of a TanhNormal explodes.

    Reads what SAC reads, and ``is_target`` (B,) bool; writes what :class:`torchrl.objectives.SACLoss` does:
    ``loss_actor``, ``loss_qvalue``, ``loss_alpha``, ``alpha`` and ``entropy``, () float32 each.

    Args:
        actor_network: with a distribution, ``actor.stochastic()`` say.
        qvalue_network: of which ``num_qvalue_nets`` copies are made.
        bc_weight: of the imitation. Values are not divided by their size, as those of :class:`DemonstratedTD3Loss` are.
        **options: of :class:`torchrl.objectives.SACLoss`.

    Raises:
        ValueError: ``bc_weight`` is negative or no number.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.objectives import SoftUpdate
        >>> plans = lw.load_plans("MT10")
        >>> actor = lw.PlanConditionedActor(plans).stochastic("tanh_normal", init_std=0.2)
        >>> loss = lw.DemonstratedSACLoss(actor, lw.PlanConditionedQValue(plans), bc_weight=2.0)
        >>> loss.make_value_estimator(gamma=0.99)
        >>> targets = SoftUpdate(loss, eps=0.995)

    Source: Haarnoja et al., 'Soft Actor-Critic Algorithms and Applications', with the term of
    :class:`DemonstratedTD3Loss`.
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        """The names that ``set_keys`` takes: SACLoss's, and ``is_target``, false of rows that are demonstrations."""

        is_target: NestedKey = "is_target"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        bc_weight: float = 2.0,
        **options: Any,
    ) -> None:
        super().__init__(actor_network, qvalue_network, **options)
        self.bc_weight = check_scale("bc_weight", bc_weight)

    def _set_in_keys(self) -> None:
        super()._set_in_keys()
        self._in_keys: list[NestedKey] = list({*self._in_keys, self.tensor_keys.is_target})

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, () float32, and ``log_prob`` and ``bc_loss``, detached."""
        loss, metadata = super().actor_loss(tensordict)
        weights = self._maybe_get_priority_weight(tensordict)
        with (
            set_exploration_type(ExplorationType.DETERMINISTIC),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            mode = self.actor_network.get_dist(tensordict.copy()).deterministic_sample
        bc = imitation(mode, tensordict.get(self.tensor_keys.action), tensordict.get(self.tensor_keys.is_target))
        term = self._reduce_loss(self.bc_weight * bc, tensordict=tensordict, weights=weights)
        return loss + term, {**metadata, "bc_loss": bc.mean().detach()}
