"""Policies made of policies: ActorEnsemble, the mean of several; TransferredActor, one that acts with another robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs import Transform

from lw_torchrl._checks import checked, shown
from lw_torchrl._keys import dispatched, read, write
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Policy, decided
from lw_torchrl.modules.registry import from_description


class ActorEnsemble(Policy):
    """The mean action of policies that were trained separately on the same demonstrations. Where these do not say what
    to do, each member errs in its own way, and the mean errs less, most so with different features or augmentations.

    Reads what a member reads; writes ``action`` (B, 4) float32, and ``skill_weights`` (B, S) float32 where the members
    have plans: the mean of the members' own.

    Args:
        members: M policies with the same plans, or the same tasks, and the same keys.

    Raises:
        ValueError: no member, or members of different plans, tasks or keys.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.modules.ActorEnsemble([lw.DescriptorConditionedActor("MT10") for _ in range(4)])
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

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
        self.members: Any = nn.ModuleList(members)
        self.plans, self.tasks, self.layout = first.plans, first.tasks, first.layout
        self.in_keys = first.in_keys
        self.out_keys = first.out_keys_source[: 1 if first.plans is None else 2]
        self.draws = any(member.draws for member in members)
        self._decided = any(getattr(member, "decided_gripper", False) for member in members)  # by most of them
        self._own_evaluators = any(getattr(member, "evaluator", None) is not None for member in members)

    def transform(self) -> Transform | None:
        return self.members[0].transform()

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = [member.act(*member.prepare(tensordict)) for member in self.members]
        action = torch.stack([action for action, *_ in done]).mean(0)
        layout = self.acts_in or self.layout
        written = [decided(action, layout, 0.0) if self._decided and not self.training else action]
        if self.plans is not None:  # exact truth gives every member the same weights
            weights = [weights for _, weights, *_ in done]
            written.append(torch.stack(weights).mean(0) if self._own_evaluators else weights[0])
        return write(tensordict, self, written)

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        for member in self.members:
            member.fit_normalization(observation, weights)

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        for member in self.members:
            member.fit_contacts(observation, task_id)

    def describe(self) -> dict[str, Any]:
        return {"kind": "ActorEnsemble", "options": {}, "members": [member.describe() for member in self.members]}

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> ActorEnsemble:
        members = found["members"]
        if not isinstance(members, list) or cls.__name__ in [one.get("kind") for one in members]:
            raise ValueError("members of an ensemble must be a list of policies that are no ensembles")
        return cls([from_description(member, text_encoder) for member in members])

    def with_plans(self, plans: AnyPlans) -> ActorEnsemble:
        return ActorEnsemble([member.with_plans(plans) for member in self.members]).train(self.training)


def _shared(policy: Policy) -> dict[str, Any]:
    plans = None if policy.plans is None else policy.plans.fingerprint
    return {"plans": plans, "tasks": policy.tasks, "in_keys": policy.in_keys, "out_keys": policy.out_keys_source}


class DemonstratedActor(Policy):
    """Two policies in one: in the tasks that were demonstrated, what was learned there without a plan; in all others, a
    policy with plans. Where ten demonstrations show all that there is to do, words have nothing to add.

    Reads what the two read; writes what ``others`` writes, ``action`` (B, 4) float32 first.

    Args:
        demonstrated: a policy without plans, :class:`DescriptorConditionedActor` for one, or an ensemble of them.
        others: a policy with plans, of any tasks.

    Raises:
        ValueError: different layouts; ``demonstrated`` with plans, or ``others`` without.

    Example:
        >>> import lw_torchrl as lw
        >>> others = lw.PlanConditionedActor(lw.load_plans("MT50"), roles=True, features="none")
        >>> actor = lw.modules.DemonstratedActor(lw.DescriptorConditionedActor("MT10"), others)
        >>> state = actor.transform()(lw.LanguageWorldEnv(["reach", "hammer"]).reset())
        >>> actor(state)["action"].shape
        torch.Size([2, 4])

    Source: ours.
    """

    @checked
    def __init__(self, demonstrated: Policy, others: Policy) -> None:
        super().__init__()
        if demonstrated.plans is not None or others.plans is None:
            raise ValueError("demonstrated must be a policy without plans, and others one with plans")
        if demonstrated.layout != others.layout:
            layouts = f"{demonstrated.layout.name!r} and {others.layout.name!r}"
            raise ValueError(f"demonstrated and others must be of one layout, got {layouts}")
        self.demonstrated, self.others = demonstrated, others
        self.plans, self.tasks, self.layout = others.plans, others.tasks, others.layout
        self.in_keys = list(dict.fromkeys([*others.in_keys, *demonstrated.in_keys]))
        self.out_keys = others.out_keys_source
        self.draws, self.config = demonstrated.draws or others.draws, {}
        self._ids = torch.tensor([task_id(task) for task in demonstrated.tasks])

    def transform(self) -> Transform | None:
        return self.others.transform()

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = self.others(tensordict.copy())
        action, *extras = (done.get(key) for key in self.out_keys_source)
        key = self.demonstrated.in_keys[1]
        (task,) = read(tensordict, [key])
        ids = self._ids.to(task.device)
        known = torch.isin(task, ids)
        shown = tensordict.copy().set(key, torch.where(known, task, ids[0]))
        learned = self.demonstrated(shown).get(self.demonstrated.out_keys_source[0])
        return write(tensordict, self, [torch.where(known.unsqueeze(-1), learned, action), *extras])

    def fit_normalization(self, observation: Tensor, weights: Tensor | None = None) -> None:
        for part in (self.demonstrated, self.others):
            part.fit_normalization(observation, weights)

    def fit_contacts(self, observation: Tensor, task_id: Tensor) -> None:
        self.others.fit_contacts(observation, task_id)

    def describe(self) -> dict[str, Any]:
        parts = {"demonstrated": self.demonstrated.describe(), "others": self.others.describe()}
        return super().describe() | parts

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> DemonstratedActor:
        return cls(*(from_description(found[part], text_encoder) for part in ("demonstrated", "others")))

    def with_plans(self, plans: AnyPlans) -> Policy:
        """The same for other plans; for those of another suite, no task of which was demonstrated, ``others`` alone."""
        others = self.others.with_plans(plans)
        elsewhere = others.layout != self.layout
        return others if elsewhere else DemonstratedActor(self.demonstrated, others).train(self.training)


