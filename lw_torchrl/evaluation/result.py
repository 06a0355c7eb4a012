"""EvaluationResult: the outcome of each episode of an evaluation, saved as JSON."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from typing import Any

from torch import Tensor

from lw_torchrl._util.checks import Count, Finite, Natural, Scale, check_value, shown, typed_fields
from lw_torchrl._util.files import AnyPath, read_json, write_json
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.evaluation.diagnose.failure import CAUSES, Failure, record_from_json

FORMAT = "lw_torchrl.evaluation"
FORMAT_VERSION = 1
_CONFIG = {"episodes_per_task": Count, "max_steps": Count, "seed": int, "noise_scale": Scale, "stop_at_success": bool}


@typed_fields
@dataclass(frozen=True)
class EpisodeResult:
    """The outcome of one episode, which was seeded with ``episode_seed(task, seed, episode)``."""

    task: str
    episode: Natural
    success: bool  # whether any time step was successful
    first_success: Count | None  # the first successful time step, counted from 1
    success_at_end: bool | None  # whether the last time step was successful; None if stopped at the first success
    episode_return: Finite | None  # the sum of the rewards; None if the episode was stopped at the first success
    actions: Tensor | None = field(default=None, compare=False, repr=False)  # executed actions (T, 4); not saved


@dataclass(frozen=True)
class EvaluationResult:
    """The result of :func:`evaluate`, with episodes and failures sorted by task and episode."""

    config: dict[str, Any]  # tasks, episodes_per_task, seed, noise_scale, stop_at_success, max_steps
    episodes: tuple[EpisodeResult, ...]
    origin: dict[str, Any] = field(default_factory=dict, compare=False)  # provenance, recorded by save
    failures: tuple[Failure, ...] | None = None  # the cause of each failed episode; None without attribution

    def _by_task(self, value: Callable[[list[EpisodeResult]], float | None]) -> dict[str, float | None]:
        return {task: value([e for e in self.episodes if e.task == task]) for task in self.config["tasks"]}

    @cached_property
    def success_once(self) -> dict[str, float | None]:
        """The fraction of each task's episodes that succeeded at any time step: the main success rate."""
        return self._by_task(lambda episodes: sum(e.success for e in episodes) / len(episodes))

    @cached_property
    def success_at_end(self) -> dict[str, float | None]:
        """The fraction of each task's episodes that succeed at the last time step; None if episodes stopped early."""
        return self._by_task(lambda episodes: _mean([e.success_at_end for e in episodes]))

    @cached_property
    def first_success(self) -> dict[str, float | None]:
        """The mean first successful time step over each task's successful episodes; None if there are none."""
        return self._by_task(lambda episodes: _mean([e.first_success for e in episodes if e.success]))

    @cached_property
    def mean_return(self) -> dict[str, float | None]:
        """The mean return of each task's episodes; None if episodes were stopped early."""
        return self._by_task(lambda episodes: _mean([e.episode_return for e in episodes]))

    @property
    def mean_success(self) -> float:
        """The mean of :attr:`success_once` over the tasks."""
        rates = [rate for rate in self.success_once.values() if rate is not None]
        return sum(rates) / len(rates)

    def save(
        self,
        path: AnyPath,
        *,
        checkpoint: AnyPath | None = None,
        plans: str | None = None,
        evaluator: AnyPath | None = None,
    ) -> None:
        """Write the result as JSON with the date and package versions, atomically replacing an existing file.

        Args:
            path: the file to write.
            checkpoint, evaluator: the files of the actor and the evaluator, whose paths and SHA-256 are recorded.
            plans: the fingerprint of the plans, which is recorded.
        """
        now = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "versions": package_versions()}
        origin: dict[str, Any] = dict(self.origin) or now
        for name, file in (("checkpoint", checkpoint), ("evaluator", evaluator)):
            if file is not None:
                origin[name] = {"path": str(file), "sha256": sha256(Path(file).read_bytes()).hexdigest()}
        if plans is not None:
            origin["plans"] = plans
        content: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION, "origin": origin, "config": self.config}
        content["mean_success_once"] = self.mean_success
        content |= {k: getattr(self, k) for k in ("success_once", "success_at_end", "first_success", "mean_return")}
        content["episodes"] = [{k: v for k, v in asdict(e).items() if k != "actions"} for e in self.episodes]
        if self.failures is not None:
            content["failures"] = [failure.to_json() for failure in self.failures]
        write_json(path, content)

    @classmethod
    def load(cls, path: AnyPath) -> EvaluationResult:
        """Read a result file; raise :class:`ValueError` if the file is corrupted or not a result of this version."""
        try:
            content = read_json(path, "the result")
            if (content["format"], content["version"]) != (FORMAT, FORMAT_VERSION) or content["version"] is True:
                raise ValueError(f"format {shown(content['format'])} version {shown(content['version'])}")
            config = check_value("config", content["config"], dict)
            tasks = check_value("config: tasks", config["tasks"], list[str])
            for name, hint in _CONFIG.items():
                check_value(f"config: {name}", config[name], hint)
            episodes = tuple(record_from_json(EpisodeResult, entry) for entry in content["episodes"])
            failures = None
            if "failures" in content:
                failures = tuple(map(Failure.from_json, check_value("failures", content["failures"], list)))
            result = cls(config, episodes, check_value("origin", content.get("origin", {}), dict), failures)
            number, last = config["episodes_per_task"], config["max_steps"]
            for episode in episodes:
                first = episode.first_success
                if episode.success == (first is None) or (first or 0) > last or (episode.success_at_end and not first):
                    raise ValueError(f"episodes: success, first_success and success_at_end must agree, got {episode}")
            counts = Counter(task for task, _ in {(episode.task, episode.episode) for episode in episodes})
            if not tasks or counts != dict.fromkeys(tasks, number) or len(episodes) != number * len(tasks):
                raise ValueError(f"episodes must hold {number} episodes of each task in config, got {dict(counts)}")
            failed = sorted((e.task, e.episode, config["seed"]) for e in episodes if not e.success)
            attributed = failed if failures is None else sorted((f.task, f.episode, f.seed) for f in failures)
            if failed != attributed or any(failure.at >= last for failure in failures or ()):
                raise ValueError(f"failures must hold one Failure per failed episode, with its seed and t < {last}")
            if set(content["success_once"]) != {*tasks}:
                raise ValueError("success_once and config must have the same tasks")
            return result
        except (ValueError, KeyError, TypeError) as error:
            name = f"{str(path)!r} is not a result of {FORMAT} version {FORMAT_VERSION}"
            raise ValueError(f"path: {name} ({type(error).__name__}: {str(error)[:500]})") from error

    def table(self) -> str:
        """Return a text table of each task's success rates and mean first successful time step."""
        lines = [f"{'task':28} {'any step':>8} {'at end':>8} {'first step':>10}"]
        ends, firsts = self.success_at_end, self.first_success
        rows = [(task, once, ends[task], firsts[task]) for task, once in self.success_once.items()]
        for name, *rates, first in [*rows, ("mean", self.mean_success, _mean(self.success_at_end.values()), None)]:
            once, end = ("-" if rate is None else f"{rate:.2f}" for rate in rates)
            lines.append(f"{name:28} {once:>8} {end:>8} {'-' if first is None else f'{first:.0f}':>10}")
        return "\n".join(lines)

    def failure_counts(self) -> dict[str, Counter[str]]:
        """Return, for each task, the number of failures with each cause; raise ValueError if ``failures`` is None."""
        if self.failures is None:
            raise ValueError("the result has no failures; run evaluate(..., attribute=True) to attribute failures")
        tasks = self.config["tasks"]
        return {task: Counter(failure.cause for failure in self.failures if failure.task == task) for task in tasks}

    def failure_table(self) -> str:
        """Return a text table of the number of failed episodes, with one row per task and one column per cause."""
        counts, number = self.failure_counts(), self.config["episodes_per_task"]
        rows = [(task, causes, number) for task, causes in counts.items()]
        if len(rows) > 1:
            rows.append(("all", sum(counts.values(), Counter()), number * len(rows)))
        causes = [cause for cause in CAUSES if any(row[cause] for row in counts.values())]
        width = max(len("task"), *map(len, counts))
        lines = [f"{'task':{width}}  {'failed':>10}  " + "  ".join(f"{cause:>5}" for cause in causes)]
        for task, row, trials in rows:
            cells = "  ".join(f"{row[cause]:>{max(5, len(cause))}}" for cause in causes)
            lines.append(f"{task:{width}}  {f'{row.total()} of {trials}':>10}  {cells}")
        return "\n".join(lines)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval for a success rate over the episodes of one policy."""
    rate, z = successes / trials, 1.96
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    return max(0.0, center - half), min(1.0, center + half)


def _mean(values: Collection[Any]) -> float | None:
    return None if not values or None in values else sum(values) / len(values)
