"""Actor wrappers: ensembling, a binary gripper, a separate policy for demonstrated tasks, transfer to another robot."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor, nn

from lw_torchrl._util.checks import Positive, typed
from lw_torchrl._util.keys import dispatched, last_name, read, write
from lw_torchrl.language.layout import Layout
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.tasks import task_id
from lw_torchrl.modules.descriptor_conditioned_actor import TaskLatent
from lw_torchrl.modules.parts import RenamedInputs, in_mode_of
from lw_torchrl.modules.policy import layout_of, plans_of, tasks_of, with_plans


class _Wrapper(RenamedInputs):
    """Base class for wrappers. ``_options`` are the constructor arguments, which are also attributes."""

    _options: ClassVar[Sequence[str]]

    def _wrap(self, actors: Sequence[TensorDictModuleBase], out_keys: Sequence[NestedKey]) -> None:
        """Read the input keys of all actors, and take plans, tasks and layout from the first actor."""
        self.plans, self.tasks, self.layout = plans_of(actors[0]), tasks_of(actors[0]), layout_of(actors[0])
        self.in_keys = list(dict.fromkeys(key for actor in actors for key in actor.in_keys))
        self.out_keys = list(out_keys)

    @property
    def config(self) -> dict[str, Any]:
        """The keyword arguments that reconstruct this module."""
        return {name: getattr(self, name) for name in self._options}


class _ActionWrapper(_Wrapper):
    """Base class for wrappers that change the action of a single actor."""

    def __init__(self, actor: TensorDictModuleBase) -> None:
        super().__init__()
        self.actor = actor
        self._wrap([actor], actor.out_keys)

    def converted(self, action: Tensor) -> Tensor:
        """Convert the wrapped actor's actions (..., A) to this policy's actions."""
        raise NotImplementedError(f"{type(self).__name__} must override converted()")

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs, key = self.actor(tensordict.copy()), _action_key(self.actor)
        outputs.set(key, self.converted(outputs.get(key)))
        return write(tensordict, self, [outputs.get(key) for key in self.actor.out_keys])


class ActorEnsemble(_Wrapper):
    """An ensemble that averages the actions of actors trained separately on the same demonstrations.

    The members' errors partly cancel in the mean, especially if the members have different features or augmentations.

    Reads the input keys of the members; writes ``action`` (B, A) float32, and the mean ``skill_weights`` (B, S) float32
    if the members write them.

    Args:
        members: actors with the same plans, or with the same tasks.

    Raises:
        ValueError: there are no members, or their plans or tasks differ.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.modules.ActorEnsemble([lw.modules.DescriptorConditionedActor("MT10") for _ in range(4)])
        >>> actor(lw.LanguageWorldEnv("reach").reset())["action"].shape
        torch.Size([1, 4])

    Source: the mean of ``torchrl.modules.EnsembleModule``.
    """

    _options = ("members",)

    @typed
    def __init__(self, members: Sequence[TensorDictModuleBase]) -> None:
        super().__init__()
        if len({(_fingerprint(member), tasks_of(member)) for member in members}) != 1:
            raise ValueError(f"members must be one or more actors with equal plans and tasks, got {len(members)}")
        self.members: Any = nn.ModuleList(members)
        written = [key for key in members[0].out_keys if last_name(key) in ("action", "skill_weights")]
        self._written: list[NestedKey] = sorted(written, key=last_name)
        self._wrap(members, self._written)

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = [member(tensordict.copy()) for member in self.members]
        means = [torch.stack([output.get(key) for output in outputs]).mean(0) for key in self._written]
        return write(tensordict, self, means)

    def with_plans(self, plans: AnyPlans) -> ActorEnsemble:
        """Return a copy of the ensemble that follows other plans but shares its networks."""
        return in_mode_of(self, ActorEnsemble([with_plans(member, plans) for member in self.members]))


class DecidedGripper(_ActionWrapper):
    """A wrapper that fully opens or closes the gripper, because half-closed fingers drop objects; inactive in training.

    Reads and writes the actor's keys; the gripper effort in ``action`` (B, A) is -1 or 1.

    Args:
        actor: any actor.
        closes_above: the effort above which the gripper closes; None for the layout's threshold.
        layout: the layout of the actions; None for the actor's layout.

    Example:
        >>> import lw_torchrl as lw
        >>> actor = lw.modules.DecidedGripper(lw.modules.DescriptorConditionedActor("MT10")).eval()
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
        """The keyword arguments that reconstruct this module."""
        return {"actor": self.actor, "closes_above": self.closes_above, "layout": self.action_layout}

    def converted(self, action: Tensor) -> Tensor:
        """Return the actions with a gripper effort of -1 or 1; during training, return them unchanged."""
        return action if self.training else decided(action, self.action_layout, self.closes_above)

    def with_plans(self, plans: AnyPlans) -> DecidedGripper:
        """Return a policy for another set of plans that shares the networks; the action layout stays the same."""
        return in_mode_of(self, DecidedGripper(**{**self.config, "actor": with_plans(self.actor, plans)}))


