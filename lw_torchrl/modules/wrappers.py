"""Wrappers of any actor: an ensemble, a decided gripper, a second policy for demonstrated tasks, another robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from lw_torchrl._util.checks import shown, typed
from lw_torchrl._util.keys import dispatched, last_name, read, write
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.descriptor_conditioned_actor import TaskLatent
from lw_torchrl.modules.networks import in_mode_of
from lw_torchrl.modules.policy import layout_of, plans_of, tasks_of, with_plans
from lw_torchrl.modules.sequence import RenamedInputs


class ActorEnsemble(RenamedInputs):
    """The mean action of actors that were trained separately on the same demonstrations.

    Where the demonstrations do not say what to do, each member errs in its own way, and the mean errs less, most so
    if the members have different features or augmentations.

    Reads what the members read; writes ``action`` (B, A) float32, and the mean ``skill_weights`` (B, S) float32 if the
    members write them.

    Args:
        members: M actors of the same plans, or of the same tasks.

    Raises:
        ValueError: no member, or members of different plans or tasks.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.modules.ActorEnsemble([lw.DescriptorConditionedActor("MT10") for _ in range(4)])
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

    Source: the mean of ``torchrl.modules.EnsembleModule``.
    """

    @typed
    def __init__(self, members: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        if not members:
            raise ValueError("members must be at least one actor, got none")
        first = members[0]
        for name, of in (("plans", lambda actor: getattr(plans_of(actor), "fingerprint", None)), ("tasks", tasks_of)):
            if any(of(member) != of(first) for member in members):
                raise ValueError(f"members must have the same {name}")
        self.members: Any = nn.ModuleList(members)
        self.plans, self.tasks, self.layout = plans_of(first), tasks_of(first), layout_of(first)
        self.in_keys = list(dict.fromkeys(key for member in members for key in member.in_keys))
        written = [key for key in first.out_keys if last_name(key) in ("action", "skill_weights")]
        self._written: list[NestedKey] = sorted(written, key=last_name)
        self.out_keys = list(self._written)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that rebuild it."""
        return {"members": list(self.members)}

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = [member(tensordict.copy()) for member in self.members]
        means = [torch.stack([output.get(key) for output in outputs]).mean(0) for key in self._written]
        return write(tensordict, self, means)

    def with_plans(self, plans: AnyPlans) -> ActorEnsemble:
        """Return the ensemble with the same networks that follows other plans."""
        return in_mode_of(self, ActorEnsemble([with_plans(member, plans) for member in self.members]))


class _Wrapper(RenamedInputs):
    """Base of the wrappers of one actor, which change its action."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor = actor
        self.plans, self.tasks, self.layout = plans_of(actor), tasks_of(actor), layout_of(actor)
        self.in_keys, self.out_keys = list(actor.in_keys), list(actor.out_keys)

    def converted(self, action: Tensor) -> Tensor:
        """Return the actor's actions, (..., A), as this policy's."""
        raise NotImplementedError(f"{type(self).__name__} must override converted")

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs, key = self.actor(tensordict.copy()), _action(self.actor)
        outputs.set(key, self.converted(outputs.get(key)))
        return write(tensordict, self, [outputs.get(key) for key in self.actor.out_keys])


class DecidedGripper(_Wrapper):
    """Open or close the gripper fully while not training.

    Half open fingers push objects over, and half closed ones lose them.

    Reads what the actor reads; writes what the actor writes, where the effort of ``action`` (B, A) is -1 or 1.

    Args:
        actor: any actor.
        closes_above: the effort above which the gripper closes; None for the layout's.
        layout: the layout of the actions; None for the actor's.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.modules.DecidedGripper(lw.DescriptorConditionedActor("MT10")).eval()
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"][0, 3].abs().item()
        1.0
    """

    @typed
    def __init__(
        self, actor: TensorDictModuleBase, closes_above: float | None = None, layout: Layout | None = None
    ) -> None:
        super().__init__(actor)
        self.closes_above, self.action_layout = closes_above, layout or self.layout

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that rebuild it."""
        return {"actor": self.actor, "closes_above": self.closes_above, "layout": self.action_layout}

    def converted(self, action: Tensor) -> Tensor:
        """Return actions whose effort is -1 or 1; while training, the same actions."""
        return action if self.training else decided(action, self.action_layout, self.closes_above)

    def with_plans(self, plans: AnyPlans) -> DecidedGripper:
        """Return the policy with the same networks that follows other plans."""
        actor = with_plans(self.actor, plans)
        return in_mode_of(self, DecidedGripper(actor, self.closes_above, self.action_layout))


