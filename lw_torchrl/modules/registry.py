"""METHODS: ways to condition a policy, by name, and policies made by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tensordict.nn import TensorDictModuleBase

from lw_torchrl._checks import check_choice, checked
from lw_torchrl._registry import Registry
from lw_torchrl.language.plans import AnyPlans, as_plans

Method = Callable[..., TensorDictModuleBase]


def _check_method(name: str, entry: Any) -> Method:
    if not callable(entry):
        raise TypeError(f"method {name!r} must be a function of plans, got {entry!r:.80}")
    method: Method = entry
    return method


METHODS: Registry[Method] = Registry(
    "method",
    "lw_torchrl.methods",
    {
        "pcbc": "lw_torchrl.modules.plan_conditioned_actor:PlanConditionedActor",
        "dc": "lw_torchrl.modules.registry:descriptor_actor",
        "one-hot": "lw_torchrl.modules.registry:one_hot_actor",
    },
    _check_method,
)
"""Functions from plans, and keyword arguments, to an actor: conditioned on plans, on descriptions, or on numbers."""


def descriptor_actor(plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Return a :class:`DescriptorConditionedActor` for the tasks of ``plans``."""
    from lw_torchrl.modules.descriptor_conditioned_actor import DescriptorConditionedActor

    return DescriptorConditionedActor([plan.definition for plan in as_plans(plans).values()], **options)


def one_hot_actor(plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Return an actor for the tasks of ``plans`` that knows only the task's number."""
    return descriptor_actor(plans, condition="one-hot", **options)


@checked
def make_policy(method: str, plans: AnyPlans, **options: Any) -> TensorDictModuleBase:
    """Return a policy of a method for the tasks of some plans.

    Args:
        method: a name in :data:`METHODS`; another is a :class:`ValueError` that names the nearest.
        plans: the plans that it follows, or, for a method without plans, those of its tasks.
        **options: of the method, for example ``features`` and ``decoder``.

    Example:
        >>> import lw_torchrl as lw
        >>> lw.modules.make_policy("dc", lw.load_plans("MT10")).tasks == lw.MT10
        True
    """
    check_choice("method", method, METHODS)
    return METHODS[method](as_plans(plans), **options)
