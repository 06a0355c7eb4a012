"""Learner: the contract of what learns from the environment, whatever the method."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.data import TensorDictReplayBuffer

from lw_torchrl._state_tree import check_like, check_optimizer_state
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.critics import QValue
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorEncoder
from lw_torchrl.modules.encoder import Encoder
from lw_torchrl.modules.networks import DistributionName
from lw_torchrl.modules.plan_encoder import PlanEncoder
from lw_torchrl.modules.policy import Policy
from lw_torchrl.modules.residual_actor import ResidualActor
from lw_torchrl.training.loss_state import load_tensors, tensors_of
from lw_torchrl.training.online_config import OnlineConfig


class Learner:
    """How a policy learns; a subclass says what it does with rows as they come, and at the end of a round.

    Args:
        start: the policy to begin with.
        replay: demonstrations, and what comes.
        config: how to train.
        critic: whose copies are trained, where the method has one; None for one that sees what the policy sees.

    Attributes:
        policy: what acts, and is kept: the start itself, or another made of it.
        loss: holds all that is trained.
        optimizers: by what they train.
        noisy: whether noise is added to its actions.
        wants_round: whether :meth:`end_round` reads the round's rows.
        made: gradient steps.
        mean: of what was told since the last round, by name.
    """

    loss: nn.Module
    noisy = True
    wants_round = False

    def __init__(
        self, start: Policy, replay: TensorDictReplayBuffer, config: OnlineConfig, critic: QValue | None = None
    ) -> None:
        self.policy, self.replay, self.config = start.eval(), replay, config
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self.made = 0
        self._told: dict[str, list[Tensor]] = {}

    def act(self, state: TensorDictBase) -> TensorDictBase:
        """Write ``action`` (N, 4) float32, without the noise."""
        return self.policy(state)

    def noise_weight(self, state: TensorDictBase) -> Tensor | float:
        """What the noise on the actions of :meth:`act` is multiplied by, (N, 1) float32 or one number for all.

        A residual of some steps has noise in these alone: elsewhere it would teach nothing, and lead astray what is to
        stay as it is.
        """
        policy = self.policy
        of_steps = isinstance(policy, ResidualActor) and policy.steps is not None
        return state.get(policy.out_keys_source[2]) if of_steps else 1.0

    def observe(self, rows: TensorDictBase) -> None:
        """Take rows (N, T) that came, time last."""

    def learn(self, steps: int) -> None:
        """Make so many gradient steps."""

    def end_round(self, rows: TensorDictBase | None, steps: int) -> None:
        """Take all rows (N, T) of a round, in which so many gradient steps were due."""

    def tell(self, **values: Tensor) -> None:
        """Note what is to be logged, () float32 each."""
        for name, value in values.items():
            self._told.setdefault(name, []).append(value.detach())

    def told(self) -> dict[str, float]:
        """The mean of each of what was noted since the last call."""
        means = {name: float(torch.stack(values).mean()) for name, values in self._told.items()}
        self._told = {}
        return means

    def optimize(self, name: str, loss: Tensor) -> None:
        """A step of an optimizer."""
        self.optimizers[name].zero_grad()
        loss.backward()
        self.optimizers[name].step()

    def state_dict(self) -> dict[str, Any]:
        """All that learning goes on from."""
        return {
            "made": self.made,
            "tensors": {name: tensor.detach() for name, tensor in tensors_of(self.loss).items()},
            "optimizers": {name: one.state_dict() for name, one in self.optimizers.items()},
        }

    @torch.no_grad()
    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from what :meth:`state_dict` gave.

        Raises:
            ValueError: it is that of another learner, or holds NaN.
        """
        ours = self.state_dict()
        check_like({**state, "optimizers": None}, {**ours, "optimizers": None}, "learner")
        if not isinstance(state["optimizers"], Mapping) or set(state["optimizers"]) != set(self.optimizers):
            raise ValueError(f"optimizers must be {', '.join(self.optimizers)}")
        for name, optimizer in self.optimizers.items():
            check_optimizer_state(state["optimizers"][name], optimizer, state["made"])
        load_tensors(self.loss, state["tensors"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.made = state["made"]


def make_optimizer(parameters: Iterable[Tensor], learning_rate: float) -> torch.optim.Optimizer:
    """AdamW on what is trained of some parameters."""
    trained = [parameter for parameter in parameters if parameter.requires_grad]
    rate = float(learning_rate)
    return torch.optim.AdamW([{"params": trained, "initial_lr": rate}], lr=rate, fused=True)


def encoder_like(policy: Policy) -> Encoder:
    """A fresh encoder, without noise, that sees what a policy's sees, with its statistics.

    Raises:
        TypeError: the policy has none; a critic must then be given.
    """
    actor = policy.base if isinstance(policy, ResidualActor) else policy
    if not isinstance(actor, ConditionedActor):
        raise TypeError(f"critic must be given for a {type(policy).__name__}, which has no encoder to make one like")
    encoder = actor.encoder
    options: dict[str, Any] = {"features": encoder.features.kind, "text_encoder": encoder.text_encoder}
    made: Encoder
    if isinstance(encoder, DescriptorEncoder):
        made = DescriptorEncoder(encoder.definitions.values(), condition=encoder.config["condition"], **options)
    else:
        assert encoder.plans is not None
        made = PlanEncoder(encoder.plans, **options)
    made.features.load_state_dict(encoder.features.state_dict())
    return made


def stochastic(policy: Policy, distribution: DistributionName, init_std: float) -> ConditionedActor:
    """An actor with a distribution, in eval mode: the policy itself if it has one.

    Raises:
        TypeError: the policy can have none.
    """
    if not isinstance(policy, ConditionedActor):
        raise TypeError(f"actor must be one that can have a distribution, got {type(policy).__name__}")
    return (policy.stochastic(distribution, init_std) if policy.head.distribution is None else policy).eval()
