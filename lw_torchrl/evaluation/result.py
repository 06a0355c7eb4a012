"""EvaluationResult: what an evaluation measured, episode by episode, as JSON."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from lw_torchrl._files import write_json

FORMAT = "lw_torchrl.evaluation"
FORMAT_VERSION = 1


@dataclass(frozen=True)
class EpisodeResult:
    """One evaluated episode.

    Attributes:
        task: the task's name.
        episode: its index; ``episode_seed(task, seed, episode)`` is its seed.
        success: at some step.
        first_success: the first successful step, from 1; None without success.
        success_at_end: at the last step; None where the episode was stopped at its success.
        episode_return: the sum of the rewards; None where the episode was stopped.
        actions: (T, 4) float32, as executed, if they were recorded; they are not saved.
    """

    task: str
    episode: int
    success: bool
    first_success: int | None
    success_at_end: bool | None
    episode_return: float | None
    actions: Tensor | None = field(default=None, compare=False, repr=False)


@dataclass(frozen=True)
class EvaluationResult:
    """The result of :func:`evaluate`.

    Attributes:
        config: tasks, episodes_per_task, seed, noise_scale, stop_at_success, max_steps.
        episodes: one record each, by task and episode.
    """

    config: dict[str, Any]
    episodes: tuple[EpisodeResult, ...]

    def _by_task(self, value: Callable[[list[EpisodeResult]], float | None]) -> dict[str, float | None]:
        return {
            task: value([episode for episode in self.episodes if episode.task == task]) for task in self.config["tasks"]
        }

    @cached_property
    def success_once(self) -> dict[str, float | None]:
        """Task to the fraction of its episodes that succeeded at some step: the headline."""
        return self._by_task(lambda found: sum(e.success for e in found) / len(found))

    @cached_property
    def success_at_end(self) -> dict[str, float | None]:
        """Task to the fraction of its episodes that stood in success at the last step; None if stopped early."""
        return self._by_task(lambda found: _mean([e.success_at_end for e in found]))

    @cached_property
    def first_success(self) -> dict[str, float | None]:
        """Task to the mean first successful step over its successful episodes; None where there is none."""
        return self._by_task(lambda found: _mean([e.first_success for e in found if e.success]))

    @cached_property
    def mean_return(self) -> dict[str, float | None]:
        """Task to the mean sum of rewards; None if episodes were stopped early."""
        return self._by_task(lambda found: _mean([e.episode_return for e in found]))

    @property
    def mean_success(self) -> float:
        """The mean of :attr:`success_once` over the tasks."""
        rates = [rate for rate in self.success_once.values() if rate is not None]
        return sum(rates) / len(rates)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the result as JSON; a file is replaced whole or not at all."""
        episodes = [{k: v for k, v in asdict(e).items() if k != "actions"} for e in self.episodes]
        write_json(
            path,
            {
                "format": FORMAT,
                "version": FORMAT_VERSION,
                "config": self.config,
                "mean_success_once": self.mean_success,
                "success_once": self.success_once,
                "success_at_end": self.success_at_end,
                "first_success": self.first_success,
                "mean_return": self.mean_return,
                "episodes": episodes,
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> EvaluationResult:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is damaged, or no result of this format and version.
        """
        try:
            found = json.loads(Path(path).read_text("utf-8"))
            if (found["format"], found["version"]) != (FORMAT, FORMAT_VERSION):
                raise ValueError(f"format {found['format']!r} version {found['version']!r}")
            result = cls(found["config"], tuple(EpisodeResult(**episode) for episode in found["episodes"]))
            if set(result.config["tasks"]) != {episode.task for episode in result.episodes}:
                raise ValueError("its tasks and its episodes do not agree")
            return result
        except FileNotFoundError:
            raise FileNotFoundError(
                f"path: no result file {str(path)!r}; evaluate(...).save(path) writes one"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"path: {str(path)!r} is no result of {FORMAT} version {FORMAT_VERSION} ({error})"
            ) from error

    def table(self) -> str:
        """The rates per task as text in columns."""
        lines = [f"{'task':28} {'any step':>8} {'at end':>8} {'first step':>10}"]

        def row(name: str, once: float | None, end: float | None, first: float | None) -> str:
            cells = [
                "-" if once is None else f"{once:.2f}",
                "-" if end is None else f"{end:.2f}",
                "-" if first is None else f"{first:.0f}",
            ]
            return f"{name:28} {cells[0]:>8} {cells[1]:>8} {cells[2]:>10}"

        for task, rate in self.success_once.items():
            lines.append(row(task, rate, self.success_at_end[task], self.first_success[task]))
        lines.append(row("mean", self.mean_success, _mean(list(self.success_at_end.values())), None))
        return "\n".join(lines)


def _mean(values: list[Any]) -> float | None:
    if not values or any(value is None for value in values):
        return None
    return sum(values) / len(values)
