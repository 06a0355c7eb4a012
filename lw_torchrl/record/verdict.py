"""Heading and verdict of a page: of which episode it is, how it ended, why, and where to look first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lw_torchrl.evaluation.failure_records import CAUSES, Failure
from lw_torchrl.record.recorded_episode import NOBODY, RecordedEpisode

AFTER_SUCCESS, AROUND_FAILURE = 20, 60
"""How many steps after a first success are worth a look, and how many on both sides of where a failure is seen."""


@dataclass(frozen=True)
class Heading:
    """What a page says of its episode: which it is, of which environment's seed, who acted, and why it failed."""

    task: str
    episode: int | None = None
    seed: int | None = None
    policy: str | None = None
    failure: Failure | None = None

    @property
    def name(self) -> str:
        """What the episode is called in a recording if no other is: "push", or "push-7"."""
        return self.task if self.episode is None else f"{self.task}-{self.episode}"

    def parts(self) -> list[str]:
        """Task, episode, seed and policy, those that there are."""
        numbers = {"episode": self.episode, "seed": self.seed}
        known = [f"{name} {number}" for name, number in numbers.items() if number is not None]
        return [self.task, *known, *([] if self.policy is None else [self.policy])]

    def title(self, episode: RecordedEpisode, name: str | None) -> str:
        """The tab's: the name that a user gave or the task's, what else is known, and how it ended, if that is."""
        ended = "" if episode.success is None else "failed"
        if episode.first_success is not None:
            ended = f"success at {episode.first_success}"
        elif self.failure is not None:
            ended = f"failed: {self.failure.cause}"
        return " · ".join(filter(None, [name or self.task, *self.parts()[1:], ended]))


def decisive_step(heading: Heading, episode: RecordedEpisode) -> int:
    """The step to look at first: the failure's, else the first success, else the last."""
    if heading.failure is not None and episode.first_success is None:
        return min(heading.failure.at, len(episode))
    return len(episode) if episode.first_success is None else episode.first_success


def telling_steps(heading: Heading, episode: RecordedEpisode) -> tuple[int, int]:
    """The first and last step worth a look: up to a success, around where a failure is seen, or all."""
    at, length = decisive_step(heading, episode), len(episode)
    if episode.first_success is not None:
        return 0, min(at + AFTER_SUCCESS, length)
    if heading.failure is None:
        return 0, length
    first = max(0, min(at - AROUND_FAILURE, length - 2 * AROUND_FAILURE))
    return first, min(first + 2 * AROUND_FAILURE, length)


def verdict(heading: Heading, episode: RecordedEpisode) -> str:
    """The verdict, in Markdown; without a :class:`Failure` a failed episode gets the plain facts."""
    length = len(episode)
    if episode.first_success is not None:
        held = int(episode.success.sum()) if episode.success is not None else 0
        lines = [f"## SUCCESS at step {episode.first_success} of {length}"]
        if episode.success is not None and not episode.success[-1]:
            lines.append(f"It did not last: the task stood done in {held} steps, and at the end no more.")
    elif heading.failure is not None:
        cause = heading.failure.cause
        lines = [f"## FAILED, {cause}: {CAUSES[cause]}", *_why(heading.failure, episode)]
    elif episode.success is not None:
        lines = [f"## FAILED in {length} steps", *_facts(episode)]
    else:
        lines = [f"## {length} steps"]
    return "\n\n".join([*lines, " · ".join(heading.parts())]) + "\n"


def _why(failure: Failure, episode: RecordedEpisode) -> list[str]:
    lines = [failure.why] if failure.why else []
    if failure.also is not None:
        lines.append(f"Also: {failure.also}, {CAUSES[failure.also]}.")
    seen = f"Seen at step {failure.at} of {len(episode)}"
    if failure.step is not None and failure.step < len(episode.steps):
        seen += f", in {_step(episode, failure.step)}"
    lines.append(f"{seen}.")
    mended = [part for part, worked in failure.counterfactuals.items() if worked]
    useless = [part for part, worked in failure.counterfactuals.items() if not worked]
    told = [f"replacing {' or '.join(mended)} made it a success"] if mended else []
    told += [f"replacing {' or '.join(useless)} did not help"] if useless else []
    if told:
        lines.append("; ".join(told).capitalize() + ".")
    return lines


def _facts(episode: RecordedEpisode) -> list[str]:
    """What can be seen without asking why."""
    if episode.in_force is None or not episode.steps:
        return []
    facts = []
    last = int(episode.in_force[-1])
    if last == NOBODY:
        facts.append("At the end no step of the plan was in force alone.")
    else:
        steps = int((episode.in_force == last).sum())
        facts.append(f"At the end {_step(episode, last)}, was in force, as in {steps} of {len(episode)} steps.")
        pose = episode.target_poses[last] if episode.target_poses else None
        if pose is not None and not pose.relative:
            distance = np.where(episode.in_force == last, pose.distance, np.inf)
            nearest = int(distance.argmin())
            facts.append(
                f"What it moves came within **{distance[nearest] * 100:.1f} cm** of where it goes, at step {nearest}; "
                f"at the end it was {pose.distance[-1] * 100:.1f} cm away."
            )
    answers = episode.answers
    never = [] if answers is None else [i for i in range(len(episode.steps)) if not answers[:, i].any()]
    if never:
        facts.append("Never held: " + "; ".join(f"condition {i + 1}, “{episode.steps[i][0]}”" for i in never) + ".")
    return facts


def _step(episode: RecordedEpisode, step: int) -> str:
    return f"step {step + 1}, **“{episode.steps[step][1]}”**"
