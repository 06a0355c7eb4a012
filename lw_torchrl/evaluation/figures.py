"""Figures of results."""

from __future__ import annotations

import math
import os
from typing import TYPE_CHECKING

from lw_torchrl._files import replacing
from lw_torchrl.evaluation.result import EvaluationResult

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def plot_success(result: EvaluationResult, path: str | os.PathLike[str], *, title: str = "") -> Figure:
    """Draw the any-step success rate of each task, best first, with 95 % intervals over the episodes.

    Args:
        result: of :func:`evaluate`.
        path: an image file, .png, .svg or .pdf; it is replaced whole.
        title: above the figure.
    """
    from matplotlib.figure import Figure

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
    axes.set_title(f"{title}\nmean over {len(tasks)} tasks: {result.mean_success:.3f}".strip())
    axes.spines[["top", "right"]].set_visible(False)
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=140)
    return figure
