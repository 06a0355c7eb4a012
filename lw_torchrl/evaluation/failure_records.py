"""Failure: why a policy failed in one episode; tables of failures, and records of JSON, none of which is trusted."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from reprlib import repr as short
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from lw_torchrl._checks import Natural, check_fields

if TYPE_CHECKING:
    from tensordict import TensorDictBase

    from lw_torchrl.language.plans import ConditionalPlan


def is_number(value: Any) -> bool:
    """Whether JSON's value is a number that can be summed."""
    return type(value) in (int, float) and abs(value) < 1e300


def read_records(argument: str, stated: Any, record: Any, faults: Callable[[Any], Iterable[str]]) -> tuple[Any, ...]:
    """A list of objects as dataclasses, whose fields that are compared each must have; ``faults`` says what a record
    must be and is not."""
    if not isinstance(stated, list):
        raise ValueError(f"{argument} must be a list, got {short(stated)}")
    names, found = {field.name for field in fields(record) if field.compare}, []
    for number, entry in enumerate(stated):
        where = f"{argument}[{number}]"
        if not isinstance(entry, dict) or set(entry) != names:
            raise ValueError(f"{where} must be an object of {', '.join(sorted(names))}, got {short(entry)}")
        found.append(record(**entry))
        check_fields(found[-1], f"{where}: ")
        for fault in faults(found[-1]):
            raise ValueError(f"{where}: {fault}, got {short(entry)}")
    return tuple(found)


Told = Literal["not reproducible", "perception", "query", "plan", "skill", "gripper", "actuation", "policy"]
Cause = Literal[Told, "out of time", "undecided"]

CAUSES: dict[str, str] = {
    "not reproducible": "run again with nothing replaced, it succeeds",
    "perception": "the policy was shown another state than the true one",
    "query": "a condition was answered wrongly",
    "plan": "the plan led astray",
    "skill": "a skill was clumsy",
    "gripper": "the gripper opened or closed wrongly",
    "actuation": "the hand moved wrongly, not in one step alone",
    "policy": "the policy, not told which part of it",
    "out of time": "it was on its way",
    "undecided": "nothing that was tried tells",
}
"""Each cause, and what it means."""


class MendedEpisode(NamedTuple):
    """A failed episode as it goes with a part replaced: it succeeds.

    Attributes:
        by: what was replaced, in words: "the reference plan".
        plan: the plan that was carried out, and that ``steps["qaf"]`` answers.
        steps: of batch (T,), up to the first success: ``observation`` (T, 39) float32, ``action`` (T, 4) float32 as
            executed, ``task_id`` (T,) and ``episode`` (T,) int64, ``("next", "success")`` (T, 1) bool and
            ``("next", "reward")`` (T, 1) float32; where there are any, ``qaf`` (T, S) bool and ``skill_weights`` (T, S)
            float32.
    """

    by: str
    plan: ConditionalPlan
    steps: TensorDictBase


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
        counterfactuals: what was replaced, and whether the same episode then succeeded; empty where none was tried.
            "perception", the observations; "query", the answers; "plan"; "skill", what one
            step of the plan does; "gripper" and "actuation", one part of the action in all steps; "policy", the whole
            action in all steps; "time"; or two as "query + plan", where "skill" is in all steps.
        mended: the same episode with the cause replaced, where it then succeeds; it is not saved.
    """

    task: str
    seed: int
    episode: Natural
    cause: Cause
    also: Cause | None
    step: Natural | None
    at: Natural
    why: str
    evidence: Mapping[str, float] = field(default_factory=dict)
    counterfactuals: Mapping[str, bool] = field(default_factory=dict)
    mended: MendedEpisode | None = field(default=None, compare=False, repr=False)

    def to_json(self) -> dict[str, Any]:
        """All but :attr:`mended`, as JSON holds it."""
        found = {one.name: getattr(self, one.name) for one in fields(self) if one.compare}
        return {name: dict(value) if isinstance(value, Mapping) else value for name, value in found.items()}


PARTS: dict[str, str] = {
    "perception": "the observations",
    "query": "the answers",
    "plan": "the plan",
    "skill": "the skill of one step",
    "gripper": "the gripper's commands",
    "actuation": "the hand's motion",
    "policy": "all actions",
    "time": "the time limit",
}
"""What a counterfactual replaces, in words."""


def part_words(name: str) -> str:
    """What a counterfactual of :attr:`Failure.counterfactuals` replaces: "the answers and the plan"."""
    names = name.split(" + ")
    return " and ".join(PARTS["policy" if one == "skill" and len(names) > 1 else one] for one in names)


def count_causes(tasks: Sequence[str], failures: Sequence[Failure]) -> dict[str, dict[str, int]]:
    """Task to each cause's number of failures."""
    found = {task: dict.fromkeys(CAUSES, 0) for task in tasks}
    for failure in failures:
        found[failure.task][failure.cause] += 1
    return found


def failure_table(tasks: Sequence[str], episodes_per_task: int, failures: Sequence[Failure]) -> str:
    """Why episodes failed: a row for each task, a column for each cause that there is."""
    there = [cause for cause in CAUSES if any(failure.cause == cause for failure in failures)]
    width = max(len("task"), len("all"), *map(len, tasks))
    lines = [f"{'task':{width}}  {'failed':>10}  " + "  ".join(f"{cause:>5}" for cause in there)]
    counts = count_causes(tasks, failures)
    if len(tasks) > 1:
        counts["all"] = {cause: sum(row[cause] for row in counts.values()) for cause in there}
    for task, row in counts.items():
        trials = episodes_per_task * (len(tasks) if task == "all" and len(tasks) > 1 else 1)
        cells = "  ".join(f"{number:>{max(5, len(cause))}}" for cause, number in row.items() if cause in there)
        lines.append(f"{task:{width}}  {f'{sum(row.values())} of {trials}':>10}  {cells}")
    return "\n".join(lines)


def read_failures(stated: Any, config: Mapping[str, Any], failed: Sequence[tuple[str, int]]) -> tuple[Failure, ...]:
    """The failures of a file: one for each failed episode, given by task and number, else :class:`ValueError`."""

    def faults(one: Failure) -> Iterator[str]:
        if one.seed != config["seed"]:
            yield "seed must be config's"
        if one.also is not None and (one.also == one.cause or "undecided" in (one.also, one.cause)):
            yield "also must be null or another cause than the first"
        if one.at >= config["max_steps"]:
            yield "at must be a step of the episode"
        if not isinstance(one.evidence, dict) or not all(map(is_number, one.evidence.values())):
            yield "evidence must be names and numbers"
        tried = one.counterfactuals.items() if isinstance(one.counterfactuals, dict) else [("", 0)]
        if not all(set(name.split(" + ")) <= set(PARTS) and type(bit) is bool for name, bit in tried):
            yield f"counterfactuals must be some of {', '.join(PARTS)}, or two of them, to true or false"

    if isinstance(stated, list):  # earlier files say "swaps"
        new = {"swaps": "counterfactuals"}
        stated = [{new.get(k, k): v for k, v in one.items()} if isinstance(one, dict) else one for one in stated]
    found = read_records("failures", stated, Failure, faults)
    if sorted(failed) != sorted((failure.task, failure.episode) for failure in found):
        raise ValueError("failures must be one for each episode without success")
    return found
