"""ResidualActor: a small network beside a policy that stays as it is, for RL to correct it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._checks import check_scale
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.tasks import Task
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.conditioned_actor import ConditionedActor
from lw_torchrl.modules.networks import ACTION_SIZE, head
from lw_torchrl.modules.policy import Policy, from_description


class ResidualActor(Policy):
    """A policy that stays as it is, and a small network that corrects its actions; at first by nothing.

    Reads what the policy reads; writes ``action`` (B, 4) float32 in [-1, 1], the policy's plus ``scale`` times tanh of
    the network, cut off at ±1. The network sees the policy's encoding and its action.

    Args:
        base: a :class:`~lw_torchrl.PlanConditionedActor` or :class:`~lw_torchrl.DescriptorConditionedActor` without a
            distribution. It is not trained any more, nor noisy, and not copied.
        scale: how far an action can be corrected.
        width, depth: hidden layers of the network; a tuple of widths says both.

    Attributes:
        base: the policy.
        network: what is trained.

    Raises:
        TypeError: a base that is none of these.
        ValueError: a base with a distribution, or that mixes actions; a wrong option.

    Example:
        >>> import lw_torchrl as lw
        >>> base = lw.DescriptorConditionedActor("MT10")
        >>> state = lw.LanguageWorldEnv("reach").reset()
        >>> actor = lw.ResidualActor(base)
        >>> actor(state.copy())["action"].equal(base(state.copy())["action"])
        True

    Source: Johannink et al., 'Residual Reinforcement Learning for Robot Control'.
    """

    def __init__(self, base: Policy, *, scale: float = 0.3, width: int | Sequence[int] = 256, depth: int = 2) -> None:
        super().__init__()
        if not isinstance(base, ConditionedActor):
            raise TypeError(
                "base must be a PlanConditionedActor or a DescriptorConditionedActor, whose encoding the network "
                f"reads, got {type(base).__name__}"
            )
        if base.head.distribution is not None:
            raise ValueError(f"base must have no distribution, this one's is {base.head.distribution!r}")
        if base.config.get("mix") == "actions":
            raise ValueError("base must mix latents, this one mixes actions")
        self.base = base.requires_grad_(False).eval()
        self.plans, self.tasks = base.plans, base.tasks
        self.in_keys, self.out_keys = base.in_keys, base.out_keys[:1]
        self.network = head(base.encoder.width + ACTION_SIZE, ACTION_SIZE, width, depth)
        nn.init.zeros_(self.network[-1].weight)
        nn.init.zeros_(self.network[-1].bias)
        self.config = {"scale": check_scale("scale", scale), "width": width, "depth": depth}

    def train(self, mode: bool = True) -> ResidualActor:
        """As a module's, but for the base, whose features stay without noise."""
        super().train(mode)
        self.base.eval()
        return self

    def definition(self, task: str) -> Task | None:
        return self.base.definition(task)

    def transform(self) -> Transform | None:
        return self.base.transform()

    def prepare(self, tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        """As the base's."""
        return self.base.prepare(tensordict)

    def act(self, *prepared: Tensor) -> tuple[Tensor, ...]:
        """The action."""
        encoding = self.base.encoder.encode(*prepared).joined
        action = self.base.head(encoding)
        more = torch.tanh(self.network(torch.cat((encoding, action), -1)))
        return ((action + self.config["scale"] * more).clamp(-1.0, 1.0),)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"base": self.base.describe()}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> ResidualActor:
        base = found["base"]
        if not isinstance(base, Mapping) or base.get("kind") in (cls.__name__, "ActorEnsemble"):
            raise ValueError("the base of a residual must be a policy that is neither a residual nor an ensemble")
        return cls(from_description(base, text_encoder), **found["options"])

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> ResidualActor:
        """One that carries out other plans with the same weights: training either trains both.

        Raises:
            TypeError: the base is not conditioned on plans.
        """
        base = self.base.with_plans(plans)
        assert isinstance(base, ConditionedActor)
        other = ResidualActor(base, **self.config)
        other.network = self.network
        return other.train(self.training)
