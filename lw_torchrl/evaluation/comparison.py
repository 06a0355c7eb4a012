"""MethodComparison: the methods of one experiment side by side, task by task and pair by pair."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from lw_torchrl.evaluation.statistics import Estimate, mean_difference, probability_of_improvement
from lw_torchrl.evaluation.summary import Summary
from lw_torchrl.language.tasks import MT10


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
        self.pairs = [self._pair(first, other, confidence) for other in others]

    def _pair(self, x: str, y: str, confidence: float) -> Pair:
        order = [self.summaries[y].tasks.index(task) for task in self.tasks]
        rates = self.summaries[x].array, self.summaries[y].array[:, order]
        difference = mean_difference(*rates, confidence=confidence)
        return Pair((x, y), difference, probability_of_improvement(*rates, confidence=confidence))

    def to_json(self) -> dict[str, Any]:
        """As plain numbers, lists and mappings."""
        return {
            "methods": {method: summary.to_json() for method, summary in self.summaries.items()},
            "pairs": [
                {
                    "methods": list(p.methods),
                    "difference": p.difference.to_json(),
                    "improvement": p.improvement.to_json(),
                }
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
