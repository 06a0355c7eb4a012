"""Failure: why one episode failed, as typed data, and its form in JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from reprlib import repr as short
from typing import TYPE_CHECKING, Any, NamedTuple, get_args

from lw_torchrl._util.checks import ArgumentError, Count, Natural, typed_fields
from lw_torchrl.evaluation.diagnose.findings import CAUSES, FINDINGS, REPLACEMENTS, Cause, Finding
from lw_torchrl.evaluation.diagnose.sentences import explain_failure

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from lw_torchrl.language.plans import ConditionalPlan


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
        finding: what the episode's states show of the cause, or of ``suspect``.
        replaced: the replacement that decided, one of :data:`REPLACEMENTS`; None without one.
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
    replaced: str | None = None
    rival: str | None = None
    succeeds_at: Count | None = None
    scripted_step: Natural | None = None
    suspect: Cause | None = None
    evidence: Mapping[str, float] = field(default_factory=dict)
    counterfactuals: Mapping[str, bool] = field(default_factory=dict)
    shares: Mapping[str, float] = field(default_factory=dict)
    mended: MendedEpisode | None = field(default=None, compare=False, repr=False)

    @property
    def why(self) -> str:
        """The failure in a few English sentences."""
        return explain_failure(self)

    def to_json(self) -> dict[str, Any]:
        """All fields except :attr:`mended`, as JSON."""
        return {one.name: _to_json(getattr(self, one.name)) for one in fields(self) if one.compare}


def _to_json(value: Any) -> Any:
    if isinstance(value, get_args(Finding)):
        return {"kind": type(value).__name__, **vars(value)}
    return dict(value) if isinstance(value, Mapping) else value


def is_number(value: Any) -> bool:
    """Return whether JSON's value is a number that can be summed."""
    return type(value) in (int, float) and abs(value) < 1e300


def read_records(
    argument: str,
    stated: Any,
    record: Any,
    faults: Callable[[Any], Iterable[str]],
    parse: Callable[[str, dict[str, Any]], dict[str, Any]] = lambda where, entry: entry,
) -> tuple[Any, ...]:
    """Read a list of JSON objects as dataclasses of exactly their compared fields, each converted by ``parse``.

    ``faults`` yields what is wrong with a record, which raises :class:`ValueError`.
    """
    if not isinstance(stated, list):
        raise ValueError(f"{argument} must be a list, got {short(stated)}")
    names, records = {field.name for field in fields(record) if field.compare}, []
    for number, entry in enumerate(stated):
        where = f"{argument}[{number}]"
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(f"{where} must be an object of {', '.join(sorted(names))}, got {short(entry)}")
        try:
            records.append(record(**parse(where, entry)))
        except ArgumentError as error:
            raise ArgumentError(f"{where}: {error}") from None
        for fault in faults(records[-1]):
            raise ValueError(f"{where}: {fault}, got {short(entry)}")
    return tuple(records)


def _read_finding(where: str, stated: Any) -> Any:
    """Return the finding of a file; raise :class:`ValueError` if it is not one."""
    if stated is None:
        return None
    kind = FINDINGS.get(str(stated.get("kind"))) if isinstance(stated, dict) else None
    if kind is None or set(stated) != {"kind", *(one.name for one in fields(kind))}:
        kinds = ", ".join(FINDINGS)
        raise ValueError(f"{where} must be null, or a kind of {kinds} with its fields, got {short(stated)}")
    try:
        return kind(**{name: value for name, value in stated.items() if name != "kind"})
    except ArgumentError as error:
        raise ArgumentError(f"{where}: {error}") from None


def read_failures(stated: Any, config: Mapping[str, Any], failed: Sequence[tuple[str, int]]) -> tuple[Failure, ...]:
    """Return the failures of a file: one for each failed episode, (task, episode); otherwise :class:`ValueError`."""

    def faults(one: Failure) -> Iterator[str]:
        if one.seed != config["seed"]:
            yield "seed must be config's"
        if one.also is not None and (one.also == one.cause or "undecided" in (one.also, one.cause)):
            yield "also must be null or another cause than the first"
        if one.at >= config["max_steps"]:
            yield "at must be a step of the episode"
        for name in ("evidence", "shares"):
            numbers = getattr(one, name)
            if not isinstance(numbers, dict) or not all(map(is_number, numbers.values())):
                yield f"{name} must be names and numbers"
        tried = one.counterfactuals.items() if isinstance(one.counterfactuals, dict) else [("", 0)]
        if not all(name in REPLACEMENTS and type(value) is bool for name, value in tried):
            yield f"counterfactuals must be some of {', '.join(REPLACEMENTS)}, to true or false"
        if not {one.replaced, one.rival} <= {None, *REPLACEMENTS}:
            yield f"replaced and rival must be null or one of {', '.join(REPLACEMENTS)}"

    def parse(where: str, entry: dict[str, Any]) -> dict[str, Any]:
        return entry | {"finding": _read_finding(f"{where}.finding", entry["finding"])}

    found = read_records("failures", stated, Failure, faults, parse)
    if sorted(failed) != sorted((failure.task, failure.episode) for failure in found):
        raise ValueError("failures must be one for each episode without success")
    return found


def count_causes(tasks: Sequence[str], failures: Sequence[Failure]) -> dict[str, Counter[str]]:
    """Return the number of failures of each cause, by task."""
    return {task: Counter(failure.cause for failure in failures if failure.task == task) for task in tasks}


def failure_table(tasks: Sequence[str], episodes_per_task: int, failures: Sequence[Failure]) -> str:
    """Return the numbers of failures as text: a row for each task, a column for each cause that occurs."""
    causes = [cause for cause in CAUSES if any(failure.cause == cause for failure in failures)]
    width = max(len("task"), *map(len, tasks))
    lines = [f"{'task':{width}}  {'failed':>10}  " + "  ".join(f"{cause:>5}" for cause in causes)]
    counts = count_causes(tasks, failures)
    if len(tasks) > 1:
        counts["all"] = Counter(failure.cause for failure in failures)
    for task, row in counts.items():
        trials = episodes_per_task * (len(tasks) if task == "all" and len(tasks) > 1 else 1)
        cells = "  ".join(f"{row[cause]:>{max(5, len(cause))}}" for cause in causes)
        lines.append(f"{task:{width}}  {f'{sum(row.values())} of {trials}':>10}  {cells}")
    return "\n".join(lines)
