"""Tables in Markdown, and the paper's figure: tasks sorted by success rate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import rc_context

from benchmarks.statistics import Array, Summary, check_rates
from lw_torchrl._util.files import AnyPath
from lw_torchrl.evaluation.figures import check_image, new_figure, saved

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rates = Mapping[str, float | Sequence[float]]
NEUTRAL = "#7a828b"  # legible on white and on black
NEUTRAL_STYLE: dict[str, Any] = {
    **dict.fromkeys(("figure.facecolor", "axes.facecolor", "savefig.facecolor"), "none"),
    **dict.fromkeys(("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color"), NEUTRAL),
    **{"font.size": 13, "axes.titlesize": 14, "axes.labelsize": 13, "grid.color": NEUTRAL, "grid.alpha": 0.3},
}
"""Matplotlib settings for pictures that are shown in light and in dark mode."""
METHOD_COLORS = {
    "plan": "#3f8fd2", "generic plan": "#3aa99f", "task description": "#e8833a", "task number": "#5aa85a",
    "scripted skills": "#a678c8", "baseline": "#8d97a3",
}  # fmt: skip
"""The color of each method, the same in every figure."""
METHODS = {"pcbc": "plan", "dc": "task description", "one-hot": "task number", "scripted": "scripted skills"}
METHODS["PlanConditionedActor"] = "plan"
"""The name of each method in figures, by its name in experiments."""
_DASHES = ((0, (5, 2)), (0, (1, 1.5)), (0, (5, 1, 1, 1)), (0, (3, 3)))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table with aligned columns."""
    widths = [max(len(row[k]) for row in [head, *rows]) for k in range(len(head))]
    lines = [head, ["-" * width for width in widths], *rows]
    return "\n".join("| " + " | ".join(map(str.ljust, line, widths)) + " |" for line in lines)


def draw_rates(
    axes: Axes, names: Sequence[str], rates: Sequence[Sequence[float] | None], colors: Sequence[str]
) -> None:
    """Draw a horizontal bar for each rate, with its interval and value; the first name is at the top.

    Args:
        rates: for each name (mean, low, high) or (mean,), in [0, 1], or None to draw nothing.
    """
    for place, (rate, color) in enumerate(zip(rates, colors, strict=True)):
        if rate is None:
            axes.text(0.02, place, "not measured", va="center", fontsize=10, style="italic")
            continue
        mean, *ends = rate
        axes.barh(place, mean, color=color, height=0.68, alpha=0.4)
        if ends:
            axes.plot(ends, [place, place], color=color, linewidth=3, solid_capstyle="butt")
        axes.plot(mean, place, "o", color=color, markersize=7)
        axes.text(1.05, place, f"{mean + 1e-9:.2f}", va="center", fontweight="bold")  # 0.835 is 0.84
    axes.set_yticks(range(len(names)), names)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlim(0, 1.02)
    axes.set_xticks([0, 0.25, 0.5, 0.75, 1.0], ["0", "", "0.5", "", "1"])
    axes.spines[["top", "right", "left"]].set_visible(False)
    axes.tick_params(axis="y", length=0)
    axes.grid(axis="x")
    axes.set_axisbelow(True)


def draw_points(axes: Axes, places: Sequence[str], methods: Mapping[str, Sequence[Sequence[float] | None]]) -> None:
    """Draw each method's rates at ordered positions of the x axis: points with intervals, joined by a thin line.

    Args:
        methods: for each method, (mean, low, high) or (mean,) at each position, or None to draw nothing there.
    """
    looks = _look([*methods]).values()
    for number, ((name, color), rates) in enumerate(zip(looks, methods.values(), strict=True)):
        known = {place: rate for place, rate in enumerate(rates) if rate is not None}
        x = np.array([*known]) + 0.12 * (number - (len(methods) - 1) / 2)
        means = np.array([rate[0] for rate in known.values()])
        errors = np.abs(np.array([rate[1:] or (rate[0], rate[0]) for rate in known.values()]).T - means)
        look: dict[str, Any] = {"color": color, "capsize": 4, "markersize": 8, "linewidth": 1.5, "elinewidth": 2.5}
        axes.errorbar(x, means, errors if errors.any() else None, marker="o", label=name, **look)
    axes.set_xticks(range(len(places)), places)
    axes.set_ylim(0, 1.03)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y")
    axes.set_axisbelow(True)


