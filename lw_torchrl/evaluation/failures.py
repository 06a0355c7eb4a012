"""Failure: why a policy failed in one episode; tables of failures, and their JSON, read with nothing taken on trust."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from reprlib import repr as short
from typing import TYPE_CHECKING, Any, Literal

if TYPE_CHECKING:
    from lw_torchrl.evaluation.result import EpisodeResult

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
        task: the task's name.
        seed, episode: its episode; ``episode_seed(task, seed, episode)`` is its seed.
        cause: one of :data:`CAUSES`.
        also: a second cause, where only both mended together let the episode succeed.
        step: the step of the plan that it hangs on, counted from 0; None where it is none's.
        at: the step of the episode to look at first, counted from 0.
        why: a sentence or two for people, with the numbers.
        evidence: name to number, what ``why`` rests on.
        swaps: what was exchanged, "query", "plan", "skill", "time", or two as "query + plan", and whether the
            same episode then succeeded; empty where none was tried.
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
    swaps: Mapping[str, bool] = field(default_factory=dict)


SWAPS = ("query", "plan", "skill", "time")


def count_causes(tasks: Sequence[str], failures: Sequence[Failure]) -> dict[str, dict[str, int]]:
    """Task to each cause's number of failures."""
    found = {task: dict.fromkeys(CAUSES, 0) for task in tasks}
    for failure in failures:
        found[failure.task][failure.cause] += 1
    return found


def failure_table(tasks: Sequence[str], episodes_per_task: int, failures: Sequence[Failure]) -> str:
    """Why episodes failed: a row for each task, a column for each cause.

    Example:
        >>> print(failure_table(["reach"], 20, [Failure("reach", 0, 3, "skill", None, 1, 40, "It missed.")]))
        task       failed  query   plan  skill  out of time  undecided
        reach     1 of 20      0      0      1            0          0
    """
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


def read_failures(stated: Any, config: Mapping[str, Any], episodes: Sequence[EpisodeResult]) -> tuple[Failure, ...]:
    """The failures of a file: one for each failed episode, else :class:`ValueError`."""
    if not isinstance(stated, list):
        raise ValueError(f"failures must be a list, got {short(stated)}")
    names = set(Failure.__dataclass_fields__)
    found = []
    for number, entry in enumerate(stated):
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(f"failures[{number}] must be an object of {', '.join(sorted(names))}, got {short(entry)}")
        failure = Failure(**entry)
        for name, holds, wanted in _rules(failure, config):
            if not holds:
                raise ValueError(f"failures[{number}]: {name} must be {wanted}, got {short(entry[name])}")
        found.append(failure)
    failed = [(episode.task, episode.episode) for episode in episodes if not episode.success]
    if sorted(failed) != sorted((failure.task, failure.episode) for failure in found):
        raise ValueError("failures must be one for each episode without success")
    return tuple(found)


def _rules(failure: Failure, config: Mapping[str, Any]) -> list[tuple[str, bool, str]]:
    """A field, whether it is what it must be, and what that is."""
    cause, also, step, evidence, swaps = failure.cause, failure.also, failure.step, failure.evidence, failure.swaps
    causes = [name for name in CAUSES if name != "undecided"]
    return [
        ("task", isinstance(failure.task, str) and failure.task in config["tasks"], "one of config"),
        ("seed", type(failure.seed) is int and failure.seed == config["seed"], "config's"),
        ("episode", type(failure.episode) is int and failure.episode >= 0, "an integer of at least 0"),
        ("cause", isinstance(cause, str) and cause in CAUSES, f"one of {', '.join(CAUSES)}"),
        (
            "also",
            also is None or (isinstance(also, str) and also in causes and also != cause and cause in causes),
            "null or another cause than the first",
        ),
        ("step", step is None or (type(step) is int and 0 <= step < 2**31), "null or an integer of at least 0"),
        ("at", type(failure.at) is int and 0 <= failure.at < config["max_steps"], "a step of the episode"),
        ("why", isinstance(failure.why, str), "a text"),
        ("evidence", isinstance(evidence, dict) and all(map(is_number, evidence.values())), "names and numbers"),
        (
            "swaps",
            isinstance(swaps, dict)
            and all(set(name.split(" + ")) <= set(SWAPS) and type(bit) is bool for name, bit in swaps.items()),
            f"some of {', '.join(SWAPS)}, or two of them, to true or false",
        ),
    ]


def is_number(value: Any) -> bool:
    """Whether JSON's value is a finite number."""
    return type(value) in (int, float) and abs(value) < 1e300 and isfinite(value)
