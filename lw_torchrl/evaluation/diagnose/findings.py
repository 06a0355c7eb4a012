"""Causes of failures, their replacements, and findings: what an episode's states show, as typed data."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

from lw_torchrl._util.checks import Count, Natural, Scale, typed_fields

Blamed = Literal["not reproducible", "perception", "query", "plan", "skill", "gripper", "actuation", "policy"]
Cause = Literal[Blamed, "out of time", "undecided"]

CAUSES: dict[str, str] = {
    "not reproducible": "a plain re-run succeeds",
    "perception": "the policy was shown a wrong state",
    "query": "a condition was answered wrongly",
    "plan": "the plan is wrong",
    "skill": "the policy executed a skill badly",
    "gripper": "the gripper opened or closed wrongly",
    "actuation": "the hand moved wrongly in several steps",
    "policy": "the policy, unclear which part of it",
    "out of time": "it succeeds with more time",
    "undecided": "no replacement helps",
}
"""Each cause and its meaning."""

REPLACEMENTS: dict[str, tuple[Cause, ...]] = {
    "perception": ("perception",),
    "query": ("query",),
    "plan": ("plan",),
    "skill": ("skill",),
    "gripper": ("gripper",),
    "actuation": ("actuation",),
    "policy": ("policy",),
    "time": ("out of time",),
    "query + skill": ("query", "skill"),
    "query + plan": ("query", "plan"),
    "plan + skill": ("plan", "skill"),
}
"""The name of each replacement, and the causes to blame if an episode succeeds with it."""


@typed_fields
@dataclass(frozen=True)
class WrongAnswers:
    """The condition of a step was answered wrongly in ``states`` of ``of`` states, first at ``first``."""

    step: Natural
    condition: str
    states: Natural
    of: Count
    first: Natural


@typed_fields
@dataclass(frozen=True)
class NoCondition:
    """No condition of the plan held in ``states`` of the last ``of`` states."""

    states: Natural
    of: Count


@typed_fields
@dataclass(frozen=True)
class PlanDeparts:
    """The plan requested another action than the reference in ``states`` of ``of`` states, the last if ``late``."""

    step: Natural  # of the plan, in most of these states
    skill: str
    reference: str  # the skill that the reference requests there
    states: Natural
    of: Count
    late: bool
    uncovered: bool  # no condition of the plan held in most of them


@typed_fields
@dataclass(frozen=True)
class ActiveStep:
    """A step was active in ``states`` of the last ``of`` states, and at the end ``distance`` metres from its target."""

    step: Natural
    skill: str
    states: Natural
    of: Count
    distance: Scale | None = None


@typed_fields
@dataclass(frozen=True)
class Misled:
    """The observation that the policy was shown differed from the true one, most in entry ``number``, by ``error``."""

    error: Scale
    number: Natural


@typed_fields
@dataclass(frozen=True)
class Difference:
    """The first difference between two runs of an episode, with ``at``, the state to look at.

    ``part`` is "length", of ``given`` and ``again`` steps; "actions", which differ there by ``size``; "environment", if
    the same action leads to another state; "states", in a rollout without actions; or "nothing" that was recorded.
    """

    part: Literal["length", "actions", "environment", "states", "nothing"]
    at: Natural
    given: Natural | None = None
    again: Natural | None = None
    size: Scale | None = None


Finding = WrongAnswers | NoCondition | PlanDeparts | ActiveStep | Misled | Difference
FINDINGS: dict[str, type[Any]] = {kind.__name__: kind for kind in get_args(Finding)}
