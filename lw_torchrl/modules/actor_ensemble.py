"""ActorEnsemble: several actors as one, which does the mean of what they would do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import nn

from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor
from lw_torchrl.modules.plan_conditioned_actor import PlanConditionedActor


class ActorEnsemble(TensorDictModuleBase):
    """The mean action of actors that were trained apart on the same demonstrations: where these do not say what to
    do, each fills the gap in its own way, and the mean strays less than one of them. Members that see different
    features, or were trained on other augmentations, differ most.

    Reads what a member reads; writes ``action`` (B, 4) float32 in (-1, 1), and ``skill_weights`` (B, S) float32 where
    the members have plans.

    Args:
        members: M actors of one kind with the same plans, or the same tasks.

    Attributes:
        members: the actors.
        plans: their plans, where they have plans.
        tasks: their tasks, where they are conditioned on descriptions.

    Raises:
        ValueError: no member, or members of different kinds, plans or tasks.

    Example:
        >>> import lw_torchrl as lw
        >>> env = lw.LanguageWorldEnv("reach")
        >>> actor = lw.ActorEnsemble([lw.DescriptorConditionedActor("MT10") for _ in range(4)])
        >>> actor(env.reset())["action"].shape
        torch.Size([1, 4])
        >>> env.close()

    Source: as the mean of ``torchrl.modules.EnsembleModule``.
    """

    plans: Plans
    tasks: tuple[str, ...]

    def __init__(self, members: Sequence[PlanConditionedActor | DescriptorConditionedActor]) -> None:
        super().__init__()
        if not members:
            raise ValueError("members must be at least one actor, got none")
        first = members[0]
        for name in ("plans", "tasks"):
            if any(getattr(one, name, None) != getattr(first, name, None) for one in members):
                raise ValueError(f"members must have the same {name}")
            if hasattr(first, name):
                setattr(self, name, getattr(first, name))
        self.members = nn.ModuleList(members)
        self.in_keys = first.in_keys
        self.out_keys = ["action", "skill_weights"] if hasattr(first, "plans") else ["action"]

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        # The conditions' truth alone gives the weights, so they are every member's.
        done = [member(tensordict.copy()) for member in self.members]
        tensordict.set("action", torch.stack([one.get("action") for one in done]).mean(0))
        for key in self.out_keys[1:]:
            tensordict.set(key, done[0].get(key))
        return tensordict

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> ActorEnsemble:
        """An ensemble that carries out other plans with the same weights: training either trains both.

        Raises:
            TypeError: the members are conditioned on descriptions.
        """
        members = [member for member in self.members if isinstance(member, PlanConditionedActor)]
        if not members:
            raise TypeError("with_plans is for members with plans, these are conditioned on descriptions")
        return ActorEnsemble([member.with_plans(plans) for member in members]).train(self.training)
