"""TransferredActor: a policy that was trained with one robot, acting with another under that robot's plans."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform

from lw_torchrl._checks import checked, shown
from lw_torchrl._keys import dispatched, write
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.plans import ConditionalPlan, Plans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Policy, from_description


class TransferredActor(Policy):
    """The same weights under plans of another suite, and their actions turned into that suite's.

    A displacement keeps its metres a step, times ``speed``: it is multiplied by the ratio of the layouts' ``reach`` and
    cut off at 1. Where the suite's gripper opens or closes within a few steps, ``binary_gripper``, it closes at an
    effort above ``closes_above`` and opens below.

    Reads what the policy reads, of the other layout; writes ``action`` (B, A) float32 in [-1, 1], and what else the
    policy writes.

    Args:
        actor: a policy with plans, all of whose features mean the same in both layouts: those of ``roles=True`` and
            ``features="opening"``.
        plans: what it is to do, of the other suite's tasks.
        speed: how many times as many metres a step as where it was trained, for simulators whose steps last longer.

    Raises:
        ValueError: features that do not carry over, by name; a layout without a displacement; a speed that is not above
            0.
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
    def __init__(self, actor: Policy, plans: Plans | Mapping[str, ConditionalPlan], *, speed: float = 1.0) -> None:
        super().__init__()
        self._take(actor.with_plans(as_plans(plans)), actor.layout, speed)

    def _take(self, actor: Policy, trained: Layout, speed: float) -> None:
        """Hold a policy that has the other suite's plans already, and weights of the layout ``trained``."""
        assert actor.plans is not None
        if speed <= 0:
            raise ValueError(f"speed must be above 0, got {shown(speed)}")
        self.actor, self.trained, self.speed = actor, trained, speed
        self.plans, self.tasks, self.layout = actor.plans, actor.tasks, actor.plans.layout
        for layout in (self.trained, self.layout):
            layout.displaced("TransferredActor")
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
        if new.binary_gripper:
            effort = torch.where(effort > new.closes_above, 1.0, -1.0)
        turned[..., new.effort] = effort * new.closes
        return turned

    def describe(self) -> dict[str, Any]:
        return super().describe() | {
            "actor": self.actor.describe(),
            "trained": self.trained.to_json(),
            "speed": self.speed,
        }

    @classmethod
    def from_description(cls, found: Mapping[str, Any], text_encoder: TextEncoder | None = None) -> TransferredActor:
        if not isinstance(inner := found["actor"], Mapping) or inner.get("kind") == cls.__name__:
            raise ValueError("the actor of a TransferredActor must be a policy that is none itself")
        made = cls.__new__(cls)
        Policy.__init__(made)
        made._take(from_description(inner, text_encoder), Layout.from_json(found["trained"]), found["speed"])
        return made

    def with_plans(self, plans: Plans | Mapping[str, ConditionalPlan]) -> TransferredActor:
        made = TransferredActor.__new__(TransferredActor)
        Policy.__init__(made)
        made._take(self.actor.with_plans(plans), self.trained, self.speed)
        return made.train(self.training)
