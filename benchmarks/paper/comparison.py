"""Compare methods over seeds, in tables with the published results and in figures."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context

from benchmarks.figures import METHOD_COLORS, NEUTRAL, NEUTRAL_STYLE, draw_rates, markdown_table
from benchmarks.paper.runs import Run
from benchmarks.statistics import Estimate, Summary, mean_difference, probability_of_improvement, summarize
from lw_torchrl._util.files import write_json, write_text
from lw_torchrl.evaluation import EvaluationResult
from lw_torchrl.evaluation.figures import new_figure, saved
from lw_torchrl.language.tasks import MT10


@dataclass(frozen=True)
class Pair:
    """The difference between the mean success of two methods, and the probability that, on a random task, a random seed
    of the first method beats one of the second (a tie counts half)."""

    methods: tuple[str, str]
    difference: Estimate
    improvement: Estimate


class MethodComparison:
    """Summaries of several methods on the same tasks. The first method is compared with each of the others.

    Args:
        summaries: the summary of each method, by name.
        published: published success rates by task, for each label.
    """

    def __init__(
        self, summaries: Mapping[str, Summary], published: Mapping[str, Mapping[str, float]] | None = None
    ) -> None:
        self.summaries, self.published = dict(summaries), dict(published or {})
        first, *others = self.summaries
        self.tasks, self.threshold = self.summaries[first].tasks, self.summaries[first].threshold
        self.pairs: list[Pair] = []
        for other in others:
            order = [self.summaries[other].tasks.index(task) for task in self.tasks]
            rates = self.summaries[first].array, self.summaries[other].array[:, order]
            difference, improvement = mean_difference(*rates), probability_of_improvement(*rates)
            self.pairs.append(Pair((first, other), difference, improvement))

    def to_json(self) -> dict[str, Any]:
        return {
            "methods": {method: summary.to_json() for method, summary in self.summaries.items()},
            "pairs": [{**asdict(pair), "methods": list(pair.methods)} for pair in self.pairs],
            "published_means": {label: _mean(rates, self.tasks) for label, rates in self.published.items()},
        }

    def headline(self) -> str:
        """Return a Markdown table with a row per method, then a line per pair."""
        outside = [task for task in self.tasks if task not in MT10]
        outside = [] if len(outside) == len(self.tasks) else outside
        head = ["method", "mean", "IQM", f"tasks >= {self.threshold:g}, of {len(self.tasks)}", "seeds"]
        head += [f"mean of the {len(outside)} outside MT10"] if outside else []
        rows = []
        for method, summary in self.summaries.items():
            by_seed = ", ".join(f"{mean:.3f}" for mean in summary.by_seed.values())
            means = {task: spread.mean for task, spread in summary.per_task.items()}
            last = [f"{_mean(means, outside):.3f}"] if outside else []
            rows.append([method, str(summary.mean), str(summary.iqm), str(summary.solved), by_seed, *last])
        for label, rates in self.published.items():
            solved = sum(rates[task] >= self.threshold - 1e-9 for task in self.tasks)
            last = [f"{_mean(rates, outside):.3f}"] if outside else []
            rows.append([label, f"{_mean(rates, self.tasks):.3f}", "", str(solved), "", *last])
        more = "probability of improvement"
        lines = [f"{' - '.join(pair.methods)}: {pair.difference}; {more} {pair.improvement}" for pair in self.pairs]
        return "\n\n".join(filter(None, [markdown_table(head, rows), "  \n".join(lines)]))

    def per_task(self) -> str:
        """Return a Markdown table with a row per task: mean, minimum and maximum over seeds, and published rates."""
        spreads = [summary.per_task for summary in self.summaries.values()]
        rows = []
        for task in self.tasks:
            cells = []
            for method in spreads:
                spread = method[task]
                span = f" ({spread.min:.2f}-{spread.max:.2f})" if spread.min < spread.max else ""
                cells.append(f"{spread.mean:.2f}{span}")
            rows.append([task, *cells, *(f"{rates[task]:.2f}" for rates in self.published.values())])
        return markdown_table(["task", *self.summaries, *self.published], rows)


def _mean(rates: Mapping[str, float], tasks: Sequence[str]) -> float:
    return sum(rates[task] for task in tasks) / len(tasks)


def compare(
    results: Iterable[tuple[Run, EvaluationResult]], published: Mapping[str, Mapping[str, float]] | None = None
) -> MethodComparison:
    """Compare runs with different labels over seeds, together with published rates."""
    by_label: dict[str, dict[int, EvaluationResult]] = {}
    for run, result in results:
        by_label.setdefault(run.label, {})[run.seed] = result
    return MethodComparison({label: summarize(seeds) for label, seeds in by_label.items()}, published)


def write_summary(path: Path, text: str, numbers: Mapping[str, Any]) -> None:
    """Write a table to ``path``.md and its numbers to ``path``.json."""
    write_json(path.with_name(f"{path.name}.json"), numbers)
    write_text(path.with_name(f"{path.name}.md"), text)


def plot_methods(groups: Mapping[str, Mapping[str, Summary]], path: Path) -> None:
    """Draw the mean success of each method with a 95 % interval and a mark for each seed, in a column per group."""
    labels = list(dict.fromkeys(label for methods in groups.values() for label in methods))
    colors = [METHOD_COLORS["plan" if place == 0 else "baseline"] for place in range(len(labels))]
    with rc_context(NEUTRAL_STYLE):
        figure = new_figure(2.6 + 3.0 * len(groups), 1.6 + 0.36 * len(labels))
        columns = figure.subplots(1, len(groups), sharey=True, squeeze=False)[0]
        for axes, (group, methods) in zip(columns, groups.items(), strict=True):
            means = [methods[label].mean if label in methods else None for label in labels]
            rates = [None if mean is None else [mean.value, mean.low, mean.high] for mean in means]
            draw_rates(axes, labels, [rate and [end for end in rate if end is not None] for rate in rates], colors)
            for place, label in enumerate(labels):
                if label in methods:
                    seeds = methods[label].array.mean(1)
                    axes.plot(seeds, np.full(len(seeds), place), "|", color=NEUTRAL, markersize=12, zorder=3)
            axes.set_title(group)
        figure.supxlabel("episodes with success at any step; small bars: seeds; lines: 95 %", fontsize=12)
        saved(figure, path)