Panel = tuple[str, Sequence[str], Mapping[str, Sequence[Sequence[float] | None]]]
"""Title, positions and rates of a panel; see :func:`draw_points`."""


def plot_panels(panels: Sequence[Panel], path: AnyPath | None = None, *, xlabel: str = "") -> Figure:
    """Draw success at ordered positions, in panels side by side with one legend above."""
    check_image(path)
    with rc_context(NEUTRAL_STYLE):
        figure = new_figure(max(6.0, 3.8 * len(panels)), 4.0)
        columns = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for axes, (title, places, methods) in zip(columns, panels, strict=True):
            draw_points(axes, places, methods)
            axes.set_title(title)
        figure.supxlabel(xlabel, fontsize=13)
        columns[0].set_ylabel("success")
        handles, labels = columns[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside upper center", ncols=3, frameon=False)
        return saved(figure, path)


def plot_sorted_tasks(
    curves: Mapping[str, Rates | Summary],
    path: AnyPath | None = None,
    *,
    published: Mapping[str, Mapping[str, float]] | None = None,
    order: Literal["shared", "own"] = "shared",
    of: str = "seed",
    title: str = "",
) -> Figure:
    """Draw the paper's figure: tasks sorted by success rate.

    A point is the mean over seeds; a line or a band extends from the worst to the best seed. The legend shows the mean
    over tasks. Published rates are gray.

    Args:
        curves: for each method, its :class:`Summary`, or a mapping from task to success rates in [0, 1], one per seed.
            All methods have the same tasks.
        path, title: as for :func:`plot_success`.
        published: for each label, a mapping from task to success rate, with at least the same tasks.
        order: "shared" draws a row for each task, sorted by the first method; "own" sorts the rates of each method
            separately, as the paper does, and draws curves over the rank.
        of: what each rate belongs to, for the legend, such as "seed" or "plan".

    Example:
        >>> figure = plot_sorted_tasks({"PCBC": {"push": [0.5, 0.7], "reach": [1.0, 0.9]}})
        >>> [label.get_text() for label in figure.axes[0].get_yticklabels()]
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
            raise ValueError(f"curves must have the same tasks; {first!r} and {method!r} do not share {different}")
    means = {task: float(rates.mean()) for task, rates in named[first].items()}
    tasks = sorted(means, key=lambda task: (means[task], task))
    dashed = {label: _as_rates(f"published[{label!r}]", rates) for label, rates in (published or {}).items()}
    for label, rates in dashed.items():
        if missing := [task for task in tasks if task not in rates]:
            raise ValueError(f"published[{label!r}] lacks the tasks {missing}")

    with rc_context(NEUTRAL_STYLE):
        draw = _draw_tasks if order == "shared" else _draw_ranks
        figure = draw({method: np.stack([rates[task] for task in tasks]) for method, rates in named.items()}, tasks, of)
        (axes,) = figure.axes
        for k, (label, rates) in enumerate(dashed.items()):
            values = np.array([rates[task].mean() for task in tasks])
            look = {
                "color": ("#6b7580", "#a3acb5")[k % 2],
                "label": f"{label}: mean {values.mean():.2f}",
                "zorder": 1.5,
            }
            if order == "shared":
                axes.plot(values, range(len(tasks)), linestyle="none", marker="|", markersize=9, **look)
            else:
                axes.plot(np.sort(values), linewidth=1.2, linestyle=_DASHES[k // 2 % len(_DASHES)], **look)
        axes.set_title(title)
        handles, _ = axes.get_legend_handles_labels()
        columns = 2 if len(handles) > len(named) and order == "shared" else 1
        figure.legend(handles=handles, loc="outside lower center", ncols=columns, frameon=False, fontsize=10)
        return saved(figure, path)


def _look(methods: Sequence[str]) -> dict[str, tuple[str, str]]:
    """Return the name in figures and the color of each method."""
    names = {method: METHODS.get(method, method) for method in methods}
    spare = iter([color for color in METHOD_COLORS.values() if color not in map(METHOD_COLORS.get, names.values())])
    return {method: (name, METHOD_COLORS.get(name) or next(spare, NEUTRAL)) for method, name in names.items()}


def _label(name: str, rates: Array, of: str, range_shown: str) -> str:
    seeds = rates.shape[1]
    return f"{name}: mean {rates.mean():.2f} ({f'1 {of}' if seeds == 1 else f'{seeds} {of}s, {range_shown}'})"


def _draw_tasks(methods: Mapping[str, Array], tasks: Sequence[str], of: str) -> Figure:
    """Draw a row for each task, with a point at each method's mean and a line from its worst to its best seed."""
    figure = new_figure(9.6, 2.0 + 0.27 * len(tasks))
    axes = figure.subplots()
    for k, ((name, color), rates) in enumerate(zip(_look([*methods]).values(), methods.values(), strict=True)):
        rows = np.arange(len(tasks)) + 0.22 * ((len(methods) - 1) / 2 - k)
        axes.hlines(rows, rates.min(1), rates.max(1), color=color, linewidth=2, alpha=0.55)
        label = _label(name, rates, of, "line: min–max")
        axes.plot(rates.mean(1), rows, "o", color=color, markersize=5, zorder=3, label=label)
    axes.set_yticks(range(len(tasks)), tasks, fontsize=10)
    axes.set_ylim(-0.6, len(tasks) - 0.4)
    axes.set_xlim(-0.02, 1.02)
    axes.set_xlabel("episodes with success at any step")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid()
    axes.set_axisbelow(True)
    return figure


def _draw_ranks(methods: Mapping[str, Array], tasks: Sequence[str], of: str) -> Figure:
    """Draw each method's rates in ascending order, with a shaded band from the worst to the best seed."""
    figure = new_figure(9.6, 5.4)
    axes = figure.subplots()
    for (name, color), rates in zip(_look([*methods]).values(), methods.values(), strict=True):
        rates = rates[np.argsort(rates.mean(1), kind="stable")]
        axes.fill_between(range(len(rates)), rates.min(1), rates.max(1), color=color, alpha=0.2, linewidth=0)
        label = _label(name, rates, of, "min–max shaded")
        axes.plot(rates.mean(1), color=color, linewidth=2, marker=".", zorder=3, label=label)
    every = max(1, len(tasks) // 10)
    axes.set_xticks(range(0, len(tasks), every), [str(rank) for rank in range(1, len(tasks) + 1, every)])
    axes.set_xlabel("rank of the task, for each method separately")
    axes.set_ylabel("success at any step")
    axes.set_ylim(-0.02, 1.02)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis="y")
    axes.set_axisbelow(True)
    return figure


def _as_rates(argument: str, given: Rates | Summary | Mapping[str, float]) -> dict[str, Array]:
    """Return the rates over seeds, (n,) float64, of each task."""
    if isinstance(given, Summary):
        return dict(zip(given.tasks, given.array.T, strict=True))
    columns = {task: np.atleast_1d(np.asarray(rates, dtype=np.float64)) for task, rates in given.items()}
    if len({len(rates) for rates in columns.values()}) > 1:
        raise ValueError(f"{argument} must have one rate per seed for each task, got different numbers of rates")
    check_rates(argument, list(columns.values()))
    return columns
