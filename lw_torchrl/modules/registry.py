"""Registries of policies, encoders and methods (ways to condition a policy), and policies made by name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from lw_torchrl._checks import check_choice, checked, shown, unknown_name
from lw_torchrl._registry import Entry, Registry, is_class
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Encoder, Policy, Prepared

POLICIES = Registry(
    "policy",
    "lw_torchrl.policies",
    {
        "ActorEnsemble": "lw_torchrl.modules.composed_actors:ActorEnsemble",
        "ConditionedActor": "lw_torchrl.modules.conditioned_actor:ConditionedActor",
        "DemonstratedActor": "lw_torchrl.modules.composed_actors:DemonstratedActor",
        "DescriptorConditionedActor": "lw_torchrl.modules.descriptor_conditioned_actor:DescriptorConditionedActor",
        "PlanConditionedActor": "lw_torchrl.modules.plan_conditioned_actor:PlanConditionedActor",
        "ScriptedSkillActor": "lw_torchrl.modules.scripted_skill_actor:ScriptedSkillActor",
        "TransferredActor": "lw_torchrl.modules.composed_actors:TransferredActor",
    },
    is_class("policy", Policy),
)
"""The classes of policies by name, as in policy files."""
ENCODERS = Registry(
    "encoder",
    "lw_torchrl.encoders",
    {
        "DescriptorEncoder": "lw_torchrl.modules.descriptor_conditioned_actor:DescriptorEncoder",
        "PlanEncoder": "lw_torchrl.modules.plan_encoder:PlanEncoder",
    },
    is_class("encoder", Encoder),
)
"""The classes of encoders by name, as in files of a :class:`~lw_torchrl.modules.ConditionedActor`."""


@dataclass(frozen=True)
class Method:
    """A way to condition a policy on its task: a name in :data:`POLICIES`, and options of that class."""

    policy: str
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reads_plans(self) -> bool:
        """Whether its class is conditioned on plans."""
        return self._class.plan_options

    def takes(self, option: str) -> bool:
        """Return whether its class has an option of that name."""
        known = signature(self._class).parameters
        of_head = "encoder" in self.options and option in signature(POLICIES[self.policy]).parameters
        return option in known or of_head or any(one.kind is one.VAR_KEYWORD for one in known.values())

    @property
    def _class(self) -> type[Prepared]:
        encoder = self.options.get("encoder")
        return ENCODERS[encoder] if encoder else POLICIES[self.policy]


def _check_method(name: str, entry: Any) -> Method:
    if not isinstance(entry, Method):
        raise TypeError(f"method {name!r} must be a Method, got {entry!r:.80}")
    return entry


METHODS = Registry(
    "method",
    "lw_torchrl.methods",
    {
        "pcbc": Method("PlanConditionedActor"),
        "dc": Method("DescriptorConditionedActor", {"condition": "description"}),
        "one-hot": Method("DescriptorConditionedActor", {"condition": "one-hot"}),
    },
    _check_method,
)
"""How a policy is conditioned: on plans, on the task's description, or on its number."""


def find_method(name: str, argument: str = "method") -> Method:
    """Return the method of a name in :data:`METHODS`, or that of a class in :data:`POLICIES` or :data:`ENCODERS`."""
    if name in METHODS:
        return METHODS[name]
    if name in ENCODERS:
        return Method("ConditionedActor", {"encoder": name})
    check_choice(argument, name, [*METHODS, *POLICIES, *ENCODERS])
    return Method(name)


def class_of(argument: str, registry: Registry[Entry], description: Mapping[str, Any]) -> Entry:
    """Return the class that a description names; :class:`ValueError` says which module had it, or the nearest name.

    The module is never imported: a file may come from a stranger.
    """
    kind, module = description.get("kind"), description.get("module")
    if isinstance(kind, str) and kind in registry:
        return registry[kind]
    if not isinstance(module, str) or not re.fullmatch(r"[A-Za-z_][\w.]{0,99}", module):
        raise unknown_name(argument, kind, registry)
    where, remedy = f"of the module {module}", f"import that first, on the command line by --import {module}"
    if module == "__main__":
        where, remedy = "of a script", "register it in a module that can be imported, and import that first"
    raise ValueError(f"{argument}: {shown(kind)} is not known here, it is {where}; {remedy}")


@checked
def make_policy(method: str, plans: AnyPlans, *, text_encoder: TextEncoder | None = None, **options: Any) -> Policy:
    """A policy of a method for the tasks of some plans.

    Args:
        method: one of :data:`METHODS`, or a class in :data:`POLICIES` or :data:`ENCODERS`; :class:`ValueError` names
            the nearest.
        plans: what it carries out, or, where the method knows no plans, the tasks that it is for.
        text_encoder: texts to vectors (n, E) float32; None for the shipped sentence encoder.
        **options: of the policy's class.

    Example:
        >>> import lw_torchrl as lw
        >>> make_policy("dc", lw.load_plans("MT10"), width=64).tasks == lw.MT10
        True
    """
    chosen = find_method(method)
    return POLICIES[chosen.policy].for_plans(
        as_plans(plans), text_encoder=text_encoder, **{**chosen.options, **options}
    )


def from_description(found: Any, text_encoder: TextEncoder | None = None) -> Policy:
    """Make the policy that :meth:`Policy.describe` described, with fresh weights; :class:`ValueError` if it is none."""
    if not isinstance(found, Mapping) or not isinstance(found.get("options"), Mapping):
        raise ValueError(f"a policy's description must have kind and options, got {found!r:.80}")
    return class_of("kind of policy", POLICIES, found).from_description(found, text_encoder)