class TransferredActor(Policy):
    """The same weights under plans of another suite, and their actions turned into that suite's.

    A displacement keeps its metres a step, times ``speed``: it is multiplied by the ratio of the layouts' ``reach`` and
    cut off at 1. A ``binary_gripper``, that opens and closes at once, closes at an effort above ``closes_above``.

    Reads what the policy reads, of the other layout; writes what it writes, ``action`` (B, A) float32 in [-1, 1] first.

    Args:
        actor: a policy with plans whose features mean the same in both layouts: ``roles=True, features="opening"``.
        plans: what it is to do, of the other suite's tasks.
        speed: how many times as many metres a step as where it was trained, for simulators whose steps last longer.

    Raises:
        ValueError: features that do not carry over, by name; a layout without a displacement; a speed of 0 or less.
        TypeError: a policy without plans.

    Example:
        >>> import lw_torchrl as lw
        >>> from lw_torchrl.suites import load_suite
        >>> trained = lw.PlanConditionedActor(lw.load_plans("MT10"), roles=True, features="opening")
        >>> lw.modules.TransferredActor(trained, load_suite("fetch").plans).tasks
        ('fetch/pick-and-place', 'fetch/push', 'fetch/reach', 'fetch/slide')

    Source: ours; a plan says what matters, so the motion relative to it is the same with another robot.
    """

    @checked
    def __init__(self, actor: Policy, plans: AnyPlans, *, speed: float = 1.0) -> None:
        self._take(actor.with_plans(as_plans(plans)), actor.layout, speed)

    def _take(self, actor: Policy, trained: Layout, speed: float) -> None:
        """Hold a policy that has the other suite's plans already, and weights of the layout ``trained``."""
        super().__init__()
        assert actor.plans is not None
        if speed <= 0:
            raise ValueError(f"speed must be above 0, got {shown(speed)}")
        self.actor, self.trained, self.speed = actor, trained, speed
        self.plans, self.tasks, self.layout = actor.plans, actor.tasks, actor.plans.layout
        for layout in (self.trained, self.layout):
            layout.displaced("TransferredActor")
        for part in actor.modules():
            if isinstance(part, Policy):
                part.acts_in = trained
        self.in_keys, self.out_keys = actor.in_keys, actor.out_keys_source
        self.draws, self.config = actor.draws, {}

    def transform(self) -> Transform | None:
        return self.actor.transform()

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = self.actor(tensordict.copy())
        action, *others = (done.get(key) for key in self.out_keys_source)
        return write(tensordict, self, [self.turned(action), *others])

    def turned(self, action: Tensor) -> Tensor:
        """An action of the layout that was trained with, (..., A), as one of this layout."""
        old, new = self.trained, self.layout
        turned = action.new_zeros((*action.shape[:-1], new.action_size))
        moved = action[..., old.displaced("TransferredActor")] * (self.speed * old.reach / new.reach)
        turned[..., new.displaced("TransferredActor")] = moved.clamp(-1.0, 1.0)
        effort = action[..., old.effort].sum(-1, keepdim=True) * old.closes
        turned[..., new.effort] = effort * new.closes
        return decided(turned, new) if new.binary_gripper else turned

    def describe(self) -> dict[str, Any]:
        trained = {"trained": self.trained.to_json(), "speed": self.speed}
        return super().describe() | {"actor": self.actor.describe()} | trained

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> TransferredActor:
        if not isinstance(inner := found["actor"], Mapping) or inner.get("kind") == cls.__name__:
            raise ValueError("the actor of a TransferredActor must be a policy that is none itself")
        made = cls.__new__(cls)
        made._take(from_description(inner, text_encoder), Layout.from_json(found["trained"]), found["speed"])
        return made

    def with_plans(self, plans: AnyPlans) -> TransferredActor:
        made = TransferredActor.__new__(TransferredActor)
        made._take(self.actor.with_plans(plans), self.trained, self.speed)
        return made.train(self.training)
