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


def points(figure, axis="x"):
    """Return the rates of the methods by their labels in the legend."""
    return {line.get_label(): list(getattr(line, f"get_{axis}data")()) for line in figure.axes[0].lines}


def rows(figure):
    return [label.get_text() for label in figure.axes[0].get_yticklabels()]


def test_tasks_are_sorted_by_the_first_method(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", title="few-shot")
    assert rows(figure) == ["sweep", "push", "reach"]
    drawn = points(figure)
    assert drawn["PCBC: mean 0.58 (2 seeds, line: min–max)"] == pytest.approx([0.165, 0.625, 0.95])
    assert drawn["DC: mean 0.50 (1 seed)"] == pytest.approx([0.75, 0.25, 0.5])
    assert all(line.get_linestyle() == "None" for line in figure.axes[0].lines)  # tasks have no order to join
    assert figure.axes[0].get_title() == "few-shot"
    assert [item.name for item in tmp_path.iterdir()] == ["figure.png"]


def test_lines_span_the_seeds(tmp_path):
    (ranges,) = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "figure.png").axes[0].collections
    ends = [path.vertices[:, 0].round(6).tolist() for path in ranges.get_paths()]
    assert ends == [[0.0, 0.33], [0.5, 0.75], [0.9, 1.0]]


def test_each_curve_can_be_sorted_separately(tmp_path):
    figure = plot_sorted_tasks({"PCBC": PCBC, "DC": DC}, tmp_path / "figure.png", order="own")
    assert all(heights == sorted(heights) for heights in points(figure, "y").values())
    assert [label.get_text() for label in figure.axes[0].get_xticklabels()] == ["1", "2", "3"]


def test_a_method_has_one_colour_in_every_figure():
    first = plot_sorted_tasks({"dc": DC, "pcbc": PCBC}).axes[0].lines
    second = plot_sorted_tasks({"mine": DC, "dc": DC}).axes[0].lines
    assert [line.get_label().partition(":")[0] for line in first] == ["task description", "plan"]
    assert second[1].get_color() == first[0].get_color()
    assert len({line.get_color() for line in (*first, *second)}) >= 2
    assert second[0].get_color() != second[1].get_color()


def test_published_rates_are_grey_and_labelled(tmp_path):
    ours = {task: [rate, 1.0] for task, rate in RATES.items()}
    published = {"best": dict.fromkeys(RATES, 0.63), "last": RATES}
    figure = plot_sorted_tasks({"PCBC": ours}, tmp_path / "figure.png", published=published)
    labels = ["best: mean 0.63", "last: mean 0.49"]
    assert points(figure)[labels[1]] == [RATES[task] for task in rows(figure)]
    assert [text.get_text() for text in figure.legends[0].get_texts()][1:] == labels
    assert len(rows(figure)) == 50


@pytest.mark.parametrize("tasks", [50, 10, 2])
def test_neither_labels_nor_legend_are_cut_or_overlap(tmp_path, tasks):
    ours = {task: [rate, 1.0] for task, rate in [*RATES.items()][:tasks]}
    figure = plot_sorted_tasks(
        {name: ours for name in ("PCBC", "DC", "one-hot")},
        tmp_path / "figure.png",
        published={f"{name} published, {which}": RATES for name in ("PCBC", "DC") for which in ("best", "last")},
    )
    figure.draw_without_rendering()  # saving used another resolution
    width, height = figure.bbox.size
    ticks = [label.get_window_extent() for label in figure.axes[0].get_yticklabels()]
    legend = figure.legends[0].get_window_extent()
    assert all(lower.y1 <= upper.y0 for lower, upper in pairwise(ticks))
    for box in (*ticks, legend, figure.axes[0].xaxis.label.get_window_extent()):
        assert box.x0 >= 0
        assert box.y0 >= 0
        assert box.x1 <= width
        assert box.y1 <= height
    assert min(box.y0 for box in ticks) >= legend.y1


def test_a_summary_is_drawn_like_its_rates(tmp_path):
    from_rates = plot_sorted_tasks({"PCBC": PCBC}, tmp_path / "a.png")
    from_summary = plot_sorted_tasks({"PCBC": summarize_rates(PCBC)}, tmp_path / "b.png")
    assert points(from_rates) == points(from_summary)
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
