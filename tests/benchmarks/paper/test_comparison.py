"""Methods side by side, and the published numbers beside them."""

import pytest

import lw_torchrl as lw
from benchmarks.figures import plot_sorted_tasks
from benchmarks.paper.comparison import MethodComparison
from benchmarks.paper.published import published, published_curves
from benchmarks.statistics import summarize_rates

A = summarize_rates({"push": [0.9, 0.7], "assembly": [0.5, 0.3]})
B = summarize_rates({"assembly": [0.4, 0.4], "push": [0.2, 0.2]})
PUBLISHED = {"published, last": {"push": 0.8, "assembly": 0.1, "reach": 1.0}}
MEANS = {
    ("zero-shot", "PCBC"): (0.258, 0.4035),
    ("zero-shot", "DC"): (0.28875, 0.381),
    ("few-shot", "PCBC"): (0.39325, 0.631),
    ("few-shot", "DC"): (0.3395, 0.43675),
    ("one-shot", "PCBC"): (0.54575, 0.68),
    ("one-shot", "DC"): (0.539, 0.539),
}


def test_tables():
    comparison = MethodComparison({"a": A, "b": B}, PUBLISHED)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in comparison.per_task().splitlines()]
    assert rows[0] == ["task", "a", "b", "published, last"]
    assert rows[2:] == [["push", "0.80 (0.70-0.90)", "0.20", "0.80"], ["assembly", "0.40 (0.30-0.50)", "0.40", "0.10"]]
    lines = comparison.headline().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[:5]]
    assert rows[0] == ["method", "mean", "IQM", "tasks >= 0.8, of 2", "seeds", "mean of the 1 outside MT10"]
    assert rows[2][3:] == ["1", "0.700, 0.500", "0.400"]
    assert rows[4] == ["published, last", "0.450", "", "1", "", "0.100"]
    assert lines[-1].startswith("a - b: 0.300 [")


@pytest.mark.parametrize(("setting", "method"), MEANS)
def test_published_rates_have_the_published_means(setting, method):
    last, best = (published(setting, method, which) for which in ("last", "best"))
    assert tuple(last) == tuple(best) == lw.MT50
    assert all(last[task] <= best[task] for task in lw.MT50)
    means = sum(last.values()) / 50, sum(best.values()) / 50
    assert means == pytest.approx(MEANS[setting, method], abs=1e-9)
    curves = published_curves(setting, method)
    assert curves == {f"{method} published, best of the last 10 evaluations": best, f"{method} published, last": last}


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
