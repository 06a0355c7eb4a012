"""Failure: why a policy failed in one episode, and what that rests on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

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
