"""The tables that find policies and encoders by name, and methods, which say how a policy is conditioned."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from inspect import signature
from typing import Any

from lw_torchrl._checks import check_choice, checked, shown, unknown_name
from lw_torchrl._tables import Base, Classes, Table
from lw_torchrl.language.plans import AnyPlans, as_plans
from lw_torchrl.language.text import TextEncoder
from lw_torchrl.modules.policy import Encoder, Policy, Prepared


class Kinds(Classes[Base]):
    """A table of classes by their own names, which files have."""

    def check(self, name: str, thing: Any) -> Any:
        super().check(name, thing)
        if thing.__name__ != name:
            raise ValueError(f"{self.kind} {name!r} must have the name of its class, {thing.__name__!r}")
        return thing


POLICIES = Kinds(
    "policy",
    Policy,
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
)
"""The classes of policies by name, as in policy files."""
ENCODERS = Kinds(
    "encoder",
    Encoder,
    "lw_torchrl.encoders",
    {
        "DescriptorEncoder": "lw_torchrl.modules.descriptor_conditioned_actor:DescriptorEncoder",
        "PlanEncoder": "lw_torchrl.modules.plan_encoder:PlanEncoder",
    },
)
"""The classes of encoders by name, as in files of a :class:`~lw_torchrl.modules.ConditionedActor`."""


@dataclass(frozen=True)
class Method:
    """A way to condition a policy on its task: a name in :data:`POLICIES`, and options of that class."""

    policy: str
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def reads_plans(self) -> bool:
        """Whether what it makes is conditioned on plans."""
        return self._made.plan_options

    def takes(self, option: str) -> bool:
        """Whether what it makes has an option of that name."""
        known = signature(self._made).parameters
        of_head = "encoder" in self.options and option in signature(POLICIES[self.policy]).parameters
        return option in known or of_head or any(one.kind is one.VAR_KEYWORD for one in known.values())

    @property
    def _made(self) -> type[Prepared]:
        encoder = self.options.get("encoder")
        made: type[Prepared] = ENCODERS[encoder] if encoder else POLICIES[self.policy]
        return made


class Methods(Table[Method]):
    """Methods by name; the name of a class in :data:`POLICIES` or :data:`ENCODERS` is a method too."""

    def check(self, name: str, thing: Any) -> Method:
        if not isinstance(thing, Method):
            raise TypeError(f"method {name!r} must be a Method, got {thing!r:.80}")
        return thing

    def names(self) -> list[str]:
        more = [*POLICIES.names(), *ENCODERS.names()]
        return [*super().names(), *(name for name in more if name not in _OURS)]

    def __contains__(self, name: object) -> bool:
        return super().__contains__(name) or name in POLICIES or name in ENCODERS

    def __getitem__(self, name: str) -> Method:
        if super().__contains__(name):
            return super().__getitem__(name)
        if name in POLICIES:
            return Method(name)
        if name in ENCODERS:
            return Method("ConditionedActor", {"encoder": name})
        raise KeyError(name)


_OURS = {*POLICIES, *ENCODERS}
METHODS = Methods(
    "method",
    "lw_torchrl.methods",
    {
        "pcbc": Method("PlanConditionedActor"),
        "dc": Method("DescriptorConditionedActor", {"condition": "description"}),
        "one-hot": Method("DescriptorConditionedActor", {"condition": "one-hot"}),
    },
)
"""The choices of ``train --method``: on plans, the task's description, its number."""


def class_of(argument: str, table: Kinds[Any], found: Mapping[str, Any]) -> Any:
    """The class that a description names; :class:`ValueError` says which module had it, or the nearest name.

    That module is named and never imported: a file may come from a stranger.
    """
    kind, module = found.get("kind"), found.get("module")
    if isinstance(kind, str) and kind in table:
        return table[kind]
    if not isinstance(module, str) or not re.fullmatch(r"[A-Za-z_][\w.]{0,99}", module):
        raise unknown_name(argument, kind, table)
    where, mend = f"of the module {module}", f"import that first, on the command line by --import {module}"
    if module == "__main__":
        where, mend = "of a script", "add it to its table in a module that can be imported, and import that first"
    raise ValueError(f"{argument}: {shown(kind)} is not known here, it is {where}; {mend}")


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
    chosen = METHODS[check_choice("method", method, METHODS)]
    made: Policy = POLICIES[chosen.policy].for_plans(
        as_plans(plans), text_encoder=text_encoder, **{**chosen.options, **options}
    )
    return made


def from_description(found: Any, text_encoder: TextEncoder | None = None) -> Policy:
    """Make the policy that :meth:`Policy.describe` described, with fresh weights; :class:`ValueError` if it is none."""
    if not isinstance(found, Mapping) or not isinstance(found.get("options"), Mapping):
        raise ValueError(f"a policy's description must have kind and options, got {found!r:.80}")
    made: Policy = class_of("kind of policy", POLICIES, found).from_description(found, text_encoder)
    return made
