"""Failure: why one episode failed, as typed data: a cause, a finding, and the results of re-runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Literal, NamedTuple, get_args

from beartype.vale import Is
from tensordict import TensorDictBase

from lw_torchrl._util.checks import Count, Natural, Scale, shown, typed_fields
from lw_torchrl.language.plans import ConditionalPlan

Blamed = Literal["perception", "query", "plan", "skill", "gripper", "actuation", "policy"]
Cause = Literal["environment differs", "not reproducible", Blamed, "noise", "out of time", "undecided"]

CAUSES: dict[str, str] = {
    "environment differs": "the environment differs from that of the re-run, or from the suite's",
    "not reproducible": "a plain re-run succeeds",
    "perception": "the policy received a wrong observation",
    "query": "a condition was answered wrongly",
    "plan": "the plan is wrong",
    "skill": "the policy executed a skill badly",
    "gripper": "the gripper opened or closed wrongly",
    "actuation": "the hand moved wrongly in several steps",
    "policy": "the policy acted wrongly, unclear which part",
    "noise": "the action noise, not a part of the policy",
    "out of time": "the episode succeeds with more time",
    "undecided": "no replacement helps",
}
"""A mapping from each cause to its meaning."""

REPLACEMENTS: dict[str, tuple[Cause, ...]] = {
    "environment": ("environment differs",),
    "perception": ("perception",),
    "query": ("query",),
    "wrapper": ("actuation",),
    "plan": ("plan",),
    "skill": ("skill",),
    "gripper": ("gripper",),
    "actuation": ("actuation",),
    "policy": ("policy",),
    "no noise": ("noise",),
    "time": ("out of time",),
    "query + skill": ("query", "skill"),
    "query + plan": ("query", "plan"),
    "plan + skill": ("plan", "skill"),
}
"""A mapping from each replacement to the causes to blame if an episode succeeds with that replacement.

For "wrapper", the cause is "skill" or "gripper" if the wrapper changes only these.
"""

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
    """A finding that a plan step's condition was evaluated wrongly.

    The evaluation is wrong in ``states`` out of ``of`` states, first at ``first``.
    """

    step: Natural
    condition: str
    states: Natural
    of: Count
    first: Natural


@typed_fields
@dataclass(frozen=True)
class NoCondition:
    """A finding: no condition of the plan held in ``states`` of the last ``of`` states."""

    states: Natural
    of: Count


@typed_fields
@dataclass(frozen=True)
class PlanDeparts:
    """A finding: plan and reference requested different actions in ``states`` of ``of`` states (last if ``late``)."""

    step: Natural  # the active plan step in most of these states
    skill: str
    reference: str  # the skill that the reference requests there
    states: Natural
    of: Count
    late: bool
    uncovered: bool  # whether no condition of the plan held in most of these states


@typed_fields
@dataclass(frozen=True)
class ActiveStep:
    """A finding: a plan step was active in ``states`` of the last ``of`` states, ``distance`` m from its target."""

    step: Natural
    skill: str
    states: Natural
    of: Count
    distance: Scale | None = None


@typed_fields
@dataclass(frozen=True)
class Misled:
    """A finding: the policy's observation differed from the true one, by up to ``error`` in entry ``number``."""

    error: Scale
    number: Natural


@typed_fields
@dataclass(frozen=True)
class WrongMotion:
    """A finding: in plan steps ``steps``, the action differed by ``error`` (root mean square) from the right one.

    ``right`` is the action to compare with: the "decided" one (the action of the policy's innermost module, which a
    wrapper changed), the "commanded" one (the policy's action, which the environment executed differently), or the
    "scripted" one (a trusted skill's). ``shape`` is the simplest fault that explains the error.
    """

    part: Literal["motion", "gripper"]
    right: Literal["decided", "commanded", "scripted"]
    shape: str  # "constant", "scaled", "shifted", "delayed by 3", "turned" or "irregular"
    error: Scale
    steps: int  # the number of plan steps with this error