def decided(action: Tensor, layout: Layout, closes_above: float | None = None) -> Tensor:
    """Return actions (..., A) with the gripper effort set to -1 or 1; the gripper closes above ``closes_above``."""
    at, action = layout.effort, action.clone()
    bound = layout.closes_above if closes_above is None else closes_above
    action[..., at] = torch.where(action[..., at] * layout.closes > bound, 1.0, -1.0) * layout.closes
    return action


class DemonstratedActor(_Wrapper):
    """A policy that uses an actor without plans for demonstrated tasks, and an actor with plans for all other tasks.

    Reads the input keys of both actors; writes ``action`` (B, A) float32 and the other keys that ``others`` writes.

    Args:
        demonstrated: an actor without plans, for example :class:`DescriptorConditionedActor`.
        others: an actor with plans, for any tasks.

    Raises:
        ValueError: the layouts differ, ``demonstrated`` has plans, or ``others`` has none.

    Example:
        >>> import lw_torchrl as lw
        >>> plans = lw.canonical_plans(lw.load_plans("MT50"))
        >>> others = lw.PlanConditionedActor(plans, features=lw.modules.RoleFeatures(plans))
        >>> actor = lw.modules.DemonstratedActor(lw.modules.DescriptorConditionedActor("MT10"), others)
        >>> state = lw.modules.transform_of(actor)(lw.LanguageWorldEnv(["reach", "hammer"]).reset())
        >>> actor(state)["action"].shape
        torch.Size([2, 4])

    Source: original to this library.
    """

    _options = ("demonstrated", "others")

    @typed
    def __init__(self, demonstrated: TensorDictModuleBase, others: TensorDictModuleBase) -> None:
        super().__init__()
        known = tasks_of(demonstrated)
        if plans_of(demonstrated) is not None or plans_of(others) is None or known is None:
            raise ValueError("demonstrated must be an actor with tasks but no plans, and others an actor with plans")
        if layout_of(demonstrated) != layout_of(others):
            layouts = f"{layout_of(demonstrated).name!r} and {layout_of(others).name!r}"
            raise ValueError(f"demonstrated and others must have the same layout, got {layouts}")
        self.demonstrated, self.others = demonstrated, others
        self._wrap([others, demonstrated], others.out_keys)
        self._ids = torch.tensor([task_id(task) for task in known])

    @dispatched
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        outputs = self.others(tensordict.copy())
        key = _task_key(self.demonstrated)
        (task,) = read(tensordict, [key])
        ids = self._ids.to(task.device)
        known = torch.isin(task, ids)
        # The first actor acts on all rows, because shapes must not depend on data. Unknown tasks are replaced by a
        # known task, and the resulting actions are dropped.
        rows = tensordict.copy().set(key, torch.where(known, task, ids[0]))
        learned = self.demonstrated(rows).get(_action_key(self.demonstrated))
        key = _action_key(self.others)
        outputs.set(key, torch.where(known.unsqueeze(-1), learned, outputs.get(key)))
        return write(tensordict, self, [outputs.get(key) for key in self.others.out_keys])

    def with_plans(self, plans: AnyPlans) -> TensorDictModuleBase:
        """Return a policy for another set of plans; for plans of another suite, return only ``others``."""
        others: TensorDictModuleBase = with_plans(self.others, plans)
        if layout_of(others) != self.layout:  # no task of that suite was demonstrated
            return others
        return in_mode_of(self, DemonstratedActor(self.demonstrated, others))


