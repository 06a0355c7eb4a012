"""Create policies, and find the plans, tasks, layout and transforms of any actor."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import Compose, Transform

from lw_torchrl._util.checks import check_choice
from lw_torchrl._util.registry import Registry, is_function
from lw_torchrl.language.layout import METAWORLD, Layout
from lw_torchrl.language.plans import AnyPlans, Plans, as_plans
from lw_torchrl.modules.parts import follow
from lw_torchrl.transforms.fallback_turns import FallbackTurns
from lw_torchrl.transforms.qaf import QAFTransform

Method = Callable[..., TensorDictModuleBase]

METHODS: Registry[Method] = Registry(
    "method",
    "lw_torchrl.methods",
    {
        "pcbc": "lw_torchrl.modules.plan_conditioned_actor:PlanConditionedActor",
        "dc": "lw_torchrl.modules.policy:descriptor_actor",
        "one-hot": "lw_torchrl.modules.policy:one_hot_actor",
    },
    is_function,
)
"""A registry of functions that make an actor from plans and keyword arguments."""


def descriptor_actor(plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Return a :class:`DescriptorConditionedActor` for the tasks of ``plans``."""
    from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor

    return DescriptorConditionedActor([plan.definition for plan in as_plans(plans).values()], **options)


def one_hot_actor(plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Return an actor for the tasks of ``plans`` that is conditioned on a one-hot vector of the task."""
    return descriptor_actor(plans, condition="one-hot", **options)


def make_policy(method: str, plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Create an untrained policy of the named method for the tasks of ``plans``.

    Args:
        method: a name in :data:`METHODS`; an unknown name raises a :class:`ValueError` that suggests the nearest name.
        plans: the plans that the policy follows; a method without plans uses only their tasks.
        **options: keyword arguments of the method, for example ``features`` and ``decoder``.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.modules.make_policy("dc", lw.load_plans("MT10")).tasks == lw.MT10
        True
    """
    return METHODS[check_choice("method", method, METHODS)](as_plans(plans), **options)


def _parts(actor: Any) -> Iterator[Any]:
    yield from actor.modules() if isinstance(actor, nn.Module) else [actor]


def _first(actor: Any, name: str) -> Any:
    """Return the first attribute ``name`` that is not None, of an actor or of one of its parts."""
    return next((value for part in _parts(actor) if (value := getattr(part, name, None)) is not None), None)


def plans_of(actor: Any) -> Plans | None:
    """Return the plans that an actor, or one of its parts, follows; None if there are no plans."""
    return _first(actor, "plans")


def tasks_of(actor: Any) -> tuple[str, ...] | None:
    """Return the tasks that an actor, or one of its parts, knows; None if no part has the attribute ``tasks``."""
    tasks = _first(actor, "tasks")
    return None if tasks is None else tuple(tasks)


def layout_of(actor: Any) -> Layout:
    """Return the first observation layout that an actor, its plans or its parts define, otherwise Meta-World's."""
    own, plans = getattr(actor, "layout", None), plans_of(actor)
    return own or (plans.layout if plans is not None else _first(actor, "layout")) or METAWORLD


def draws(actor: Any) -> bool:
    """Return whether an actor draws random numbers even without exploration, so that actions depend on past calls."""
    return any(getattr(part, "draws", False) for part in _parts(actor))


def with_plans(actor: Any, plans: AnyPlans) -> Any:
    """Return an actor for another set of plans that shares the networks: training one also trains the other.

    Raises:
        TypeError: the actor follows no plans, or cannot follow other plans.
        ValueError: the plans do not fit the actor, for example because the plans have no roles.
    """
    plans = as_plans(plans)
    if plans_of(actor) is None:
        raise TypeError(f"with_plans needs an actor with plans, got {type(actor).__name__} without plans")
    return follow(actor, plans)


def transform_of(actor: Any, plans: Plans | None = None) -> Transform | None:
    """Return a new transform that writes the keys that an actor reads but an environment lacks; None if there are none.

    Args:
        actor: any actor; the transforms of parts with a method ``transform()`` are included.
        plans: plans whose conditions are checked even if the actor does not read ``qaf``; None for the actor's plans
            if the actor reads ``qaf``, otherwise for no plans.
    """
    own, reads = plans_of(actor), list(getattr(actor, "in_keys", ()))
    transforms: list[Transform] = []
    for part in _parts(actor):
        transform = part.transform() if callable(getattr(part, "transform", None)) else None
        if transform is not None:
            transforms += transform.transforms if isinstance(transform, Compose) else [transform]
    qaf, task_id = _first(actor, "truth_keys") or ("qaf", "task_id")
    observation = _first(actor, "observation_key") or "observation"
    answered = plans or (own if qaf in reads else None)
    if answered is not None:
        transforms.insert(0, QAFTransform(answered, in_keys=[observation, task_id], out_keys=[qaf]))
    if own is not None and (turn := _first(actor, "turn_key")) in reads:
        transforms.append(FallbackTurns(own.layout, in_keys=[observation], out_keys=[turn]))
    if len(transforms) > 1:
        return Compose(*transforms)
    return transforms[0] if transforms else None
