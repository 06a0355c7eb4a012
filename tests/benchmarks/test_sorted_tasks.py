"""The paper's figure: tasks sorted by success rate."""

import pytest

from benchmarks.figures import plot_sorted_tasks


def test_tasks_are_sorted_by_the_first_method(tmp_path):
    pcbc = {"push": [0.5, 0.75], "reach": [1.0, 0.9], "sweep": [0.0, 0.33]}
    dc = {"push": [0.25], "reach": [0.5], "sweep": [0.75]}
    [axes] = plot_sorted_tasks({"PCBC": pcbc, "DC": dc}, tmp_path / "figure.png", title="few-shot").axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["sweep", "push", "reach"]
    drawn = {line.get_label(): list(line.get_xdata()) for line in axes.lines}
    assert drawn["PCBC: mean 0.58 (2 seeds, line: min–max)"] == pytest.approx([0.165, 0.625, 0.95])
    assert drawn["DC: mean 0.50 (1 seed)"] == pytest.approx([0.75, 0.25, 0.5])
    assert all(line.get_linestyle() == "None" for line in axes.lines)  # tasks have no order to join
    assert axes.get_title() == "few-shot"
    assert [item.name for item in tmp_path.iterdir()] == ["figure.png"]
