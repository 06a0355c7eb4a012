"""EvaluationResult: what an evaluation measured, episode by episode, as JSON."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from hashlib import file_digest
from reprlib import repr as short
from typing import Any

from torch import Tensor

from lw_torchrl._files import read_json, write_json
from lw_torchrl._versions import package_versions
from lw_torchrl.evaluation.failures import Failure, failure_table, is_number, read_failures

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
        origin: what it came from, once it was saved: ``date`` (UTC, ISO 8601), ``versions`` of the packages and, if
            they were told, ``checkpoint`` (``path`` and ``sha256``) and ``plans``. Results that differ in it alone are
            equal.
        failures: why each failed episode failed, by task and episode, where :func:`evaluate` was asked to attribute
            them; None where it was not.
    """

    config: dict[str, Any]
    episodes: tuple[EpisodeResult, ...]
    origin: dict[str, Any] = field(default_factory=dict, compare=False)
    failures: tuple[Failure, ...] | None = None

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
        path: str | os.PathLike[str],
        *,
        checkpoint: str | os.PathLike[str] | None = None,
        plans: str | None = None,
        evaluator: str | os.PathLike[str] | None = None,
    ) -> None:
        """Write the result as JSON; a file is replaced whole or not at all.

        Args:
            path: the file.
            checkpoint: the file that the actor was made of; its path and SHA-256 are noted.
            plans: the fingerprint of the plans.
            evaluator: the file of what answered the conditions; noted likewise.

        Raises:
            FileNotFoundError: there is no such checkpoint or evaluator.
            ValueError: a number is NaN or infinite.
        """
        made = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "versions": package_versions()}
        origin: dict[str, Any] = dict(self.origin) or made
        for name, given in (("checkpoint", checkpoint), ("evaluator", evaluator)):
            if given is not None:
                with open(given, "rb") as file:
                    origin[name] = {"path": str(given), "sha256": file_digest(file, "sha256").hexdigest()}
        if plans is not None:
            origin["plans"] = plans
        episodes = [{k: v for k, v in asdict(e).items() if k != "actions"} for e in self.episodes]
        failures = {} if self.failures is None else {"failures": [asdict(failure) for failure in self.failures]}
        write_json(
            path,
            {
                "format": FORMAT,
                "version": FORMAT_VERSION,
                "origin": origin,
                "config": self.config,
                "mean_success_once": self.mean_success,
                "success_once": self.success_once,
                "success_at_end": self.success_at_end,
                "first_success": self.first_success,
                "mean_return": self.mean_return,
                "episodes": episodes,
                **failures,
            },
        )

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> EvaluationResult:
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is damaged, holds what cannot be, or is no result of this format and version.
        """
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
            failures = read_failures(found["failures"], config, episodes) if "failures" in found else None
            return cls(config, episodes, origin, failures)
        except FileNotFoundError:
            raise FileNotFoundError(
                f"path: no result file {str(path)!r}; evaluate(...).save(path) writes one"
            ) from None
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"path: {str(path)!r} is no result of {FORMAT} version {FORMAT_VERSION} "
                f"({type(error).__name__}: {str(error)[:500]})"
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

    def failure_table(self) -> str:
        """Numbers of failed episodes, as text in columns: a row for each task, a column for each cause.

        Raises:
            ValueError: the failures were not attributed.
        """
        return failure_table(self.config["tasks"], self.config["episodes_per_task"], attributed(self))


def attributed(result: EvaluationResult) -> tuple[Failure, ...]:
    """The failures; :class:`ValueError` where they were not attributed."""
    if result.failures is None:
        raise ValueError("the result has no failures: they are attributed by evaluate(..., attribute=True)")
    return result.failures


def _mean(values: list[Any]) -> float | None:
    if not values or any(value is None for value in values):
        return None
    return sum(values) / len(values)


def _is_integer(value: Any, minimum: int, maximum: int = 2**63 - 1) -> bool:
    return type(value) is int and minimum <= value <= maximum


def _check(holds: bool, name: str, wanted: str, given: Any) -> None:
    if not holds:
        raise ValueError(f"{name} must be {wanted}, got {short(given)}")


def _check_config(config: dict[str, Any]) -> None:
    tasks = config["tasks"]
    named = isinstance(tasks, list) and bool(tasks) and all(isinstance(task, str) for task in tasks)
    _check(named and len(set(tasks)) == len(tasks), "config: tasks", "different names", tasks)
    for name in ("episodes_per_task", "max_steps"):
        _check(_is_integer(config[name], 1), f"config: {name}", "an integer of at least 1", config[name])
    _check(_is_integer(config["seed"], -(2**63)), "config: seed", "an integer", config["seed"])
    noise = config["noise_scale"]
    _check(is_number(noise) and noise >= 0, "config: noise_scale", "a number of at least 0", noise)
    stops = config["stop_at_success"]
    _check(isinstance(stops, bool), "config: stop_at_success", "true or false", stops)


def _read_episodes(stated: Any, config: dict[str, Any]) -> tuple[EpisodeResult, ...]:
    """The episodes of a file, as many of each task as its configuration says."""
    _check(isinstance(stated, list), "episodes", "a list", stated)
    names = {name for name in EpisodeResult.__dataclass_fields__ if name != "actions"}
    count = dict.fromkeys(config["tasks"], 0)
    seen: set[tuple[str, int]] = set()
    found = []
    for number, entry in enumerate(stated):
        at = f"episodes[{number}]"
        _check(isinstance(entry, dict) and set(entry) == names, at, f"an object of {', '.join(sorted(names))}", entry)
        episode = EpisodeResult(**entry)
        _check(isinstance(episode.task, str) and episode.task in count, f"{at}: task", "in config", episode.task)
        _check(_is_integer(episode.episode, 0), f"{at}: episode", "an integer of at least 0", episode.episode)
        which = episode.task, episode.episode
        _check(which not in seen, at, "an episode of its own", which)
        _check(isinstance(episode.success, bool), f"{at}: success", "true or false", episode.success)
        first, end, total = episode.first_success, episode.success_at_end, episode.episode_return
        if episode.success:
            wanted = f"a step from 1 to {config['max_steps']}"
            _check(_is_integer(first, 1, config["max_steps"]), f"{at}: first_success", wanted, first)
        else:
            _check(first is None, f"{at}: first_success", "null without success", first)
        _check(end is None or isinstance(end, bool), f"{at}: success_at_end", "true, false or null", end)
        _check(not end or episode.success, f"{at}: success_at_end", "false without success", end)
        _check(total is None or is_number(total), f"{at}: episode_return", "a number or null", total)
        seen.add(which)
        count[episode.task] += 1
        found.append(episode)
    for task, number in count.items():
        wanted = f"{config['episodes_per_task']}, as config: episodes_per_task says"
        _check(number == config["episodes_per_task"], f"the number of episodes of {task!r}", wanted, number)
    return tuple(found)
