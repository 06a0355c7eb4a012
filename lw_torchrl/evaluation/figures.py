"""Figures of results."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from lw_torchrl._checks import check_choice, checked, counted
from lw_torchrl._files import replacing
from lw_torchrl.evaluation.result import EvaluationResult
from lw_torchrl.evaluation.statistics import Array, check_rates
from lw_torchrl.evaluation.summary import Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FORMATS = (".png", ".svg", ".pdf", ".jpg", ".jpeg")
_Z = 1.96  # of a 95 % interval


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """The 95 % Wilson score interval of a success rate.

    Example:
        >>> low, high = wilson_interval(20, 20)
        >>> round(low, 2), high
        (0.84, 1.0)
    """
    rate, squared = successes / trials, _Z**2
    center = (rate + squared / (2 * trials)) / (1 + squared / trials)
    half = _Z / (1 + squared / trials) * math.sqrt(rate * (1 - rate) / trials + squared / (4 * trials**2))
    return max(0.0, center - half), min(1.0, center + half)


@checked
def plot_success(result: EvaluationResult, path: str | os.PathLike[str] | None = None, *, title: str = "") -> Figure:
    """Draw the any-step success rate of each task, best first, with 95 % intervals over the episodes.

    Args:
        result: of :func:`evaluate`.
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.
        title: above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: another format.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> plot_success(result).axes[0].get_title()
        'mean over 1 task: 1.000'
    """
    from matplotlib.figure import Figure

    check_image(path)
    rates = {task: rate for task, rate in result.success_once.items() if rate is not None}
    trials = result.config["episodes_per_task"]
    tasks = sorted(rates, key=lambda task: (rates[task], task))
    figure = Figure(figsize=(8.0, 1.6 + 0.27 * len(tasks)), layout="constrained")
    axes = figure.subplots()
    intervals = [wilson_interval(round(rates[task] * trials), trials) for task in tasks]
    errors = [
        [max(0.0, rates[task] - low) for task, (low, _) in zip(tasks, intervals, strict=True)],
        [max(0.0, high - rates[task]) for task, (_, high) in zip(tasks, intervals, strict=True)],
    ]
    axes.barh(
        tasks,
        [rates[task] for task in tasks],
        xerr=errors,
        color="#4c78a8",
        error_kw={"ecolor": "#333333", "elinewidth": 1, "capsize": 2},
    )
    axes.axvline(result.mean_success, color="#e45756", linestyle="--")
    axes.set_xlim(0, 1.02)
    axes.margins(y=0.5 / len(tasks))
    axes.set_xlabel(
        f"episodes with success at any step (of {trials}; action noise {result.config['noise_scale']}; bars: 95 %)"
    )
    axes.set_title(f"{title}\nmean over {counted(len(tasks), 'task')}: {result.mean_success:.3f}".strip())
    axes.spines[["top", "right"]].set_visible(False)
    return saved(figure, path)


Rates = Mapping[str, float | Sequence[float]]
COLORS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#9d755d", "#e45756")
_DASHES = ((0, (5, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)), (0, (3, 3)))


@checked
def plot_sorted_tasks(
    curves: Mapping[str, Rates | Summary],
    path: str | os.PathLike[str] | None = None,
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
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.
        published: label to (task to rate), of the same tasks at least; :func:`published_curves` gives them.
        order: "shared" sorts the tasks by the first method, so that each place on x is one named task; "own" sorts
            every curve for itself, as the paper does: x is then a rank.
        of: what a rate is of, for the legend: "seed", "plan".
        title: above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: no curves, methods with different tasks, or rates outside [0, 1].

    Example:
        >>> figure = plot_sorted_tasks({"PCBC": {"push": [0.5, 0.7], "reach": [1.0, 0.9]}})
        >>> [label.get_text() for label in figure.axes[0].get_xticklabels()]
        ['push', 'reach']

    Source: paper, figures of section 'Conditional Plan Experiments'.
    """
    from matplotlib.figure import Figure

    check_image(path)
    check_choice("order", order, ("shared", "own"))
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

    figure = Figure(figsize=(max(7.0, 3.5 + 0.21 * len(tasks)), 6.4), layout="constrained")
    axes = figure.subplots()
    for k, (method, rates) in enumerate(named.items()):
        _draw_method(axes, method, np.stack([rates[task] for task in tasks]), COLORS[k % len(COLORS)], order, of)
    for k, (label, rates) in enumerate(dashed.items()):
        _draw_published(axes, label, np.array([rates[task].mean() for task in tasks]), k, order)
    shown = [*tasks] if order == "shared" else [str(rank) for rank in range(1, len(tasks) + 1)]
    axes.set_xticks(range(len(tasks)), shown, rotation=90 if order == "shared" else 0, fontsize=8)
    axes.set_xlabel(f"tasks, sorted by {first}" if order == "shared" else "tasks, each curve sorted for itself")
    axes.set_ylabel("episodes with success at any step")
    axes.set_xlim(-0.5, len(tasks) - 0.5)
    axes.set_ylim(-0.02, 1.02)
    axes.grid(axis="y", color="#dddddd", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_title(title)
    _add_legend(figure, axes, len(named))
    return saved(figure, path)


def check_image(path: str | os.PathLike[str] | None) -> None:
    """Raise :class:`ValueError` unless the file's name tells a format."""
    if path is not None and (given := Path(path).suffix.lower()) not in _FORMATS:
        raise ValueError(f"path must end in {', '.join(_FORMATS)}, got {given!r} of {str(path)!r}")


def saved(figure: Figure, path: str | os.PathLike[str] | None) -> Figure:
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=140)
    return figure


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
    axes.plot(
        x, mean, color=color, linewidth=2, marker=".", zorder=3, label=f"{method}: mean {mean.mean():.2f} ({spread})"
    )
    axes.axhline(float(mean.mean()), color=color, linewidth=1.2, alpha=0.8)


def _draw_published(axes: Axes, label: str, rates: Array, k: int, order: str) -> None:
    rates = np.sort(rates) if order == "own" else rates
    color = ("#666666", "#aaaaaa")[k % 2]
    style = _DASHES[k // 2 % len(_DASHES)]
    axes.plot(rates, color=color, linewidth=1, linestyle=style, zorder=1.5, label=f"{label}: mean {rates.mean():.2f}")
    axes.axhline(float(rates.mean()), color=color, linewidth=0.9, linestyle=style, zorder=1.5)


def _as_rates(argument: str, given: Rates | Summary | Mapping[str, float]) -> dict[str, Array]:
    """Task to its rates over seeds, (n,) float64."""
    if isinstance(given, Summary):
        return dict(zip(given.tasks, given.array.T, strict=True))
    columns = {task: np.atleast_1d(np.asarray(rates, dtype=np.float64)) for task, rates in given.items()}
    if len({len(rates) for rates in columns.values()}) > 1:
        raise ValueError(f"{argument} must hold a rate per seed for each task, got different numbers of them")
    check_rates(argument, list(columns.values()))
    return columns
