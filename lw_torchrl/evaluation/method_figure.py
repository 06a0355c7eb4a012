"""The figure of methods on several data: a row for each method, a column for each data."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lw_torchrl._checks import checked
from lw_torchrl.evaluation.figures import check_image, saved
from lw_torchrl.evaluation.summary import Summary

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@checked
def plot_methods(
    groups: Mapping[str, Mapping[str, Summary]], path: str | os.PathLike[str] | None = None, *, title: str = ""
) -> Figure:
    """Draw the mean success of each method: a bar for the mean over seeds and tasks with its 95 % interval, a dot for
    each seed; methods from the top in the order in which they are given.

    Args:
        groups: a column's name to its methods' summaries by name.
        path: an image file, .png, .svg, .pdf or .jpg; it is replaced whole. None for none.
        title: above the figure.

    Returns:
        The figure.

    Raises:
        ValueError: no groups, or another format.

    Example:
        >>> from lw_torchrl.evaluation import summarize_rates
        >>> figure = plot_methods({"B": {"bc": summarize_rates({"push": [0.5, 0.7]})}})
        >>> figure.axes[0].get_title()
        'B'
    """
    from matplotlib.figure import Figure

    path = None if path is None else Path(path)
    check_image(path)
    if not groups:
        raise ValueError("groups must hold at least one, got none")
    labels = list(dict.fromkeys(label for methods in groups.values() for label in methods))
    figure = Figure(figsize=(2.6 + 3.0 * len(groups), 1.3 + 0.3 * len(labels)), layout="constrained")
    columns = np.atleast_1d(figure.subplots(1, len(groups), sharey=True))
    for axes, (group, methods) in zip(columns, groups.items(), strict=True):
        for place, label in enumerate(labels):
            if (found := methods.get(label)) is None:
                continue
            mean, seeds = found.mean, found.array.mean(1)
            axes.barh(place, mean.value, color="#4c78a8" if place == 0 else "#b8c9de", height=0.7)
            if mean.low is not None:
                axes.plot([mean.low, mean.high], [place, place], color="#333333", linewidth=1.2)
            axes.plot(seeds, np.full(len(seeds), place), ".", color="#f58518", markersize=5, zorder=3)
            axes.text(1.04, place, f"{mean.value:.2f}", va="center", fontsize=8, color="#222222")
        axes.set_title(group)
        axes.set_xlim(0, 1.18)
        axes.set_xticks(np.linspace(0, 1, 6))
        axes.set_yticks(range(len(labels)), labels, fontsize=9)
        axes.grid(axis="x", color="#dddddd", linewidth=0.6)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].invert_yaxis()
    figure.supxlabel("episodes with success at any step; dots: seeds; lines: 95 %", fontsize=9)
    figure.suptitle(title)
    return saved(figure, path)
