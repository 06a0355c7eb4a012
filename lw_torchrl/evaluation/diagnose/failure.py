"""Failure: why one episode failed, as typed data. Its parts are a cause, a finding, and the results of re-runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal, NamedTuple, get_args

from beartype.vale import Is
from tensordict import TensorDictBase

from lw_torchrl._util.checks import Count, Natural, Scale, shown, typed_fields
from lw_torchrl.language.plans import ConditionalPlan

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

Finite = Annotated[float, Is[lambda x: abs(x) < 1e300]]
_Replacement = Annotated[str, Is[lambda name: name in REPLACEMENTS]]
# beartype checks only one entry of a mapping; these annotations check all entries.
_Numbers = Annotated[
    Mapping[str, Finite], Is[lambda table: all(type(x) in (int, float) and abs(x) < 1e300 for x in table.values())]
]
_Tried = Annotated[
    Mapping[str, bool], Is[lambda table: {*table} <= {*REPLACEMENTS} and all(type(x) is bool for x in table.values())]
]


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
_FINDINGS = {kind.__name__: kind for kind in get_args(Finding)}


class MendedEpisode(NamedTuple):
    """A failed episode that succeeds when it is re-run with a part replaced.

    ``steps`` has batch (T,), up to the first success: ``observation``, ``action`` as executed, ``task_id``,
    ``episode``, ``("next", "success")``, ``("next", "reward")`` and, where they exist, ``qaf`` and ``skill_weights``.
    """

    by: str  # the replacement, one of REPLACEMENTS
    plan: ConditionalPlan  # the plan that was carried out
    steps: TensorDictBase


@typed_fields
@dataclass(frozen=True)
class Failure:
    """Why one episode failed. Every field is data; :attr:`why` writes it in English.

    Attributes:
        task, seed, episode: which episode; ``episode_seed(task, seed, episode)`` is its seed.
        cause: one of :data:`CAUSES`.
        also: a second cause, if the episode succeeds only with both replaced.
        step: the step of the plan to which the failure belongs, from 0; None if it belongs to no step.
        at: the step of the episode to look at first, from 0.
        finding: what the episode's states show about the cause, or about ``suspect``.
        replaced: the replacement that decided, one of :data:`REPLACEMENTS`; None if none did.
        rival: the next best replacement.
        succeeds_at: the step at which the episode succeeds with ``replaced``, or in a plain re-run.
        scripted_step: a step in which a scripted skill also suffices, although other steps have the same fault.
        suspect: the cause that the states alone suggest, if it is undecided.
        evidence: name to number, measured in the episode's states.
        counterfactuals: each replacement that was tried, see :func:`attribute_failures`, and whether the same episode
            then succeeded; pairs like "query + plan" replace both, with "skill" in all steps.
        shares: each replacement, and the share of the task's failed episodes that succeed with it; "nothing" is a plain
            re-run.
        mended: the episode with the cause replaced, if it then succeeds; it is not saved.
    """

    task: str
    seed: int
    episode: Natural
    cause: Cause
    also: Cause | None
    step: Natural | None
    at: Natural
    finding: Finding | None = None
    replaced: _Replacement | None = None
    rival: _Replacement | None = None
    succeeds_at: Count | None = None
    scripted_step: Natural | None = None
    suspect: Cause | None = None
    evidence: _Numbers = field(default_factory=dict)
    counterfactuals: _Tried = field(default_factory=dict)
    shares: _Numbers = field(default_factory=dict)
    mended: MendedEpisode | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.also is not None and (self.also == self.cause or "undecided" in (self.also, self.cause)):
            raise ValueError(f"also must be None or another decided cause than {self.cause!r}, got {self.also!r}")

    @property
    def why(self) -> str:
        """The failure in a few English sentences."""
        from lw_torchrl.evaluation.diagnose.sentences import explain_failure  # which imports this module

        return explain_failure(self)

    def to_json(self) -> dict[str, Any]:
        """Return all fields except :attr:`mended`, as JSON."""
        content = {each.name: getattr(self, each.name) for each in fields(self) if each.compare}
        if self.finding is not None:
            content["finding"] = {"kind": type(self.finding).__name__, **vars(self.finding)}
        return content

    @classmethod
    def from_json(cls, content: Any) -> Failure:
        """Return a failure from the result of :meth:`to_json`; raise :class:`ValueError` for other JSON."""
        stated = content.get("finding") if isinstance(content, dict) else None
        if isinstance(stated, dict):
            kind = _FINDINGS.get(str(stated.get("kind")))
            if kind is None:
                raise ValueError(f"finding must be one of {', '.join(_FINDINGS)}, got {shown(stated)}")
            try:
                finding = record_from_json(kind, {name: stated[name] for name in stated if name != "kind"})
            except ValueError as error:
                raise ValueError(f"finding: {error}") from None
            content = {**content, "finding": finding}
        failure: Failure = record_from_json(cls, content)
        return failure


def record_from_json(kind: type[Any], content: Any) -> Any:
    """Return a dataclass from a JSON object of exactly its compared fields; the dataclass checks their values."""
    names = {each.name for each in fields(kind) if each.compare}
    if not isinstance(content, dict) or set(content) != names:
        raise ValueError(f"a {kind.__name__} must be an object of {', '.join(sorted(names))}, got {shown(content)}")
    return kind(**content)
