"""summarize: several training seeds as headline numbers and a row per task; MethodComparison: methods side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lw_torchrl._checks import checked, shown
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.evaluation.statistics import (
    Array,
    Estimate,
    check_rates,
    count_solved,
    interquartile_mean,
    mean_difference,
    mean_rate,
    probability_of_improvement,
)
from lw_torchrl.language.tasks import MT10

_SETTINGS = ("episodes_per_task", "noise_scale", "max_steps")  # what rates must share to be averaged


@dataclass(frozen=True)
class TaskSummary:
    """One task over the seeds: the mean, the least and the greatest success rate."""

    mean: float
    min: float
    max: float


@dataclass(frozen=True)
class Summary:
    """The success rates of one method over seeds and tasks, from :func:`summarize` or :func:`summarize_rates`.

    Attributes:
        tasks: their names, T of them.
        seeds: the training seeds' names, n of them.
        rates: n rows of T success rates at any step.
        mean: over seeds and tasks, with its 95 % interval, Student's t over the seeds.
        iqm: the interquartile mean, likewise.
        solved: how many tasks' mean over seeds is at least ``threshold``.
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
        """As plain numbers, lists and mappings."""
        return {
            "seeds": list(self.seeds),
            "mean": self.mean.to_json(),
            "iqm": self.iqm.to_json(),
            "solved": self.solved,
            "threshold": self.threshold,
            "by_seed": self.by_seed,
            "tasks": {
                task: {"mean": found.mean, "min": found.min, "max": found.max, "rates": rates}
                for (task, found), rates in zip(self.per_task.items(), self.array.T.tolist(), strict=True)
            },
        }

    def table(self, beside: Mapping[str, Mapping[str, float]] | None = None) -> str:
        """The headline, then a row per task, as text in columns.

        Args:
            beside: more columns, name to (task to rate), such as :func:`published_curves` gives; "-" where a task is
                missing. Their names stand in full below the table.
        """
        columns = list((beside or {}).items())
        head = "".join(f" {f'({k + 1})':>6}" for k in range(len(columns)))
        count = f"{len(self.seeds)} seed" + "s" * (len(self.seeds) > 1)
        solved = f"{self.solved} of {len(self.tasks)} tasks >= {self.threshold:g}"
        lines = [
            f"mean {self.mean}, IQM {self.iqm}; {solved}; {count}",
            f"{'task':28} {'mean':>6} {'min':>6} {'max':>6}{head}",
        ]
        for task, found in self.per_task.items():
            cells = "".join(f" {rates[task]:6.2f}" if task in rates else f" {'-':>6}" for _, rates in columns)
            lines.append(f"{task:28} {found.mean:6.2f} {found.min:6.2f} {found.max:6.2f}{cells}")
        seeds, cells = self.by_seed.values(), ""
        for _, rates in columns:
            shared = [rates[task] for task in self.tasks if task in rates]
            cells += f" {sum(shared) / len(shared):6.2f}" if len(shared) == len(self.tasks) else f" {'-':>6}"
        lines.append(f"{'mean':28} {self.mean.value:6.2f} {min(seeds):6.2f} {max(seeds):6.2f}{cells}")
        return "\n".join([*lines, *(f"({k + 1}) {name}" for k, (name, _) in enumerate(columns))])


@checked
def summarize_rates(
    rates: Mapping[str, Sequence[float]],
    *,
    seeds: Sequence[object] | None = None,
    threshold: float = 0.8,
    confidence: float = 0.95,
) -> Summary:
    """Summarize success rates, for those that come from elsewhere than one evaluation per seed.

    Args:
        rates: task to its n success rates, one per training seed, in [0, 1].
        seeds: the seeds' names; by default 0 to n - 1.
        threshold: a task counts as solved from here.
        confidence: of the intervals, in (0, 1).

    Raises:
        ValueError: no tasks, tasks with different numbers of seeds, or another wrong argument.

    Example:
        >>> summary = summarize_rates({"push": [0.5, 0.7], "reach": [1.0, 0.9]})
        >>> print(summary.mean, summary.solved)
        0.775 [0.457, 1.000] 1
        >>> summary.per_task["push"].min
        0.5
    """
    counts = {task: len(found) for task, found in rates.items()}
    if not counts or min(counts.values()) == 0:
        raise ValueError(f"rates must hold at least one task, each with at least one rate, got {dict(rates)!r}")
    if len(set(counts.values())) > 1:
        raise ValueError(f"rates must hold a rate per seed for each task, got different numbers: {counts}")
    array = check_rates("rates", list(rates.values())).T
    names = tuple(str(seed) for seed in (range(len(array)) if seeds is None else seeds))
    if len(names) != len(array) or len(set(names)) != len(names):
        raise ValueError(f"seeds must be {len(array)} different names, got {names}")
    return Summary(
        tasks=tuple(rates),
        seeds=names,
        rates=tuple(tuple(row) for row in array.tolist()),
        mean=mean_rate(array, confidence=confidence),
        iqm=interquartile_mean(array, confidence=confidence),
        solved=count_solved(array, threshold),
        threshold=threshold,
    )