@typed_fields
@dataclass(frozen=True)
class Difference:
    """A finding: the first difference between the rollout and the plain re-run of an episode, in state ``at``.

    ``part`` is "length" if the numbers of time steps differ (``given`` and ``again``), "actions" if the executed
    actions differ (by ``size``), "environment" if the same action leads to different states, "states" if the states
    differ and the rollout has no actions, or "nothing" if no recorded data differ.
    """

    part: Literal["length", "actions", "environment", "states", "nothing"]
    at: Natural
    given: Natural | None = None
    again: Natural | None = None
    size: Scale | None = None


Finding = WrongAnswers | NoCondition | PlanDeparts | ActiveStep | Misled | WrongMotion | Difference
_FINDINGS = {kind.__name__: kind for kind in get_args(Finding)}


class MendedEpisode(NamedTuple):
    """A successful re-run of a failed episode with one part replaced.

    ``steps`` has batch (T,) up to the first success: ``observation``, the executed ``action``, ``task_id``,
    ``episode``, ``("next", "success")``, ``("next", "reward")`` and, if recorded, ``qaf`` and ``skill_weights``.
    """

    by: str  # the name of the replacement in REPLACEMENTS
    plan: ConditionalPlan  # the plan that the policy followed in the re-run
    steps: TensorDictBase


@typed_fields
@dataclass(frozen=True)
class Failure:
    """The reason why one episode failed, as data; :attr:`why` expresses the reason in English.

    Attributes:
        task, seed, episode: the episode, which was seeded with ``episode_seed(task, seed, episode)``.
        cause: the cause, one of :data:`CAUSES`.
        also: a second cause, if the episode succeeds only with both replaced.
        step: the plan step to which the failure belongs (0-based); None if it belongs to no plan step.
        at: the time step of the episode to look at first (0-based).
        finding: what the episode's states show about ``cause``, or about ``suspect``.
        replaced: the replacement that decided the cause, one of :data:`REPLACEMENTS`; None if no replacement did.
        succeeds_at: the time step at which the episode succeeds with ``replaced``, or in a plain re-run.
        suspect: the cause that the states alone suggest, if ``cause`` is "undecided".
        evidence: numbers measured in the episode's states, by name.
        counterfactuals: for each replacement that was tried (see :func:`attribute_failures`), whether the episode
            succeeded with it. A pair such as "query + plan" replaces both; in a pair, "skill" means all plan steps.
        shares: for each replacement, the fraction of the task's failed episodes that succeed with it; "nothing" is
            a plain re-run.
        mended: the successful re-run with the cause replaced, if there is one; not saved.
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
    succeeds_at: Count | None = None
    suspect: Cause | None = None
    evidence: _Numbers = field(default_factory=dict)
    counterfactuals: _Tried = field(default_factory=dict)
    shares: _Numbers = field(default_factory=dict)
    mended: MendedEpisode | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.also is not None and (self.also == self.cause or "undecided" in (self.also, self.cause)):
            raise ValueError(f"also must be None or a decided cause other than {self.cause!r}, got {self.also!r}")

    @property
    def why(self) -> str:
        """The reason for the failure in a few English sentences."""
        from lw_torchrl.evaluation.diagnose.sentences import explain_failure  # avoids a circular import

        return explain_failure(self)

    def to_json(self) -> dict[str, Any]:
        """Return all fields except :attr:`mended`, as JSON."""
        content = {each.name: getattr(self, each.name) for each in fields(self) if each.compare}
        if self.finding is not None:
            content["finding"] = {"kind": type(self.finding).__name__, **vars(self.finding)}
        return content

    @classmethod
    def from_json(cls, content: Any) -> Failure:
        """Rebuild a failure from the result of :meth:`to_json`; raise :class:`ValueError` for any other JSON."""
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
    """Build an instance of the dataclass ``kind`` from a JSON object. Its keys must be exactly the fields of ``kind``
    with ``compare=True``.
    """
    names = {each.name for each in fields(kind) if each.compare}
    if not isinstance(content, dict) or set(content) != names:
        keys = ", ".join(sorted(names))
        raise ValueError(f"a {kind.__name__} must be an object with the keys {keys}, got {shown(content)}")
    return kind(**content)
