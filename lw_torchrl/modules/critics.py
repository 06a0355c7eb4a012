"""Critics: networks that estimate the values of states or actions, built on a policy's trunk."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from tensordict.utils import NestedKey
from torch import nn

from lw_torchrl._util.checks import Count, Natural, typed
from lw_torchrl._util.keys import Keys, as_keys, check_apart, dispatched, read, write
from lw_torchrl.language.plans import AnyPlans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.parts import MLP, RenamedInputs, Width, encoding_keys, encoding_width, materialize
from lw_torchrl.modules.plan_conditioned_actor import plan_trunk
from lw_torchrl.modules.policy import layout_of, plans_of


class Value(RenamedInputs):
    """A state-value network: a trunk with one or more value heads.

    Reads the trunk's input keys; writes ``state_value`` (B, 1) float32, the minimum over the heads, and, with several
    heads, ``state_values`` (B, E) float32.

    Args:
        trunk: the layers before the heads, such as :func:`plan_trunk`, or ``actor.trunk``, to share these layers with
            the actor. The last two keys that the trunk writes are a latent (B, D) and features (B, F).
        ensemble: E, the number of heads. TorchRL's losses make ``num_qvalue_nets`` copies of the whole critic
            themselves, each with newly initialized weights.
        width, depth: units per hidden layer and number of hidden layers, each followed by a LayerNorm; a sequence of
            widths sets both.
        out_keys: replacements for the default output keys; nested keys are allowed.

    Example:
        >>> import torch, lw_torchrl as lw
        >>> from lw_torchrl.modules import Value, descriptor_trunk
        >>> reach = torch.full((5,), lw.task_id("reach"))
        >>> Value(descriptor_trunk("MT10"))(observation=torch.rand(5, 39), task_id=reach).shape
        torch.Size([5, 1])

    Source: ``torchrl.modules.ValueOperator``.
    """

    _written = ("state_value", "state_values")
    _outputs = 1  # number of outputs of a head
    _also_read: Keys = ()

    @typed
    def __init__(
        self,
        trunk: TensorDictSequential,
        *,
        ensemble: Count = 1,
        width: Width = 256,
        depth: Natural = 2,
        out_keys: Keys | None = None,
    ) -> None:
        super().__init__()
        self.trunk = trunk
        self.plans, self.layout = plans_of(trunk), layout_of(trunk)
        self.in_keys = [*trunk.in_keys, *self._also_read]
        self.out_keys = as_keys("out_keys", out_keys, self._written[: 1 if ensemble == 1 else 2])
        check_apart(self.in_keys, self.out_keys)
        heads = [MLP(self._outputs, width=width, depth=depth, layer_norm=True) for _ in range(ensemble)]
        self.heads = nn.ModuleList(heads)
        if (size := encoding_width(trunk)) is not None:
            size += self.layout.action_size * len(self._also_read)
            for head in heads:
                materialize(head, torch.zeros(1, size, dtype=torch.float32))

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = self.trunk(tensordict.copy())
        encoding = torch.cat([outputs.get(key) for key in encoding_keys(self.trunk)], -1)
        actions = read(tensordict, self.in_keys[len(self.trunk.in_keys) :])
        inputs = torch.cat([encoding, *(action.to(encoding.dtype) for action in actions)], -1)
        values = torch.cat([head(inputs) for head in self.heads], -1)
        if self._outputs > 1:
            return write(tensordict, self, [values])
        return write(tensordict, self, [values.amin(-1, keepdim=True), values][: len(self.out_keys_source)])


class QValue(Value):
    """A state-action value network: a trunk with one or more value heads, which also read the action.

    Reads the trunk's input keys and ``action`` (B, A) float32; writes ``state_action_value`` (B, 1) float32, the
    minimum over the heads, and, with several heads, ``state_action_values`` (B, E) float32. With ``quantiles`` > 1,
    ``state_action_value`` is (B, Q) float32.

    Args:
        trunk, ensemble, width, depth, out_keys: see :class:`Value`.
        action_key: the key of the action; nested keys are allowed.
        quantiles: Q, the number of quantiles of the return, for ``torchrl.objectives.TQCLoss``; 1 for the mean return.

    Source: ``torchrl.modules.ValueOperator``.
    """

    _written = ("state_action_value", "state_action_values")

    @typed
    def __init__(
        self,
        trunk: TensorDictSequential,
        *,
        ensemble: Count = 1,
        action_key: NestedKey = "action",
        quantiles: Count = 1,
        **options: Any,
    ) -> None:
        if quantiles > 1 and ensemble != 1:
            raise ValueError(f"ensemble must be 1 if quantiles > 1, got {ensemble}: TQCLoss makes its own ensemble")
        self._outputs, self._also_read = quantiles, (action_key,)
        super().__init__(trunk, ensemble=ensemble, **options)


class _OnPlanTrunk:
    """Base class for critics whose trunk is :func:`plan_trunk`."""

    @typed
    def __init__(
        self,
        plans: AnyPlans,
        *,
        skill_encoder: nn.Module | None = None,
        features: nn.Module | None = None,
        text_encoder: TextEncoder | None = None,
        **options: Any,
    ) -> None:
        trunk = plan_trunk(plans, skill_encoder=skill_encoder, features=features, text_encoder=text_encoder)
        super().__init__(trunk, **options)  # type: ignore[call-arg]


class PlanConditionedValue(_OnPlanTrunk, Value):
    """A :class:`Value` network whose trunk is built by :func:`plan_trunk`.

    Reads ``qaf`` (B, S) bool, ``task_id`` (B,) int64 and ``observation`` (B, 39) float32; writes the same keys as
    :class:`Value`.

    Args:
        plans, skill_encoder, features, text_encoder: see :class:`PlanConditionedActor`.
        **options: keyword arguments of :class:`Value`.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.PlanConditionedValue(lw.load_plans("MT10")).out_keys
        ['state_value']
    """


class PlanConditionedQValue(_OnPlanTrunk, QValue):
    """A :class:`QValue` network whose trunk is built by :func:`plan_trunk`.

    Reads the input keys of :class:`PlanConditionedValue` and ``action`` (B, A) float32; writes the same keys as
    :class:`QValue`.

    Args:
        plans, skill_encoder, features, text_encoder: see :class:`PlanConditionedActor`.
        **options: keyword arguments of :class:`QValue`.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.objectives import TD3BCLoss
        >>> plans = lw.load_plans("MT10")
        >>> loss = TD3BCLoss(lw.PlanConditionedActor(plans), lw.PlanConditionedQValue(plans), bounds=(-1.0, 1.0))
    """