@checked
def summarize(results: Mapping[Any, EvaluationResult] | Sequence[EvaluationResult], **options: Any) -> Summary:
    """Summarize the any-step success of several training seeds, one evaluation of the same tasks each.

    Args:
        results: training seed to result, or the results in order.
        options: ``threshold`` (0.8) and ``confidence`` (0.95), as for :func:`summarize_rates`.

    Raises:
        ValueError: no results, one evaluation given twice, other tasks or plans in one than in another, or evaluations
            that cannot be averaged because their episodes_per_task, noise_scale or max_steps differ.
        TypeError: one is no :class:`EvaluationResult`.

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
        if different := set(tasks) ^ set(result.success_once):
            raise ValueError(
                f"results must be of the same tasks; seeds {first_seed!r} and {seed!r} do not share "
                + ", ".join(sorted(different))
            )
        if len({one.origin.get("plans") for one in (first, result)} - {None}) > 1:
            raise ValueError(f"results must be of the same plans; those of seeds {first_seed!r} and {seed!r} differ")
        for key in _SETTINGS:
            if first.config.get(key) != result.config.get(key):
                raise ValueError(
                    f"results must share {key}, got {first.config.get(key)!r} for seed {first_seed!r} and "
                    f"{result.config.get(key)!r} for seed {seed!r}"
                )
    rates: dict[str, Any] = {task: [result.success_once[task] for result in named.values()] for task in tasks}
    return summarize_rates(rates, seeds=list(named), **options)


@dataclass(frozen=True)
class Pair:
    """How much better the first method is than the second, on the same tasks.

    Attributes:
        methods: their names.
        difference: of the mean success rates.
        improvement: the probability that a seed of the first beats one of the second on a task; a tie counts half.
    """

    methods: tuple[str, str]
    difference: Estimate
    improvement: Estimate


class MethodComparison:
    """Several methods' summaries, which have the same tasks.

    Args:
        summaries: method to :class:`Summary`; the first is compared with each of the others.
        published: label to (task to success rate), such as :func:`published_curves` gives.
        confidence: of the intervals of differences, in (0, 1).

    Raises:
        ValueError: no summaries, or summaries of different tasks.

    Example:
        >>> from lw_torchrl.evaluation import summarize_rates
        >>> a = summarize_rates({"push": [0.5, 0.7], "reach": [1.0, 0.9]})
        >>> b = summarize_rates({"push": [0.3, 0.3], "reach": [0.6, 0.7]})
        >>> print(MethodComparison({"a": a, "b": b}).pairs[0].difference)
        0.300 [0.148, 0.452]
    """

    def __init__(
        self,
        summaries: Mapping[str, Summary],
        published: Mapping[str, Mapping[str, float]] | None = None,
        *,
        confidence: float = 0.95,
    ) -> None:
        if not summaries:
            raise ValueError("summaries must hold at least one method, got none")
        self.summaries, self.published = dict(summaries), dict(published or {})
        first, *others = self.summaries
        self.tasks, self.threshold = self.summaries[first].tasks, self.summaries[first].threshold
        for other in others:
            if different := sorted(set(self.tasks) ^ set(self.summaries[other].tasks)):
                raise ValueError(f"summaries of {first!r} and {other!r} do not share the tasks {different}")
        self.pairs: list[Pair] = []
        for other in others:
            order = [self.summaries[other].tasks.index(task) for task in self.tasks]
            rates = self.summaries[first].array, self.summaries[other].array[:, order]
            difference = mean_difference(*rates, confidence=confidence)
            improvement = probability_of_improvement(*rates, confidence=confidence)
            self.pairs.append(Pair((first, other), difference, improvement))

    def to_json(self) -> dict[str, Any]:
        """As plain numbers, lists and mappings."""
        return {
            "methods": {method: summary.to_json() for method, summary in self.summaries.items()},
            "pairs": [
                {"methods": [*p.methods], "difference": p.difference.to_json(), "improvement": p.improvement.to_json()}
                for p in self.pairs
            ],
            "published_means": {label: self._mean(rates) for label, rates in self.published.items()},
        }

    def headline(self) -> str:
        """A Markdown table with a row per method, then a line per pair."""
        outside = [task for task in self.tasks if task not in MT10]
        head = ["method", "mean", "IQM", f"tasks >= {self.threshold:g}, of {len(self.tasks)}", "seeds"]
        head += [f"mean of the {len(outside)} outside MT10"] if 0 < len(outside) < len(self.tasks) else []
        rows = []
        for method, summary in self.summaries.items():
            each = ", ".join(f"{mean:.3f}" for mean in summary.by_seed.values())
            row = [method, str(summary.mean), str(summary.iqm), str(summary.solved), each]
            means = {task: found.mean for task, found in summary.per_task.items()}
            rows.append([*row, *self._outside(means, outside)])
        for label, rates in self.published.items():
            solved = sum(rates[task] >= self.threshold - 1e-9 for task in self.tasks)
            rows.append([label, f"{self._mean(rates):.3f}", "", str(solved), "", *self._outside(rates, outside)])
        lines = [
            f"{pair.methods[0]} - {pair.methods[1]}: {pair.difference}; probability of improvement {pair.improvement}"
            for pair in self.pairs
        ]
        return "\n\n".join(filter(None, [markdown_table(head, rows), "  \n".join(lines)]))

    def _mean(self, rates: Mapping[str, float]) -> float:
        return sum(rates[task] for task in self.tasks) / len(self.tasks)

    def _outside(self, rates: Mapping[str, float], outside: list[str]) -> list[str]:
        if not 0 < len(outside) < len(self.tasks):
            return []
        return [f"{sum(rates[task] for task in outside) / len(outside):.3f}"]

    def per_task(self) -> str:
        """A Markdown table with a row per task: each method's mean, its least and greatest seed, and the published."""
        found = {method: summary.per_task for method, summary in self.summaries.items()}
        rows = []
        for task in self.tasks:
            cells = []
            for each in found.values():
                spread = f" ({each[task].min:.2f}-{each[task].max:.2f})" if each[task].min < each[task].max else ""
                cells.append(f"{each[task].mean:.2f}{spread}")
            rows.append([task, *cells, *(f"{rates[task]:.2f}" for rates in self.published.values())])
        return markdown_table(["task", *found, *self.published], rows)


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text columns of even width, as Markdown."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, ["-" * width for width in widths], *rows]
    return "\n".join("| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines)
