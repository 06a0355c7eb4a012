"""Figures of results: success, failures, tasks sorted by success."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from lw_torchrl._checks import checked, counted
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl.evaluation.diagnose.failure import CAUSES, count_causes
from lw_torchrl.evaluation.result import EvaluationResult, attributed
from lw_torchrl.evaluation.statistics import Array, check_rates, wilson_interval
from lw_torchrl.evaluation.summary import Summary

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_FORMATS = (".png", ".svg", ".pdf", ".jpg", ".jpeg")
Rates = Mapping[str, float | Sequence[float]]
COLORS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#9d755d", "#e45756")
_DASHES = ((0, (5, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)), (0, (3, 3)))
_LONG_LABEL = 50  # letters of a legend that do not stand in two columns
_CAUSE_COLORS: dict[str, str] = {
    **{"query": "#4c78a8", "plan": "#f58518", "skill": "#54a24b", "out of time": "#b279a2", "undecided": "#bab0ac"},
    **{"not reproducible": "#d5cec9", "perception": "#72b7b2", "gripper": "#eeca3b", "actuation": "#9d755d"},
    **{"policy": "#e45756"},
}


def check_image(path: AnyPath | None) -> None:
    """Raise :class:`ValueError` unless the file's name tells a format."""
    if path is not None and (given := Path(path).suffix.lower()) not in _FORMATS:
        raise ValueError(f"path must end in {', '.join(_FORMATS)}, got {given!r} of {str(path)!r}")


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of so many inches."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def saved(figure: Figure, path: AnyPath | None) -> Figure:
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=140)
    return figure


def trim(axes: Axes, grid: Literal["x", "y"] | None = None) -> None:
    """Take the upper and right spines away; lines across ``grid`` stand behind what is drawn."""
    axes.spines[["top", "right"]].set_visible(False)
    if grid is not None:
        axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)


@checked
def plot_success(result: EvaluationResult, path: AnyPath | None = None, *, title: str = "") -> Figure:
    """Draw the any-step success rate of each task, best first, with 95 % intervals over the episodes.

    Args:
        result: of :func:`evaluate`.
        path: an image file, .png, .svg, .pdf or .jpg, replaced whole; another format raises :class:`ValueError`.
        title: above the figure.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> plot_success(result).axes[0].get_title()
        'mean over 1 task: 1.000'
    """
    check_image(path)
    rates = {task: rate for task, rate in result.success_once.items() if rate is not None}
    trials = result.config["episodes_per_task"]
    tasks = sorted(rates, key=lambda task: (rates[task], task))
    figure = new_figure(8.0, 1.6 + 0.27 * len(tasks))
    axes = figure.subplots()
    values = np.array([rates[task] for task in tasks])
    low, high = np.array([wilson_interval(round(rate * trials), trials) for rate in values.tolist()]).T
    ends, bars = (values - low, high - values), {"ecolor": "#333333", "elinewidth": 1, "capsize": 2}
    axes.barh(tasks, values, xerr=np.maximum(ends, 0.0), color="#4c78a8", error_kw=bars)
    axes.axvline(result.mean_success, color="#e45756", linestyle="--")
    axes.set_xlim(0, 1.02)
    axes.margins(y=0.5 / len(tasks))
    noise = result.config["noise_scale"]
    axes.set_xlabel(f"episodes with success at any step (of {trials}; action noise {noise}; bars: 95 %)")
    axes.set_title(f"{title}\nmean over {counted(len(tasks), 'task')}: {result.mean_success:.3f}".strip())
    trim(axes)
    return saved(figure, path)


@checked
def plot_failures(result: EvaluationResult, path: AnyPath | None = None, *, title: str = "") -> Figure:
    """Draw how many episodes of each task failed, and of what; the task with most failures at the top.

    Args:
        result: of ``evaluate(..., attribute=True)``; one without failures raises :class:`ValueError`.
        path, title: as for :func:`plot_success`.

    Example:
        >>> from lw_torchrl.evaluation import EpisodeResult, Failure
        >>> config = {"tasks": ["reach"], "episodes_per_task": 1, "max_steps": 500, "seed": 0}
        >>> episode = EpisodeResult("reach", 0, False, None, None, None)
        >>> failure = Failure("reach", 0, 0, "skill", None, 1, 40)
        >>> plot_failures(EvaluationResult(config, (episode,), failures=(failure,))).axes[0].get_title()
        '1 of 1 episode failed'
    """
    from matplotlib.ticker import MaxNLocator

    check_image(path)
    failures, trials = attributed(result), result.config["episodes_per_task"]
    counts = count_causes(result.config["tasks"], failures)
    tasks = sorted((task for task in counts if sum(counts[task].values())), key=lambda t: (sum(counts[t].values()), t))
    figure = new_figure(8.0, 1.9 + 0.27 * len(tasks) + 0.1 * len({one.cause for one in failures}))
    axes = figure.subplots()
    left = np.zeros(len(tasks))
    for cause, meaning in CAUSES.items():
        numbers = [counts[task][cause] for task in tasks]
        if not any(numbers):
            continue
        label = f"{cause}: {meaning} ({sum(numbers)})"
        bars = axes.barh(tasks, numbers, left=left, color=_CAUSE_COLORS[cause], label=label, height=0.7)
        axes.bar_label(bars, [str(n) if n else "" for n in numbers], label_type="center", color="white", fontsize=8)
        left = left + numbers
    axes.set_xlim(0, trials * 1.02)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(y=0.5 / max(1, len(tasks)))
    axes.set_xlabel(f"failed episodes (of {trials}; tasks without any are left out)")
    episodes = counted(trials * len(counts), "episode")
    axes.set_title(f"{title}\n{len(failures)} of {episodes} failed".strip())
    trim(axes)
    if failures:
        columns = 2 if max(map(len, axes.get_legend_handles_labels()[1])) <= _LONG_LABEL else 1
        figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return saved(figure, path)


@checked
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
