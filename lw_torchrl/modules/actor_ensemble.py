"""ActorEnsemble: several policies as one, which does the mean of what they would do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._checks import checked
from lw_torchrl._keys import dispatched, write
from lw_torchrl.language.plans import ConditionalPlan, Plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.held_evaluator import HeldEvaluator
from lw_torchrl.modules.policy import Policy, from_description


class ActorEnsemble(Policy):
    """The mean action of policies that were trained separately on the same demonstrations. Where these do not say what
    to do, each member errs in its own way, and the mean errs less. Members with different features or augmentations
    differ most.

    Reads what a member reads; writes ``action`` (B, 4) float32, and ``skill_weights`` (B, S) float32 where the members
    have plans: the mean of the members' own.

    Args:
        members: M policies with the same plans, or the same tasks, and the same keys.

    Raises:
        ValueError: no member, members of different plans, tasks or keys, or one with a :class:`HeldEvaluator`.

    Example:
        >>> import lw_torchrl as lw
        >>> env = lw.LanguageWorldEnv("reach")
        >>> actor = lw.modules.ActorEnsemble([lw.DescriptorConditionedActor("MT10") for _ in range(4)])
        >>> actor(env.reset())["action"].shape
        torch.Size([1, 4])
        >>> env.close()

    Source: as the mean of ``torchrl.modules.EnsembleModule``.
    """

    @checked
    def __init__(self, members: Sequence[Policy]) -> None:
        super().__init__()
        if not members:
            raise ValueError("members must be at least one policy, got none")
        first = members[0]
        for name, own in _shared(first).items():
            if any(_shared(one)[name] != own for one in members):
                raise ValueError(f"members must have the same {name}")
        self.members = nn.ModuleList(members)
        if any(isinstance(part, HeldEvaluator) for one in members for part in one.modules()):
            raise ValueError(
                "members must have no HeldEvaluator of their own, an environment holds one evaluator's answers: let "
                "members read qaf, and give the HeldEvaluator to evaluate(..., evaluator=)"
            )
        self.plans, self.tasks, self.layout = first.plans, first.tasks, first.layout
        self.in_keys = first.in_keys
        self.out_keys = first.out_keys_source[: 1 if first.plans is None else 2]
        self.draws = any(member.draws for member in members)
        self._own_evaluators = any(getattr(member, "evaluator", None) is not None for member in members)

    def transform(self) -> Transform | None:
        return self._each[0].transform()

    @property
    def _each(self) -> list[Policy]:
        return list(self.members)  # type: ignore[arg-type]

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = [member.act(*member.prepare(tensordict)) for member in self._each]
        written = [torch.stack([action for action, *_ in done]).mean(0)]
        if self.plans is not None:  # exact truth gives every member the same weights
            weights = [weights for _, weights, *_ in done]
            written.append(torch.stack(weights).mean(0) if self._own_evaluators else weights[0])
        return write(tensordict, self, written)

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        for member in self._each:
            member.fit_normalization(observation, weights)

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        for member in self._each:
            member.fit_contacts(observation, task_id)

    def describe(self) -> dict[str, Any]:
        return {"kind": "ActorEnsemble", "options": {}, "members": [member.describe() for member in self._each]}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> ActorEnsemble:
        members = found["members"]
        if not isinstance(members, list) or cls.__name__ in [one.get("kind") for one in members]:
            raise ValueError("members of an ensemble must be a list of policies that are no ensembles")
        return cls([from_description(member, text_encoder) for member in members])

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> ActorEnsemble:
        return ActorEnsemble([member.with_plans(plans) for member in self._each]).train(self.training)


def _shared(policy: Policy) -> dict[str, Any]:
    """What the members of an ensemble must have in common."""
    plans = None if policy.plans is None else policy.plans.fingerprint
    return {"plans": plans, "tasks": policy.tasks, "in_keys": policy.in_keys, "out_keys": policy.out_keys_source}
