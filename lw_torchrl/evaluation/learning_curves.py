"""The figure of learning in an environment: success by steps, a panel for each task."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lw_torchrl._checks import checked, counted
from lw_torchrl.evaluation.figures import COLORS, check_image, saved

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.figure import Figure

Curve = Sequence[tuple[float, float]]
"""Points (steps of the environment, success rate in [0, 1])."""


@checked
def plot_learning_curves(
    curves: Mapping[str, Mapping[str, Sequence[Curve]]],
    path: str | os.PathLike[str] | None = None,
    *,
    starts: Mapping[str, float] | None = None,
    title: str = "",
) -> Figure:
    """Draw success by steps of the environment: a panel for each task, a line for each method.

    A line is the mean over seeds, its band spans the least and the greatest seed.

    Args:
        curves: task to method to the curve of each seed; those of a method in a task have the same steps.
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.
        starts: task to the success rate before, as a dotted line.
        title: above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: no curves, seeds of different steps, or another format.

    Example:
        >>> figure = plot_learning_curves({"push": {"td3": [[(0, 0.2), (5000, 0.9)], [(0, 0.3), (5000, 0.7)]]}})
        >>> figure.axes[0].get_title()
        'push'
    """
    from matplotlib.figure import Figure

    check_image(path)
    if not curves:
        raise ValueError("curves must hold at least one task, got none")
    methods = list(dict.fromkeys(method for found in curves.values() for method in found))
    columns = min(len(curves), 4)
    rows = -(-len(curves) // columns)
    figure = Figure(figsize=(max(4.8, 3.4 * columns), 3.0 * rows + 0.9), layout="constrained")
    panels = np.atleast_1d(figure.subplots(rows, columns, sharex=True, sharey=True)).ravel()
    for axes, (task, found) in zip(panels, curves.items(), strict=False):
        for method, seeds in found.items():
            steps = [[step for step, _ in curve] for curve in seeds]
            if any(one != steps[0] for one in steps):
                raise ValueError(f"curves[{task!r}][{method!r}] must have the same steps in all seeds")
            rates = np.array([[rate for _, rate in curve] for curve in seeds])
            color, x = COLORS[methods.index(method) % len(COLORS)], np.array(steps[0]) / 1000
            axes.fill_between(x, rates.min(0), rates.max(0), color=color, alpha=0.16, linewidth=0)
            label = f"{method} ({counted(len(seeds), 'seed')})"
            axes.plot(x, rates.mean(0), color=color, linewidth=2, marker=".", label=label)
        if starts is not None and task in starts:
            axes.axhline(starts[task], color="#333333", linewidth=1.2, linestyle=":", label="start, evaluated")
        axes.set_title(task, fontsize=10)
        axes.set_xlabel("thousand steps of the environment", fontsize=9)
        axes.set_ylim(-0.02, 1.02)
        axes.grid(axis="y", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in panels[len(curves) :]:
        axes.set_visible(False)
    figure.supylabel("success in training", fontsize=10)
    named: dict[str, Artist] = {}
    for axes in panels[: len(curves)]:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            named.setdefault(label, handle)
    figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    figure.suptitle(title)
    return saved(figure, path)