class TransferredActor(_ActionWrapper):
    """A wrapper that runs an actor on another suite's plans, and converts the actions to that suite's layout.

    By default, displacements in [-1, 1] stay the same, so the largest displacement is the fastest motion of the new
    robot. With ``speed``, the hand moves ``speed`` times as many metres per time step as in the training suite. A
    binary gripper closes at an effort above the new layout's ``closes_above``.

    Reads the actor's input keys, in the other layout; writes ``action`` (B, A) float32 in [-1, 1] and the actor's other
    output keys.

    Args:
        actor: an actor whose features have the same meaning in both layouts: :class:`RoleFeatures`, or kind "opening".
        plans: plans for the other suite's tasks.
        speed: the hand's metres per time step, relative to the training suite; None to keep displacements the same.
        trained: the layout with which the actor was trained; None for the actor's layout.

    Raises:
        ValueError: the features do not transfer, or a layout has no displacement.
        TypeError: the actor has no plans.

    Example:
        >>> import lw_torchrl as lw
        >>> from lw_torchrl.modules import Concat, ObservationFeatures, RoleFeatures
        >>> from lw_torchrl.suites import load_suite
        >>> plans = lw.canonical_plans(lw.load_plans("MT10"))
        >>> actor = lw.PlanConditionedActor(plans, features=Concat(ObservationFeatures("opening"), RoleFeatures(plans)))
        >>> lw.modules.TransferredActor(actor, lw.canonical_plans(load_suite("fetch").plans)).tasks
        ('fetch/pick-and-place', 'fetch/push', 'fetch/reach', 'fetch/slide')

    Source: original to this library; the motion relative to the objects that a plan names is the same for any robot.
    """

    _options = ("actor", "plans", "speed", "trained")

    @typed
    def __init__(
        self,
        actor: TensorDictModuleBase,
        plans: AnyPlans,
        *,
        speed: Positive | None = None,
        trained: Layout | None = None,
    ) -> None:
        plans, trained = as_plans(plans), trained or layout_of(actor)
        super().__init__(actor if _fingerprint(actor) == plans.fingerprint else with_plans(actor, plans))
        self.trained, self.speed = trained, speed
        self.plans, self.tasks, self.layout = plans, tuple(plans), plans.layout
        for layout in (self.trained, self.layout):
            layout.displaced("TransferredActor")  # raises for a layout without a displacement

    def converted(self, action: Tensor) -> Tensor:
        """Convert actions (..., A) from the training layout to this layout."""
        old, new = self.trained, self.layout
        result = action.new_zeros((*action.shape[:-1], new.action_size))
        scale = 1.0 if self.speed is None else self.speed * old.reach / new.reach
        moved = action[..., old.displaced("TransferredActor")] * scale
        result[..., new.displaced("TransferredActor")] = moved.clamp(-1.0, 1.0)
        effort = action[..., old.effort].sum(-1, keepdim=True) * old.closes
        result[..., new.effort] = effort * new.closes
        return decided(result, new) if new.binary_gripper else result

    def with_plans(self, plans: AnyPlans) -> TransferredActor:
        """Return a policy for another set of plans that shares the networks."""
        other = {"actor": with_plans(self.actor, plans), "plans": plans}
        return in_mode_of(self, TransferredActor(**{**self.config, **other}))


def _fingerprint(actor: TensorDictModuleBase) -> str | None:
    return getattr(plans_of(actor), "fingerprint", None)


def _action_key(actor: TensorDictModuleBase) -> NestedKey:
    return next(key for key in actor.out_keys if last_name(key) == "action")


def _task_key(actor: TensorDictModuleBase) -> NestedKey:
    keys = [part.in_keys[0] for part in actor.modules() if isinstance(part, TaskLatent)]
    return (keys or [key for key in actor.in_keys if last_name(key) == "task_id"])[0]
