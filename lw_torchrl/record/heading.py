"""Heading: of which episode a page is, how it ended, and where to look first."""

from __future__ import annotations

from dataclasses import dataclass

from lw_torchrl.evaluation.failures import Failure
from lw_torchrl.record.recorded_episode import RecordedEpisode

AFTER_SUCCESS, AROUND_FAILURE = 20, 60
"""How many steps after a first success are worth a look, and how many on both sides of where a failure is seen."""


@dataclass(frozen=True)
class Heading:
    """What a page says of its episode.

    Attributes:
        task: the task's name.
        episode, seed: which episode, and of which environment; None where nobody said.
        policy: who acted, in a word.
        failure: why it failed, if that was found out.
    """

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
        return [
            self.task,
            *([] if self.episode is None else [f"episode {self.episode}"]),
            *([] if self.seed is None else [f"seed {self.seed}"]),
            *([] if self.policy is None else [self.policy]),
        ]

    def outcome(self, episode: RecordedEpisode) -> str:
        """How it ended: "success at 87", "failed: skill", "failed"; nothing where the rollout does not say."""
        if episode.first_success is not None:
            return f"success at {episode.first_success}"
        if self.failure is not None:
            return f"failed: {self.failure.cause}"
        return "" if episode.success is None else "failed"

    def title(self, episode: RecordedEpisode, name: str | None) -> str:
        """The tab's: the name that a user gave or the task's, what else is known, and how it ended."""
        told = [name or self.task, *self.parts()[1:], self.outcome(episode)]
        return " · ".join(filter(None, told))


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
