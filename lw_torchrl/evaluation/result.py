"""EvaluationResult: the outcome of an evaluation, episode by episode, as JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from reprlib import repr as short
from typing import Any

from torch import Tensor

from lw_torchrl._util.checks import Count, Natural, Scale, check_value, typed_fields
from lw_torchrl._util.files import AnyPath, read_json, write_json
from lw_torchrl._util.reproducibility import package_versions
from lw_torchrl.evaluation.diagnose.failure import Failure, failure_table, is_number, read_failures, read_records

FORMAT = "lw_torchrl.evaluation"
FORMAT_VERSION = 1


@typed_fields
@dataclass(frozen=True)
class EpisodeResult:
    """One evaluated episode; ``episode_seed(task, seed, episode)`` is its seed."""

    task: str
    episode: Natural
    success: bool  # at some step
    first_success: Count | None  # the first successful step, from 1
    success_at_end: bool | None  # at the last step; None if the episode was stopped at its success
    episode_return: float | None  # the sum of the rewards; None if the episode was stopped
    actions: Tensor | None = field(default=None, compare=False, repr=False)  # (T, 4) as executed; they are not saved


@dataclass(frozen=True)
class EvaluationResult:
    """The result of :func:`evaluate`, with episodes and failures by task and episode."""

    config: dict[str, Any]  # tasks, episodes_per_task, seed, noise_scale, stop_at_success, max_steps
    episodes: tuple[EpisodeResult, ...]
    origin: dict[str, Any] = field(default_factory=dict, compare=False)  # provenance, as save noted it
    failures: tuple[Failure, ...] | None = None  # why each failed episode failed; None unless they were attributed

    def _by_task(self, value: Callable[[list[EpisodeResult]], float | None]) -> dict[str, float | None]:
        found: dict[str, list[EpisodeResult]] = {}
        for episode in self.episodes:
            found.setdefault(episode.task, []).append(episode)
        return {task: value(found.get(task, [])) for task in self.config["tasks"]}

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

    def save(
        self,
        path: AnyPath,
        *,
        checkpoint: AnyPath | None = None,
        plans: str | None = None,
        evaluator: AnyPath | None = None,
    ) -> None:
        """Write the result as JSON, with date and versions; a file is replaced whole or not at all.

        Args:
            path: the file.
            checkpoint, evaluator: the files of the actor and its evaluator; their paths and SHA-256 are noted.
            plans: the fingerprint of the plans.
        """
        made = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "versions": package_versions()}
        origin: dict[str, Any] = dict(self.origin) or made
        for name, given in (("checkpoint", checkpoint), ("evaluator", evaluator)):
            if given is not None:
                origin[name] = {"path": str(given), "sha256": sha256(Path(given).read_bytes()).hexdigest()}
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
        """Read a result; raise :class:`ValueError` if the file is damaged or not a result of this version."""
        try:
            found = read_json(path, "the result")
            if (found["format"], found["version"]) != (FORMAT, FORMAT_VERSION) or type(found["version"]) is not int:
                raise ValueError(f"format {short(found['format'])} version {short(found['version'])}")
            config, origin = found["config"], found.get("origin", {})
            if not isinstance(config, dict) or not isinstance(origin, dict):
                raise ValueError("its config and its origin must be objects")
            _check_config(config)
            episodes = _read_episodes(found["episodes"], config)
            if not isinstance(found["success_once"], dict) or set(found["success_once"]) != set(config["tasks"]):
                raise ValueError("the tasks of its success_once are not those of its config")
            failed = [(episode.task, episode.episode) for episode in episodes if not episode.success]
            failures = read_failures(found["failures"], config, failed) if "failures" in found else None
            return cls(config, episodes, origin, failures)
        except FileNotFoundError:
            raise FileNotFoundError(f"path: no result file {str(path)!r}; evaluate(...).save(path) writes it") from None
        except (ValueError, KeyError, TypeError) as error:
            what, why = f"result of {FORMAT} version {FORMAT_VERSION}", f"{type(error).__name__}: {str(error)[:500]}"
            raise ValueError(f"path: {str(path)!r} is not a {what} ({why})") from error

    def table(self) -> str:
        """Return the rates per task as text in columns."""
        lines = [f"{'task':28} {'any step':>8} {'at end':>8} {'first step':>10}"]
        ends, firsts = self.success_at_end, self.first_success
        rows = [(task, once, ends[task], firsts[task]) for task, once in self.success_once.items()]
        for name, *rates, first in [*rows, ("mean", self.mean_success, _mean(self.success_at_end.values()), None)]:
            once, end = ("-" if rate is None else f"{rate:.2f}" for rate in rates)
            lines.append(f"{name:28} {once:>8} {end:>8} {'-' if first is None else f'{first:.0f}':>10}")
        return "\n".join(lines)

    def failure_table(self) -> str:
        """Return the numbers of failed episodes as text: a row for each task, a column for each cause."""
        return failure_table(self.config["tasks"], self.config["episodes_per_task"], attributed(self))


def attributed(result: EvaluationResult) -> tuple[Failure, ...]:
    """Return the failures; raise :class:`ValueError` if they were not attributed."""
    if result.failures is None:
        raise ValueError("the result has no failures: they are attributed by evaluate(..., attribute=True)")
    return result.failures


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % Wilson score interval of a success rate over the episodes of one policy."""
    rate, z = successes / trials, 1.96
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * math.sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    return max(0.0, center - half), min(1.0, center + half)


def _mean(values: Collection[Any]) -> float | None:
    return None if not values or None in values else sum(values) / len(values)


def _check_config(config: dict[str, Any]) -> None:
    tasks = config["tasks"]
    named = isinstance(tasks, list) and all(isinstance(task, str) for task in tasks)
    if not named or not tasks or len(set(tasks)) != len(tasks):
        raise ValueError(f"config: tasks must be different names, got {short(tasks)}")
    for name in ("episodes_per_task", "max_steps"):
        check_value(f"config: {name}", config[name], Count)
    check_value("config: seed", config["seed"], int)
    check_value("config: noise_scale", config["noise_scale"], Scale)
    check_value("config: stop_at_success", config["stop_at_success"], bool)


def _read_episodes(stated: Any, config: dict[str, Any]) -> tuple[EpisodeResult, ...]:
    """Return the episodes of a file; raise unless they are different and as many per task as its config says."""
    count, wanted, max_steps = dict.fromkeys(config["tasks"], 0), config["episodes_per_task"], config["max_steps"]

    def faults(one: EpisodeResult) -> Iterator[str]:
        if one.task not in count:
            yield "task must be in config"
        if one.success != (one.first_success is not None) or (one.first_success or 0) > max_steps:
            yield f"first_success must be a step up to {max_steps}, or null without success"
        if one.success_at_end and not one.success:
            yield "success_at_end must be false without success"
        if not (one.episode_return is None or is_number(one.episode_return)):
            yield "episode_return must be a number or null"

    found = read_records("episodes", stated, EpisodeResult, faults)
    for task, _ in {(one.task, one.episode) for one in found}:
        count[task] += 1
    if len(found) != sum(count.values()) or set(count.values()) != {wanted}:
        raise ValueError(f"episodes must be {wanted} different ones of each task, as config: episodes_per_task says")
    return found
