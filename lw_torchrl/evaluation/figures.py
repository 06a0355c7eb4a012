"""Figures of evaluation results: success rates and failure causes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np

from lw_torchrl._util.checks import typed
from lw_torchrl._util.files import AnyPath, replacing
from lw_torchrl._util.text import counted
from lw_torchrl.evaluation.diagnose.failure import CAUSE_COLORS, CAUSES
from lw_torchrl.evaluation.result import EvaluationResult, wilson_interval

_FORMATS = (".png", ".svg", ".pdf", ".jpg", ".jpeg")
COLORS = ("#4c78a8", "#f58518", "#54a24b", "#b279a2", "#9d755d", "#e45756")
_LONG_LABEL = 50  # longest legend label, in characters, that still fits into two columns


def check_image(path: AnyPath | None) -> None:
    """Raise :class:`ValueError` unless the file's suffix denotes a supported image format."""
    if path is not None and (suffix := Path(path).suffix.lower()) not in _FORMATS:
        raise ValueError(f"path must end in {', '.join(_FORMATS)}, got suffix {suffix!r} in {str(path)!r}")


def new_figure(width: float, height: float) -> Any:
    """Return an empty ``matplotlib.figure.Figure`` (sizes in inches) that needs neither a window nor a backend."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def saved(figure: Any, path: AnyPath | None) -> Any:
    """Write a figure to ``path`` unless it is None, and return the figure."""
    check_image(path)
    if path is not None:
        with replacing(path) as temporary:
            figure.savefig(temporary, dpi=140)
    return figure


def trim(axes: Any, grid: Literal["x", "y"] | None = None) -> None:
    """Remove the top and right spines, and draw grid lines for the axis ``grid`` behind everything else."""
    axes.spines[["top", "right"]].set_visible(False)
    if grid is not None:
        axes.grid(axis=grid, color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)


@typed
def plot_success(result: EvaluationResult, path: AnyPath | None = None, *, title: str = "") -> Any:
    """Plot each task's success rate at any time step, best first, with 95 % intervals.

    Return the ``matplotlib`` figure, and also write it to ``path`` (.png, .svg, .pdf or .jpg) unless it is None.

    Example:
        >>> import lw_torchrl as lw
        >>> result = lw.evaluate(lw.ExpertActor("reach"), tasks="reach", episodes_per_task=2, seed=1_000)
        >>> plot_success(result).axes[0].get_title()
        'mean over 1 task: 1.000'
    """
    rates = {task: rate for task, rate in result.success_once.items() if rate is not None}
    trials = result.config["episodes_per_task"]
    tasks = sorted(rates, key=lambda task: (rates[task], task))
    figure = new_figure(8.0, 1.6 + 0.27 * len(tasks))
    axes = figure.subplots()
    values = np.array([rates[task] for task in tasks])
    low, high = np.array([wilson_interval(round(rate * trials), trials) for rate in values.tolist()]).T
    ends, bars = np.maximum((values - low, high - values), 0.0), {"ecolor": "#333333", "elinewidth": 1, "capsize": 2}
    axes.barh(tasks, values, xerr=ends, color="#4c78a8", error_kw=bars)
    axes.axvline(result.mean_success, color="#e45756", linestyle="--")
    axes.set_xlim(0, 1.02)
    axes.margins(y=0.5 / len(tasks))
    noise = result.config["noise_scale"]
    axes.set_xlabel(f"episodes with success at any step (of {trials}; action noise {noise}; bars: 95 %)")
    axes.set_title(f"{title}\nmean over {counted(len(tasks), 'task')}: {result.mean_success:.3f}".strip())
    trim(axes)
    return saved(figure, path)


@typed
def plot_failures(result: EvaluationResult, path: AnyPath | None = None, *, title: str = "") -> Any:
    """Plot the number of each task's failed episodes by cause, with the most failures on top.

    ``result`` comes from ``evaluate(..., attribute=True)``. Return the ``matplotlib`` figure, and also write it to
    ``path`` (.png, .svg, .pdf or .jpg) unless it is None.

    Example:
        >>> from lw_torchrl.evaluation import EpisodeResult, Failure
        >>> config = {"tasks": ["reach"], "episodes_per_task": 1, "max_steps": 500, "seed": 0}
        >>> episode = EpisodeResult("reach", 0, False, None, None, None)
        >>> failure = Failure("reach", 0, 0, "skill", None, 1, 40)
        >>> plot_failures(EvaluationResult(config, (episode,), failures=(failure,))).axes[0].get_title()
        '1 of 1 episode failed'
    """
    from matplotlib.ticker import MaxNLocator

    counts, trials = result.failure_counts(), result.config["episodes_per_task"]
    tasks = sorted((task for task in counts if counts[task]), key=lambda task: (counts[task].total(), task))
    failures = sum(row.total() for row in counts.values())
    figure = new_figure(8.0, 1.9 + 0.27 * len(tasks) + 0.1 * len({cause for row in counts.values() for cause in row}))
    axes = figure.subplots()
    left = np.zeros(len(tasks))
    for cause in [cause for cause in CAUSES if any(row[cause] for row in counts.values())]:
        numbers = [counts[task][cause] for task in tasks]
        label = f"{cause}: {CAUSES[cause]} ({sum(numbers)})"
        bars = axes.barh(tasks, numbers, left=left, color=CAUSE_COLORS[cause], label=label, height=0.7)
        axes.bar_label(bars, [str(n) if n else "" for n in numbers], label_type="center", color="white", fontsize=8)
        left = left + numbers
    axes.set_xlim(0, trials * 1.02)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(y=0.5 / max(1, len(tasks)))
    axes.set_xlabel(f"failed episodes (of {trials}; tasks without failures are omitted)")
    episodes = counted(trials * len(counts), "episode")
    axes.set_title(f"{title}\n{failures} of {episodes} failed".strip())
    trim(axes)
    if failures:
        columns = 2 if max(map(len, axes.get_legend_handles_labels()[1])) <= _LONG_LABEL else 1
        figure.legend(loc="outside lower center", ncols=columns, frameon=False, fontsize=9)
    return saved(figure, path)
