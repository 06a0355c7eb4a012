"""The paper's figure: tasks sorted by success rate."""

import pytest

from benchmarks.figures import plot_sorted_tasks

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