def decided(action: Tensor, layout: Layout, closes_above: float | None = None) -> Tensor:
    """Return actions (..., A) of a layout with an effort of -1 or 1: closing above ``closes_above``."""
    at, action = layout.effort, action.clone()
    bound = layout.closes_above if closes_above is None else closes_above
    action[..., at] = torch.where(action[..., at] * layout.closes > bound, 1.0, -1.0) * layout.closes
    return action


class DemonstratedActor(RenamedInputs):
    """Two policies: one without plans for the tasks that were demonstrated, one with plans for all others.

    A plan adds nothing in a task that ten demonstrations cover.

    Reads what the two read; writes ``action`` (B, A) float32, and what else ``others`` writes.

    Args:
        demonstrated: an actor without plans, for example :class:`DescriptorConditionedActor`.
        others: an actor with plans, of any tasks.

    Raises:
        ValueError: different layouts; ``demonstrated`` with plans, or ``others`` without.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.canonical_plans(lw.load_plans("MT50"))
        >>> others = lw.PlanConditionedActor(plans, features=lw.modules.RoleFeatures(plans))
        >>> actor = lw.modules.DemonstratedActor(lw.DescriptorConditionedActor("MT10"), others)
        >>> state = lw.modules.transform_of(actor)(lw.LanguageWorldEnv(["reach", "hammer"]).reset())
        >>> actor(state)["action"].shape
        torch.Size([2, 4])

    Source: ours.
    """

    @typed
    def __init__(self, demonstrated: TensorDictModuleBase, others: TensorDictModuleBase) -> None:
        super().__init__()
        known = tasks_of(demonstrated)
        if plans_of(demonstrated) is not None or plans_of(others) is None or known is None:
            raise ValueError("demonstrated must be an actor of tasks without plans, and others one with plans")
        if layout_of(demonstrated) != layout_of(others):
            layouts = f"{layout_of(demonstrated).name!r} and {layout_of(others).name!r}"
            raise ValueError(f"demonstrated and others must have one layout, got {layouts}")
        self.demonstrated, self.others = demonstrated, others
        self.plans, self.tasks, self.layout = plans_of(others), tasks_of(others), layout_of(others)
        self.in_keys = list(dict.fromkeys([*others.in_keys, *demonstrated.in_keys]))
        self.out_keys = list(others.out_keys)
        self._ids = torch.tensor([task_id(task) for task in known])

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that rebuild it."""
        return {"demonstrated": self.demonstrated, "others": self.others}

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = self.others(tensordict.copy())
        key = _task_key(self.demonstrated)
        (task,) = read(tensordict, [key])
        ids = self._ids.to(task.device)
        known = torch.isin(task, ids)
        shown_tasks = tensordict.copy().set(key, torch.where(known, task, ids[0]))
        learned = self.demonstrated(shown_tasks).get(_action(self.demonstrated))
        key = _action(self.others)
        outputs.set(key, torch.where(known.unsqueeze(-1), learned, outputs.get(key)))
        return write(tensordict, self, [outputs.get(key) for key in self.others.out_keys])

    def with_plans(self, plans: AnyPlans) -> TensorDictModuleBase:
        """Return the policy for other plans; for those of another suite only ``others``."""
        others: TensorDictModuleBase = with_plans(self.others, plans)
        if layout_of(others) != self.layout:  # no task of which was demonstrated
            return others
        return in_mode_of(self, DemonstratedActor(self.demonstrated, others))


class TransferredActor(_Wrapper):
    """An actor with the same weights for another suite's plans, whose actions are converted to that suite's.

    A displacement keeps its metres a step, times ``speed``: it is multiplied by the ratio of the layouts' ``reach`` and
    clipped at 1. A ``binary_gripper``, which opens and closes at once, closes at an effort above ``closes_above``.

    Reads what the actor reads, in the other layout; writes ``action`` (B, A) float32 in [-1, 1], and what else the
    actor writes.

    Args:
        actor: an actor whose features mean the same in both layouts: :class:`RoleFeatures` with the "opening".
        plans: plans for the other suite's tasks.
        speed: scale factor of the displacement, for simulators whose steps last longer.
        trained: the layout that the actor was trained with; None for the actor's.

    Raises:
        ValueError: features that do not transfer; a layout without a displacement; a speed of 0 or less.
        TypeError: an actor without plans.

    Example:
        >>> import lw_torchrl as lw
        >>> from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures
        >>> from lw_torchrl.suites import load_suite
        >>> plans = lw.canonical_plans(lw.load_plans("MT10"))
        >>> actor = lw.PlanConditionedActor(plans, features=Concat(ObservationFeatures("opening"), RoleFeatures(plans)))
        >>> lw.modules.TransferredActor(actor, lw.canonical_plans(load_suite("fetch").plans)).tasks
        ('fetch/pick-and-place', 'fetch/push', 'fetch/reach', 'fetch/slide')

    Source: ours; a plan says what matters, so the motion relative to it is the same with another robot.
    """

    @typed
    def __init__(
        self, actor: TensorDictModuleBase, plans: AnyPlans, *, speed: float = 1.0, trained: Layout | None = None
    ) -> None:
        if speed <= 0:
            raise ValueError(f"speed must be above 0, got {shown(speed)}")
        plans, before = as_plans(plans), trained or layout_of(actor)
        same = getattr(plans_of(actor), "fingerprint", None) == plans.fingerprint
        super().__init__(actor if same else with_plans(actor, plans))
        self.trained, self.speed = before, speed
        self.plans, self.tasks, self.layout = plans, tuple(plans), plans.layout
        for layout in (self.trained, self.layout):
            layout.displaced("TransferredActor")

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that rebuild it."""
        return {"actor": self.actor, "plans": self.plans, "speed": self.speed, "trained": self.trained}

    def converted(self, action: Tensor) -> Tensor:
        """Return actions of the layout that was trained with, (..., A), as actions of this layout."""
        old, new = self.trained, self.layout
        result = action.new_zeros((*action.shape[:-1], new.action_size))
        moved = action[..., old.displaced("TransferredActor")] * (self.speed * old.reach / new.reach)
        result[..., new.displaced("TransferredActor")] = moved.clamp(-1.0, 1.0)
        effort = action[..., old.effort].sum(-1, keepdim=True) * old.closes
        result[..., new.effort] = effort * new.closes
        return decided(result, new) if new.binary_gripper else result

    def with_plans(self, plans: AnyPlans) -> TransferredActor:
        """Return the policy with the same networks that follows other plans."""
        actor = with_plans(self.actor, plans)
        return in_mode_of(self, TransferredActor(actor, plans, speed=self.speed, trained=self.trained))


def _action(actor: TensorDictModuleBase) -> NestedKey:
    return next(key for key in actor.out_keys if last_name(key) == "action")


def _task_key(actor: TensorDictModuleBase) -> NestedKey:
    latents = (part for part in actor.modules() if isinstance(part, TaskLatent))
    return next((part.in_keys[0] for part in latents), None) or next(
        k for k in actor.in_keys if last_name(k) == "task_id"
    )
