"""Critics: the value of a state, or of an action in it, on the encoders that actors are built on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._checks import check_int, checked, passes_on
from lw_torchrl._keys import as_keys, check_apart, check_key, dispatched, read, write
from lw_torchrl.language.plans import AnyPlans
from lw_torchrl.modules.networks import DistributionName, head
from lw_torchrl.modules.plan_conditioned_actor import PlanConditionedActor
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.policy import Encoder

_OWN = ("ensemble", "width", "depth", "out_keys")  # options of a critic, not of its encoder


class Value(TensorDictModuleBase):
    """The value of a state, on any encoder.

    Reads what the encoder reads; writes ``state_value`` (B, 1) float32, the least of the ensemble's, and, with an
    ensemble of several, ``state_values`` (B, E) float32, each of them.

    Args:
        encoder: what it is conditioned on; one that is an actor's too is trained by both.
        ensemble: E, networks on the one encoder. TorchRL's losses copy the whole critic ``num_qvalue_nets`` times
            themselves, and draw the copies' weights anew.
        width, depth: hidden layers, each followed by a LayerNorm; a tuple of widths says both.
        out_keys: other names for what it writes, in the order above; nested ones too.

    Example:
        >>> import lw_torchrl as lw, torch
        >>> from lw_torchrl.modules import DescriptorEncoder, Value
        >>> reach = torch.full((5,), lw.task_id("reach"))
        >>> Value(DescriptorEncoder("MT10"))(observation=torch.rand(5, 39), task_id=reach).shape
        torch.Size([5, 1])

    Source: ``torchrl.modules.ValueOperator``.
    """

    _written = ("state_value", "state_values")
    _of_action = False  # whether it reads one
    _numbers = 1  # of a value

    @checked
    def __init__(
        self,
        encoder: Encoder,
        *,
        ensemble: int = 1,
        width: int | Sequence[int] = 256,
        depth: int = 2,
        out_keys: Sequence[NestedKey] | None = None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.plans, self.tasks = encoder.plans, encoder.tasks
        self.in_keys: list[NestedKey] = list(encoder.in_keys)
        self.out_keys = as_keys("out_keys", out_keys, self._written[: 1 if ensemble == 1 else 2])
        check_apart(self.in_keys, self.out_keys)
        more = encoder.layout.action_size if self._of_action else 0
        self.heads = nn.ModuleList(
            head(encoder.width + more, self._numbers, width, depth, layer_norm=True)
            for _ in range(check_int("ensemble", ensemble, minimum=1))
        )

    def transform(self) -> Transform | None:
        return self.encoder.transform()

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        """As :meth:`Policy.fit_normalization`."""
        self.encoder.features.fit(observation, weights)

    def _input(self, tensordict: TensorDictBase) -> Tensor:
        return self.encoder.encode(*self.encoder.prepare(tensordict)).joined

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = self._input(tensordict)
        values = torch.cat([each(seen) for each in self.heads], -1)
        if self._numbers > 1:
            return write(tensordict, self, [values])
        return write(tensordict, self, [values.amin(-1, keepdim=True), values][: len(self.out_keys_source)])


class QValue(Value):
    """The value of an action in a state, on any encoder.

    Reads what the encoder reads and ``action`` (B, 4) float32; writes ``state_action_value`` (B, 1) float32, the least
    of the ensemble's, and, with an ensemble of several, ``state_action_values`` (B, E) float32, each of them. With
    ``quantiles``, ``state_action_value`` is (B, Q) float32.

    Args:
        encoder, ensemble, width, depth, out_keys: as for :class:`Value`.
        action_key: where the action is; may be nested.
        quantiles: Q, how many quantiles of the return are the value, for ``torchrl.objectives.TQCLoss``; 1: its mean.

    Source: ``torchrl.modules.ValueOperator``.
    """

    _written = ("state_action_value", "state_action_values")
    _of_action = True

    @passes_on(Value.__init__)
    @checked
    def __init__(
        self,
        encoder: Encoder,
        *,
        ensemble: int = 1,
        action_key: NestedKey = "action",
        quantiles: int = 1,
        **options: Any,
    ) -> None:
        self._numbers = check_int("quantiles", quantiles, minimum=1)
        if quantiles > 1 and ensemble != 1:
            raise ValueError(f"ensemble must be 1 with quantiles, got {ensemble}: TQCLoss makes several critics itself")
        super().__init__(encoder, ensemble=ensemble, **options)
        check_key("action_key", action_key)
        self.action_key = action_key
        self.in_keys = [*self.in_keys, action_key]
        check_apart(self.in_keys, self.out_keys)

    def _input(self, tensordict: TensorDictBase) -> Tensor:
        (action,) = read(tensordict, [self.action_key])
        return torch.cat((super()._input(tensordict), action), -1)


class PlanConditionedValue(Value):
    """:class:`Value` on a :class:`PlanEncoder`.

    Reads ``observation`` (B, 39) float32, ``task_id`` (B,) int64 and ``qaf`` (B, S) bool; writes as :class:`Value`.

    Args:
        plans: a plan for each task that will be seen.
        **options: of :class:`Value` and of :class:`PlanEncoder`; ``out_keys`` are the value's.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.PlanConditionedValue(lw.load_plans("MT10")).out_keys
        ['state_value']
    """

    @passes_on(Value.__init__, PlanEncoder.__init__)
    def __init__(self, plans: AnyPlans, **options: Any) -> None:
        own = {name: options.pop(name) for name in _OWN if name in options}
        super().__init__(PlanEncoder(plans, **options), **own)


class PlanConditionedQValue(QValue):
    """:class:`QValue` on a :class:`PlanEncoder`.

    Reads what :class:`PlanConditionedValue` does, and ``action`` (B, 4) float32; writes as :class:`QValue`.

    Args:
        plans: a plan for each task that will be seen.
        **options: of :class:`QValue` and of :class:`PlanEncoder`; ``out_keys`` are the value's.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.objectives import TD3BCLoss
        >>> plans = lw.load_plans("MT10")
        >>> loss = TD3BCLoss(lw.PlanConditionedActor(plans), lw.PlanConditionedQValue(plans), bounds=(-1.0, 1.0))
    """

    @passes_on(QValue.__init__, PlanEncoder.__init__)
    def __init__(self, plans: AnyPlans, **options: Any) -> None:
        own = {name: options.pop(name) for name in (*_OWN, "action_key", "quantiles") if name in options}
        super().__init__(PlanEncoder(plans, **options), **own)


@passes_on(PlanConditionedActor.__init__)
@checked
def plan_actor_value(
    plans: AnyPlans,
    *,
    distribution: DistributionName = "tanh_normal",
    **options: Any,
) -> tuple[PlanConditionedActor, Value]:
    """An actor and the value of its states on one shared encoder, as PPO and A2C take them.

    Args:
        plans: a plan for each task that will be seen.
        distribution: the actor's.
        **options: of :class:`PlanConditionedActor`.

    Returns:
        The actor, and the :class:`Value` on its encoder.

    Example:
        >>> import lw_torchrl as lw
        >>> from torchrl.objectives import ClipPPOLoss
        >>> loss = ClipPPOLoss(*lw.modules.plan_actor_value(lw.load_plans("MT10")))

    Source: ``torchrl.modules.ActorValueOperator``.
    """
    actor = PlanConditionedActor(plans, distribution=distribution, **options)
    return actor, Value(actor.encoder)
