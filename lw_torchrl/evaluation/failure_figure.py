"""The figure of why episodes failed: a stacked bar for each task."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from lw_torchrl._checks import checked, counted
from lw_torchrl.evaluation.failure_table import count_causes
from lw_torchrl.evaluation.failures import CAUSES
from lw_torchrl.evaluation.figures import check_image, saved
from lw_torchrl.evaluation.result import EvaluationResult, attributed

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLORS = {
    "query": "#4c78a8",
    "plan": "#f58518",
    "skill": "#54a24b",
    "out of time": "#b279a2",
    "undecided": "#bab0ac",
}


@checked
def plot_failures(result: EvaluationResult, path: str | os.PathLike[str] | None = None, *, title: str = "") -> Figure:
    """Draw how many episodes of each task failed, and of what; the task with most failures at the top.

    Args:
        result: of ``evaluate(..., attribute=True)``.
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.
        title: above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: another format, or a result whose failures were not attributed.

    Example:
        >>> from lw_torchrl.evaluation import EpisodeResult, Failure
        >>> config = {"tasks": ["reach"], "episodes_per_task": 1, "max_steps": 500, "seed": 0}
        >>> episode = EpisodeResult("reach", 0, False, None, None, None)
        >>> failure = Failure("reach", 0, 0, "skill", None, 1, 40, "It missed.")
        >>> plot_failures(EvaluationResult(config, (episode,), failures=(failure,))).axes[0].get_title()
        '1 of 1 episode failed'
    """
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    check_image(path)
    failures, trials = attributed(result), result.config["episodes_per_task"]
    counts = count_causes(result.config["tasks"], failures)
    tasks = sorted((task for task in counts if sum(counts[task].values())), key=lambda t: (sum(counts[t].values()), t))
    figure = Figure(figsize=(8.0, 1.9 + 0.27 * len(tasks)), layout="constrained")
    axes = figure.subplots()
    left = dict.fromkeys(tasks, 0)
    for cause, meaning in CAUSES.items():
        numbers = [counts[task][cause] for task in tasks]
        label = f"{cause}: {meaning} ({sum(numbers)})"
        bars = axes.barh(tasks, numbers, left=list(left.values()), color=_COLORS[cause], label=label, height=0.7)
        axes.bar_label(bars, [str(n) if n else "" for n in numbers], label_type="center", color="white", fontsize=8)
        for task, number in zip(tasks, numbers, strict=True):
            left[task] += number
    axes.set_xlim(0, trials * 1.02)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.margins(y=0.5 / max(1, len(tasks)))
    axes.set_xlabel(f"failed episodes (of {trials}; tasks without any are left out)")
    episodes = counted(trials * len(counts), "episode")
    axes.set_title(f"{title}\n{len(failures)} of {episodes} failed".strip())
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return saved(figure, path)
