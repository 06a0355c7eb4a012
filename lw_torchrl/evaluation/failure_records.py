"""Failure: why a policy failed in one episode; tables of failures, and records of JSON, none of which is trusted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from math import isfinite
from reprlib import repr as short
from typing import Any, Literal, TypeVar

Rules = Iterable[tuple[str, bool, str]]  # a field, whether it is what it must be, and what that is
Record = TypeVar("Record")


def is_number(value: Any) -> bool:
    """Whether JSON's value is a finite number."""
    return type(value) in (int, float) and abs(value) < 1e300 and isfinite(value)


def is_integer(value: Any, minimum: int, maximum: int = 2**63 - 1) -> bool:
    """Whether JSON's value is an integer of this range."""
    return type(value) is int and minimum <= value <= maximum


def check_rules(argument: str, values: Mapping[str, Any], rules: Rules) -> None:
    """Raise :class:`ValueError` for the first value that is not what its rule says."""
    for name, holds, wanted in rules:
        if not holds:
            raise ValueError(f"{argument}: {name} must be {wanted}, got {short(values[name])}")


def read_records(
    argument: str, stated: Any, record: Callable[..., Record], rules: Callable[[Record], Rules]
) -> tuple[Record, ...]:
    """A list of objects as dataclasses, whose fields that are compared each must have."""
    if not isinstance(stated, list):
        raise ValueError(f"{argument} must be a list, got {short(stated)}")
    names = {field.name for field in fields(record) if field.compare}  # type: ignore[arg-type]
    found = []
    for number, entry in enumerate(stated):
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(
                f"{argument}[{number}] must be an object of {', '.join(sorted(names))}, got {short(entry)}"
            )
        found.append(record(**entry))
        check_rules(f"{argument}[{number}]", entry, rules(found[-1]))
    return tuple(found)


Cause = Literal["query", "plan", "skill", "out of time", "undecided"]

CAUSES: dict[str, str] = {
    "query": "a condition was answered wrongly",
    "plan": "the plan led astray",
    "skill": "a skill was clumsy",
    "out of time": "it was on its way",
    "undecided": "nothing that was tried tells",
}
"""Each cause, and what it means."""


@dataclass(frozen=True)
class Failure:
    """Why one episode failed.

    Attributes:
        task, seed, episode: which episode; ``episode_seed(task, seed, episode)`` is its seed.
        cause: one of :data:`CAUSES`.
        also: a second cause, where only both mended together let the episode succeed.
        step: the step of the plan that it hangs on, counted from 0; None where it is none's.
        at: the step of the episode to look at first, counted from 0.
        why: a sentence or two for people, with the numbers.
        evidence: name to number, what ``why`` rests on.
        counterfactuals: what was replaced, "query", "plan", "skill", "time", or two as "query + plan", and whether
            the same episode then succeeded; empty where none was tried.
    """

    task: str
    seed: int
    episode: int
    cause: Cause
    also: Cause | None
    step: int | None
    at: int
    why: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    counterfactuals: Mapping[str, bool] = field(default_factory=dict)


PARTS = ("query", "plan", "skill", "time")


def count_causes(tasks: Sequence[str], failures: Sequence[Failure]) -> dict[str, dict[str, int]]:
    """Task to each cause's number of failures."""
    found = {task: dict.fromkeys(CAUSES, 0) for task in tasks}
    for failure in failures:
        found[failure.task][failure.cause] += 1
    return found


def failure_table(tasks: Sequence[str], episodes_per_task: int, failures: Sequence[Failure]) -> str:
    """Why episodes failed: a row for each task, a column for each cause."""
    width = max(len("task"), len("all"), *map(len, tasks))
    lines = [f"{'task':{width}}  {'failed':>10}  " + "  ".join(f"{cause:>5}" for cause in CAUSES)]
    counts = count_causes(tasks, failures)
    if len(tasks) > 1:
        counts["all"] = {cause: sum(row[cause] for row in counts.values()) for cause in CAUSES}
    for task, row in counts.items():
        trials = episodes_per_task * (len(tasks) if task == "all" and len(tasks) > 1 else 1)
        cells = "  ".join(f"{number:>{max(5, len(cause))}}" for cause, number in row.items())
        lines.append(f"{task:{width}}  {f'{sum(row.values())} of {trials}':>10}  {cells}")
    return "\n".join(lines)


def read_failures(stated: Any, config: Mapping[str, Any], failed: Sequence[tuple[str, int]]) -> tuple[Failure, ...]:
    """The failures of a file: one for each failed episode, given by task and number, else :class:`ValueError`."""
    if isinstance(stated, list):  # earlier files say "swaps"
        new = {"swaps": "counterfactuals"}
        stated = [{new.get(k, k): v for k, v in one.items()} if isinstance(one, dict) else one for one in stated]
    found = read_records("failures", stated, Failure, lambda failure: _rules(failure, config))
    if sorted(failed) != sorted((failure.task, failure.episode) for failure in found):
        raise ValueError("failures must be one for each episode without success")
    return found


def _rules(failure: Failure, config: Mapping[str, Any]) -> Rules:
    cause, also, evidence, replaced = failure.cause, failure.also, failure.evidence, failure.counterfactuals
    causes = [name for name in CAUSES if name != "undecided"]
    yield "task", isinstance(failure.task, str) and failure.task in config["tasks"], "one of config"
    yield "seed", type(failure.seed) is int and failure.seed == config["seed"], "config's"
    yield "episode", is_integer(failure.episode, 0), "an integer of at least 0"
    yield "cause", isinstance(cause, str) and cause in CAUSES, f"one of {', '.join(CAUSES)}"
    second = isinstance(also, str) and also in causes and also != cause and cause in causes
    yield "also", also is None or second, "null or another cause than the first"
    yield "step", failure.step is None or is_integer(failure.step, 0, 2**31 - 1), "null or an integer of at least 0"
    yield "at", is_integer(failure.at, 0, config["max_steps"] - 1), "a step of the episode"
    yield "why", isinstance(failure.why, str), "a text"
    yield "evidence", isinstance(evidence, dict) and all(map(is_number, evidence.values())), "names and numbers"
    holds = isinstance(replaced, dict) and all(
        set(name.split(" + ")) <= set(PARTS) and type(bit) is bool for name, bit in replaced.items()
    )
    yield "counterfactuals", holds, f"some of {', '.join(PARTS)}, or two of them, to true or false"
