"""Failure: the reason why one episode failed, as typed data (cause, finding, results of re-runs) and in English."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from importlib.resources import files
from typing import Annotated, Any, Literal, NamedTuple

from beartype.vale import Is
from tensordict import TensorDictBase

from lw_torchrl._util.checks import Count, Finite, Natural, shown, typed_fields
from lw_torchrl._util.files import read_toml
from lw_torchrl._util.text import counted
from lw_torchrl.language.plans import ConditionalPlan

_TABLES = read_toml(files("lw_torchrl.evaluation") / "data" / "causes.toml", ValueError)
CAUSES: dict[str, str] = {cause: meaning for cause, (meaning, _) in _TABLES["causes"].items()}
"""A mapping from each cause to its meaning."""
CAUSE_COLORS: dict[str, str] = {cause: color for cause, (_, color) in _TABLES["causes"].items()}
FINDINGS: dict[str, str] = _TABLES["findings"]
REPLACEMENTS: dict[str, dict[str, list[str]]] = _TABLES["replacements"]
"""A mapping from the name of each replacement to its causes, and to the parts that it inserts and removes."""
_SCRIPTED = {"skill", "gripper", "actuation", "policy"}  # the replacements in which scripts act

Cause = Annotated[str, Is[lambda name: name in CAUSES]]
_FindingKind = Annotated[str, Is[lambda name: name in FINDINGS]]
_ReplacementName = Annotated[str, Is[lambda name: name in REPLACEMENTS]]


@typed_fields
@dataclass(frozen=True)
class Finding:
    """A fact that the re-run of a failed episode shows: a kind in data/causes.toml, and values for the kind's text."""

    kind: _FindingKind
    values: Mapping[str, str | Finite]

    def __post_init__(self) -> None:
        try:
            _ = self.text
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"values must be those of a finding {self.kind!r}, got {shown(self.values)}") from error

    @property
    def text(self) -> str:
        """The finding as a clause. Plan steps count from 0 in the values, and from 1 in the text."""
        number = int(self.values.get("step", 0)) + 1
        return FINDINGS[self.kind].format_map({**self.values, "number": number})


class MendedEpisode(NamedTuple):
    """A successful re-run of a failed episode with one part replaced.

    ``steps``, batch (T,), ends at the first success. Keys: ``observation``, the executed ``action``, ``task_id``,
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
        finding: what the episode's states show about ``cause``.
        replaced: the replacement that decided the cause, one of :data:`REPLACEMENTS`; None if no replacement did.
        succeeds_at: the time step at which the episode succeeds with ``replaced``, or in a plain re-run.
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
    replaced: _ReplacementName | None = None
    succeeds_at: Count | None = None
    evidence: Mapping[str, Finite] = field(default_factory=dict)
    counterfactuals: Mapping[_ReplacementName, bool] = field(default_factory=dict)
    shares: Mapping[str, Finite] = field(default_factory=dict)
    mended: MendedEpisode | None = field(default=None, compare=False, repr=False)

    def __post_init__(self) -> None:
        if self.also is not None and (self.also == self.cause or "undecided" in (self.also, self.cause)):
            raise ValueError(f"also must be None or a decided cause other than {self.cause!r}, got {self.also!r}")

    @property
    def why(self) -> str:
        """The reason for the failure in a few English sentences."""
        texts = [] if self.finding is None else [self.finding.text]
        if self.cause in ("environment differs", "not reproducible"):
            others = "" if self.cause == "environment differs" else ", and other episodes of the task succeed"
            ending = f"fails in a different way{others}" if self.succeeds_at is None else "succeeds"
            texts.insert(0, f"a plain re-run {ending}")
        elif self.shares:
            texts += [self._text_of_reruns(), self._text_of_plan()]
        return " ".join(f"{text[0].upper()}{text[1:]}." for text in texts if text)

    def _text_of_reruns(self) -> str:
        """Describe the results of re-running the episode in a clause."""
        if self.replaced is not None and self.also is not None:
            first, second = REPLACEMENTS[self.replaced]["inserted"]
            return f"with {first} the episode fails, and with {second} as well it succeeds"
        if self.replaced is not None:
            return self._text_of_success(self.replaced)
        if self.counterfactuals.get("plan"):
            return "the episode succeeds with the reference plan, but both plans request the same action in every state"
        if self.cause == "query" and "query" not in self.counterfactuals:
            return "these answers could not be replaced"
        if self.counterfactuals:
            *texts, last = map(replacement_text, self.counterfactuals)
            return f"the episode also fails with {' or with '.join([*filter(None, [', '.join(texts)]), last])}"
        return "no part of the policy could be replaced"

    def _text_of_success(self, name: str) -> str:
        """Return a clause that names the successful replacement and the fractions of episodes that re-runs fix."""
        expert = self.evidence.get("expert_steps", 0.0) if name in _SCRIPTED else 0.0
        others = f" (Meta-World's expert in {counted(int(expert), 'step')} without a scripted skill)" if expert else ""
        shares = [f"this fixes {self.shares.get(name, 1.0):.0%} of the task's failed episodes"]
        if name != "no noise" and "no noise" in self.shares:
            shares.append(f"a re-run without noise {self.shares['no noise']:.0%}")
        shares.append(f"a plain re-run {self.shares.get('nothing', 0.0):.0%}")
        success = f"the same episode succeeds, at t = {self.succeeds_at}"
        return f"with {replacement_text(name)}{others} {success}; {', '.join(shares)}"

    def _text_of_plan(self) -> str:
        """Return a clause if the success of a re-run does not show that the plan is sound, otherwise ""."""
        is_scripted = not _SCRIPTED.isdisjoint((self.replaced or "").split(" + "))
        if "generic_plan" in self.evidence:
            succeeds = "; the generic plan succeeds" if is_scripted else ", so the policy follows the generic plan"
            return f"the plan's steps are not understood{succeeds}"
        if is_scripted and "expert_steps" in self.evidence:
            unread = "the plan's steps are not understood, and " if "not_understood" in self.evidence else ""
            return f"{unread}the expert does not follow the plan, so this does not show that the plan is sound"
        return ""

    def to_json(self) -> dict[str, Any]:
        """Convert all fields except :attr:`mended` to JSON, and include the text of :attr:`why`."""
        content = {each.name: getattr(self, each.name) for each in fields(self) if each.compare} | {"why": self.why}
        return content if self.finding is None else {**content, "finding": vars(self.finding)}

    @classmethod
    def from_json(cls, content: Any) -> Failure:
        """Rebuild a failure from the result of :meth:`to_json`; raise :class:`ValueError` for any other JSON."""
        if isinstance(content, dict):
            content = {key: value for key, value in content.items() if key != "why"}
            if content.get("finding") is not None:
                content["finding"] = record_from_json(Finding, content["finding"])
        failure: Failure = record_from_json(cls, content)
        return failure


def replacement_text(name: str, parts: Literal["inserted", "removed"] = "inserted") -> str:
    """Return the parts that a replacement inserts or removes, for example "the true answers and scripted skills"."""
    return " and ".join(REPLACEMENTS[name][parts])


def record_from_json(kind: type[Any], content: Any) -> Any:
    """Build the dataclass ``kind`` from a JSON object, whose keys must be exactly the fields with ``compare=True``."""
    names = {each.name for each in fields(kind) if each.compare}
    if not isinstance(content, dict) or set(content) != names:
        keys = ", ".join(sorted(names))
        raise ValueError(f"a {kind.__name__} must be an object with the keys {keys}, got {shown(content)}")
    return kind(**content)
