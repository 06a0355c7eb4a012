"""The verdict of a page, in Markdown: how the episode ended and, where it failed, why."""

from __future__ import annotations

import numpy as np

from lw_torchrl.evaluation.failures import CAUSES, Failure
from lw_torchrl.record.heading import Heading
from lw_torchrl.record.recorded_episode import NOBODY, RecordedEpisode


def verdict(heading: Heading, episode: RecordedEpisode) -> str:
    """The text; without a :class:`Failure` a failed episode gets the plain facts."""
    length = len(episode)
    if episode.first_success is not None:
        held = int(episode.success.sum()) if episode.success is not None else 0
        lines = [f"## SUCCESS at step {episode.first_success} of {length}"]
        if episode.success is not None and not episode.success[-1]:
            lines.append(f"It did not last: the task stood done in {held} steps, and at the end no more.")
    elif heading.failure is not None:
        lines = [
            f"## FAILED, {heading.failure.cause}: {CAUSES[heading.failure.cause]}",
            *_why(heading.failure, episode),
        ]
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
    mended, useless = ([swap for swap, worked in failure.swaps.items() if worked == good] for good in (True, False))
    told = []
    if mended:
        told.append(f"exchanging {' or '.join(mended)} made it a success")
    if useless:
        told.append(f"exchanging {' or '.join(useless)} did not help")
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
        aim = episode.aims[last] if episode.aims else None
        if aim is not None and not aim.relative:
            distance = np.where(episode.in_force == last, aim.distance, np.inf)
            nearest = int(distance.argmin())
            facts.append(
                f"What it moves came within **{distance[nearest] * 100:.1f} cm** of where it goes, at step {nearest}; "
                f"at the end it was {aim.distance[-1] * 100:.1f} cm away."
            )
    answers = episode.answers
    never = [] if answers is None else [i for i in range(len(episode.steps)) if not answers[:, i].any()]
    if never:
        facts.append("Never held: " + "; ".join(f"condition {i + 1}, “{episode.steps[i][0]}”" for i in never) + ".")
    return facts


def _step(episode: RecordedEpisode, step: int) -> str:
    return f"step {step + 1}, **“{episode.steps[step][1]}”**"
