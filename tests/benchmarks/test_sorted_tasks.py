"""The paper's figure: tasks sorted by success rate."""

from __future__ import annotations

from itertools import pairwise

import pytest

from benchmarks.figures import plot_sorted_tasks
from benchmarks.statistics import summarize_rates
from lw_torchrl.language.tasks import MT50

RATES = {task: number / 50 for number, task in enumerate(MT50)}
PCBC = {"push": [0.5, 0.75], "reach": [1.0, 0.9], "sweep": [0.0, 0.33]}
DC = {"push": [0.25], "reach": [0.5], "sweep": [0.75]}


def lines(figure):
    """Return the heights of the curves by their labels in the legend."""
    return {line.get_label(): list(line.get_ydata()) for line in figure.axes[0].lines if line.get_label()[0] != "_"}


def levels(figure):
    """Return the heights of the horizontal lines."""
    return [float(line.get_ydata()[0]) for line in figure.axes[0].lines if line.get_label()[0] == "_"]


def test_tasks_are_sorted_by_the_first_method(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", title="few-shot")
    axes = figure.axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == ["sweep", "push", "reach"]
    assert {label.get_rotation() for label in axes.get_xticklabels()} == {90}
    curves = lines(figure)
    assert curves["PCBC: mean 0.58 (2 seeds, min–max shaded)"] == pytest.approx([0.165, 0.625, 0.95])
    assert curves["DC: mean 0.50 (1 seed)"] == pytest.approx([0.75, 0.25, 0.5])
    assert levels(figure) == pytest.approx([3.48 / 6, 0.5])
    assert axes.get_title() == "few-shot"
    assert [item.name for item in tmp_path.iterdir()] == ["figure.png"]


def test_band_spans_the_seeds(tmp_path):
    axes = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "figure.png").axes[0]
    corners = {tuple(corner) for corner in axes.collections[0].get_paths()[0].vertices.round(6).tolist()}
    assert {(0.0, 0.0), (0.0, 0.33), (1.0, 0.5), (1.0, 0.75), (2.0, 0.9), (2.0, 1.0)} <= corners


def test_each_curve_can_be_sorted_separately(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", order="own")
    assert all(heights == sorted(heights) for heights in lines(figure).values())
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["1", "2", "3"]


def test_published_curves_are_dashed_and_labelled(tmp_path):
    ours = {task: [rate, 1.0] for task, rate in RATES.items()}
    curves = {"best": dict.fromkeys(RATES, 0.63), "last": RATES}
    figure = plot_sorted_tasks({"PCBC": ours}, tmp_path / "figure.png", published=curves)
    labels = ["best: mean 0.63", "last: mean 0.49"]
    tasks = [label.get_text() for label in figure.axes[0].get_xticklabels()]
    assert lines(figure)[labels[1]] == [RATES[task] for task in tasks]
    for line in figure.axes[0].lines:
        assert line.is_dashed() == (line.get_label() in labels) or line.get_label()[0] == "_"
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert [label for label in shown if label.strip()] == [next(iter(lines(figure))), *labels]
    assert len(tasks) == 50


@pytest.mark.parametrize("tasks", [50, 34, 10, 2])
def test_neither_labels_nor_legend_are_cut_or_overlap(tmp_path, tasks):
    ours = {task: [rate, 1.0] for task, rate in [*RATES.items()][:tasks]}
    figure = plot_sorted_tasks(
        {name: ours for name in ("PCBC", "DC", "one-hot")},
        tmp_path / "figure.png",
        published={f"{name} published, {which}": RATES for name in ("PCBC", "DC") for which in ("best", "last")},
    )
    figure.draw_without_rendering()  # saving used another resolution
    width, height = figure.bbox.size
    ticks = [label.get_window_extent() for label in figure.axes[0].get_xticklabels()]
    legend = figure.legends[0].get_window_extent()
    assert all(left.x1 <= right.x0 for left, right in pairwise(ticks))
    for box in (*ticks, legend, figure.axes[0].xaxis.label.get_window_extent()):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
    assert min(box.y0 for box in ticks) >= legend.y1


def test_summary_is_a_curve(tmp_path):
    from_rates = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "a.png")
    from_summary = plot_sorted_tasks({"PCBC": summarize_rates(PCBC)}, tmp_path / "b.png")
    assert lines(from_rates) == lines(from_summary)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("argument", "curves", "options"),
    [
        ("curves", {}, {}),
        ("curves", {"PCBC": PCBC, "DC": {"push": [0.5]}}, {}),
        ("curves", {"PCBC": {"push": [0.5], "reach": [0.5, 0.5]}}, {}),
        ("curves", {"PCBC": {"push": [1.5]}}, {}),
        ("curves", {"PCBC": {}}, {}),
        ("published", {"PCBC": PCBC}, {"published": {"last": {"push": 0.5}}}),
    ],
)
def test_wrong_curves_raise_before_a_file_is_written(tmp_path, argument, curves, options):
    with pytest.raises(ValueError, match=argument):
        plot_sorted_tasks(curves, tmp_path / "figure.png", **options)
    assert not list(tmp_path.iterdir())
