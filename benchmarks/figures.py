"""Tables in Markdown, and the paper's figure: tasks sorted by success rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from benchmarks.statistics import Array, Summary, check_rates
from lw_torchrl._util.files import AnyPath
from lw_torchrl.evaluation.figures import COLORS, check_image, new_figure, saved, trim

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rates = Mapping[str, float | Sequence[float]]
_DASHES = ((0, (5, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)), (0, (3, 3)))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Text columns of even width, as Markdown."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, ["-" * width for width in widths], *rows]
    return "\n".join("| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines)


def plot_sorted_tasks(
    curves: Mapping[str, Rates | Summary],
    path: AnyPath | None = None,
    *,
    published: Mapping[str, Mapping[str, float]] | None = None,
    order: Literal["shared", "own"] = "shared",
    of: str = "seed",
    title: str = "",
) -> Figure:
    """Draw the paper's figure: tasks sorted by success rate on x, success on y, a line per method.

    A line is the mean over seeds, its band spans the least and the greatest seed, and a thin line across marks the
    mean over tasks, which the legend gives too. Published curves are dashed.

    Args:
        curves: a method's name to its :class:`Summary`, or to (task to its rates, one per seed), in [0, 1]. All have
            the same tasks.
        path, title: as for :func:`plot_success`.
        published: label to (task to rate), of the same tasks at least.
        order: "shared" sorts the tasks by the first method, so that each place on x is one named task; "own" sorts
            every curve for itself, as the paper does: x is then a rank.
        of: what a rate is of, for the legend: "seed", "plan".

    Example:
        >>> figure = plot_sorted_tasks({"PCBC": {"push": [0.5, 0.7], "reach": [1.0, 0.9]}})
        >>> [label.get_text() for label in figure.axes[0].get_xticklabels()]
        ['push', 'reach']

    Source: paper, figures of section 'Conditional Plan Experiments'.
    """
    check_image(path)
    if not curves:
        raise ValueError("curves must hold at least one method, got none")
    named = {method: _as_rates(f"curves[{method!r}]", given) for method, given in curves.items()}
    first = next(iter(named))
    for method, rates in named.items():
        if different := sorted(set(named[first]) ^ set(rates)):
            raise ValueError(f"curves must be of the same tasks; {first!r} and {method!r} do not share {different}")
    means = {task: float(rates.mean()) for task, rates in named[first].items()}
    tasks = sorted(means, key=lambda task: (means[task], task))
    dashed = {label: _as_rates(f"published[{label!r}]", rates) for label, rates in (published or {}).items()}
    for label, rates in dashed.items():
        if missing := [task for task in tasks if task not in rates]:
            raise ValueError(f"published[{label!r}] lacks the tasks {missing}")

    figure = new_figure(max(7.0, 3.5 + 0.21 * len(tasks)), 6.4)
    axes = figure.subplots()
    for k, (method, rates) in enumerate(named.items()):
        _draw_method(axes, method, np.stack([rates[task] for task in tasks]), COLORS[k % len(COLORS)], order, of)
    for k, (label, rates) in enumerate(dashed.items()):
        line = np.array([rates[task].mean() for task in tasks])
        line, mean = np.sort(line) if order == "own" else line, float(line.mean())
        look: dict[str, Any] = {"linestyle": _DASHES[k // 2 % len(_DASHES)], "zorder": 1.5}
        look["color"] = ("#666666", "#aaaaaa")[k % 2]
        axes.plot(line, linewidth=1, label=f"{label}: mean {mean:.2f}", **look)
        axes.axhline(mean, linewidth=0.9, **look)
    shown = [*tasks] if order == "shared" else [str(rank) for rank in range(1, len(tasks) + 1)]
    axes.set_xticks(range(len(tasks)), shown, rotation=90 if order == "shared" else 0, fontsize=8)
    axes.set_xlabel(f"tasks, sorted by {first}" if order == "shared" else "tasks, each curve sorted for itself")
    axes.set_ylabel("episodes with success at any step")
    axes.set_xlim(-0.5, len(tasks) - 0.5)
    axes.set_ylim(-0.02, 1.02)
    trim(axes, "y")
    axes.set_title(title)
    _add_legend(figure, axes, len(named))
    return saved(figure, path)


def _add_legend(figure: Figure, axes: Axes, methods: int) -> None:
    """Below the axes: the methods, and the published curves in a column beside, or under them in a narrow figure."""
    from matplotlib.lines import Line2D

    lines, _ = axes.get_legend_handles_labels()
    wide = methods < len(lines) and figure.get_figwidth() > 10
    columns = [lines[:methods], lines[methods:]] if wide else [lines]
    longest = max(len(column) for column in columns)
    blank = Line2D([], [], linestyle="none", label=" ")
    handles = [handle for column in columns for handle in (*column, *[blank] * (longest - len(column)))]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(columns), frameon=False, fontsize=9)


def _draw_method(axes: Axes, method: str, rates: Array, color: str, order: str, of: str) -> None:
    """A line, a band and the mean of rates (tasks, seeds)."""
    if order == "own":
        rates = rates[np.argsort(rates.mean(1), kind="stable")]
    mean, x, seeds = rates.mean(1), range(len(rates)), rates.shape[1]
    spread = f"1 {of}" if seeds == 1 else f"{seeds} {of}s, min–max shaded"
    axes.fill_between(x, rates.min(1), rates.max(1), color=color, alpha=0.16, linewidth=0)
    label = f"{method}: mean {mean.mean():.2f} ({spread})"
    axes.plot(x, mean, color=color, linewidth=2, marker=".", zorder=3, label=label)
    axes.axhline(float(mean.mean()), color=color, linewidth=1.2, alpha=0.8)


def _as_rates(argument: str, given: Rates | Summary | Mapping[str, float]) -> dict[str, Array]:
    """Task to its rates over seeds, (n,) float64."""
    if isinstance(given, Summary):
        return dict(zip(given.tasks, given.array.T, strict=True))
    columns = {task: np.atleast_1d(np.asarray(rates, dtype=np.float64)) for task, rates in given.items()}
    if len({len(rates) for rates in columns.values()}) > 1:
        raise ValueError(f"{argument} must hold a rate per seed for each task, got different numbers of them")
    check_rates(argument, list(columns.values()))
    return columns
