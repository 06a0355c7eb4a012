"""Summarize the evaluations of several training seeds as headline numbers and a row per task."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lw_torchrl._checks import checked, counted, shown
from lw_torchrl.evaluation import statistics
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.evaluation.statistics import Array, Estimate

_SETTINGS = ("episodes_per_task", "noise_scale", "max_steps")  # rates are averaged only if these are equal


@dataclass(frozen=True)
class TaskSummary:
    """The mean, the smallest and the largest success rate of a task over the seeds."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class Summary:
    """The success rates of one method over seeds and tasks, from :func:`summarize` or :func:`summarize_rates`.

    Attributes:
        tasks, seeds: their names, T and n of them.
        rates: n rows of T success rates at any step.
        mean, iqm: the mean and the interquartile mean over seeds and tasks, with 95 % intervals over the seeds.
        solved: the number of tasks whose mean over seeds is at least ``threshold``.
        threshold: 0.8.
    """

    tasks: tuple[str, ...]
    seeds: tuple[str, ...]
    rates: tuple[tuple[float, ...], ...]
    mean: Estimate
    iqm: Estimate
    solved: int
    threshold: float

    @property
    def array(self) -> Array:
        """The rates as a fresh float64 array (n, T), for the functions of :mod:`lw_torchrl.evaluation.statistics`."""
        return np.array(self.rates)

    @cached_property
    def per_task(self) -> dict[str, TaskSummary]:
        """Task to its mean, minimum and maximum over the seeds."""
        rates = self.array
        columns = zip(rates.mean(0).tolist(), rates.min(0).tolist(), rates.max(0).tolist(), strict=True)
        return {task: TaskSummary(*column) for task, column in zip(self.tasks, columns, strict=True)}

    @property
    def by_seed(self) -> dict[str, float]:
        """Seed to its mean over the tasks."""
        return dict(zip(self.seeds, self.array.mean(1).tolist(), strict=True))

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers, lists and mappings."""
        return {
            "seeds": list(self.seeds),
            "mean": self.mean.to_json(),
            "iqm": self.iqm.to_json(),
            "solved": self.solved,
            "threshold": self.threshold,
            "by_seed": self.by_seed,
            "tasks": {
                task: {**asdict(summary), "rates": rates}
                for (task, summary), rates in zip(self.per_task.items(), self.array.T.tolist(), strict=True)
            },
        }

    def table(self) -> str:
        """Return the headline, then a row per task, as text in columns."""
        solved = f"{self.solved} of {len(self.tasks)} tasks >= {self.threshold:g}"
        lines = [f"mean {self.mean}, IQM {self.iqm}; {solved}; {counted(len(self.seeds), 'seed')}"]
        lines.append(f"{'task':28} {'mean':>6} {'min':>6} {'max':>6}")
        seeds = self.by_seed.values()
        total = TaskSummary(self.mean.value, min(seeds), max(seeds))
        for name, row in [*self.per_task.items(), ("mean", total)]:
            lines.append(f"{name:28} {row.mean:6.2f} {row.min:6.2f} {row.max:6.2f}")
        return "\n".join(lines)


@checked
def summarize_rates(
    rates: Mapping[str, Sequence[float]],
    *,
    seeds: Sequence[object] | None = None,
    threshold: float = 0.8,
    confidence: float = 0.95,
) -> Summary:
    """Summarize success rates that do not come from one evaluation per seed.

    Args:
        rates: task to its n success rates, one per training seed, in [0, 1].
        seeds: the seeds' names; by default 0 to n - 1.
        threshold: the smallest mean rate of a solved task.
        confidence: of the intervals, in (0, 1).

    Example:
        >>> summary = summarize_rates({"push": [0.5, 0.7], "reach": [1.0, 0.9]})
        >>> print(summary.mean, summary.solved)
        0.775 [0.457, 1.000] 1
        >>> summary.per_task["push"].min
        0.5
    """
    counts = {task: len(listed) for task, listed in rates.items()}
    if not counts or min(counts.values()) == 0:
        raise ValueError(f"rates must hold at least one task, each with at least one rate, got {dict(rates)!r}")
    if len(set(counts.values())) > 1:
        raise ValueError(f"rates must hold a rate per seed for each task, got different numbers: {counts}")
    array = statistics.check_rates("rates", list(rates.values())).T
    names = tuple(str(seed) for seed in (range(len(array)) if seeds is None else seeds))
    if len(names) != len(array) or len(set(names)) != len(names):
        raise ValueError(f"seeds must be {len(array)} different names, got {names}")
    return Summary(
        tasks=tuple(rates),
        seeds=names,
        rates=tuple(tuple(row) for row in array.tolist()),
        mean=statistics.mean_rate(array, confidence=confidence),
        iqm=statistics.interquartile_mean(array, confidence=confidence),
        solved=statistics.count_solved(array, threshold),
        threshold=threshold,
    )


@checked
def summarize(results: Mapping[Any, EvaluationResult] | Sequence[EvaluationResult], **options: Any) -> Summary:
    """Summarize the any-step success of several training seeds, one evaluation of the same tasks each.

    Args:
        results: training seed to result, or the results in order.
        options: ``threshold`` (0.8) and ``confidence`` (0.95), as for :func:`summarize_rates`.

    Raises:
        ValueError: no results, one evaluation given twice, or evaluations that differ in tasks, plans,
            episodes_per_task, noise_scale or max_steps.
        TypeError: a result is not an :class:`EvaluationResult`.

    Example:
        >>> from lw_torchrl.evaluation import EpisodeResult, EvaluationResult, summarize
        >>> episodes = tuple(EpisodeResult("reach", k, k > 0, 9, None, None) for k in range(2))
        >>> result = EvaluationResult({"tasks": ["reach"], "episodes_per_task": 2}, episodes)
        >>> summarize({7: result}).by_seed
        {'7': 0.5}
    """
    named = dict(results) if isinstance(results, Mapping) else dict(enumerate(results))
    if not named:
        raise ValueError("results must hold at least one result, got none")
    for number, (seed, result) in enumerate(named.items()):
        if not isinstance(result, EvaluationResult):
            raise TypeError(f"results[{seed!r}] must be an EvaluationResult, got {shown(result)}")
        if (twice := next((k for k, one in list(named.items())[:number] if one == result), None)) is not None:
            raise ValueError(f"results must be of different training seeds, {twice!r} and {seed!r} are one evaluation")
    first_seed, first = next(iter(named.items()))
    tasks = tuple(first.success_once)
    for seed, result in named.items():
        both = f"seeds {first_seed!r} and {seed!r}"
        if different := ", ".join(sorted(set(tasks) ^ set(result.success_once))):
            raise ValueError(f"results must be of the same tasks; {both} do not share {different}")
        if len({one.origin.get("plans") for one in (first, result)} - {None}) > 1:
            raise ValueError(f"results must be of the same plans; those of {both} differ")
        for key in _SETTINGS:
            if (was := first.config.get(key)) != (now := result.config.get(key)):
                got = f"{was!r} for seed {first_seed!r} and {now!r} for seed {seed!r}"
                raise ValueError(f"results must share {key}, got {got}")
    rates: dict[str, Any] = {task: [result.success_once[task] for result in named.values()] for task in tasks}
    return summarize_rates(rates, seeds=list(named), **options)
