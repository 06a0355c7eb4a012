"""Methods side by side, and the published numbers beside them."""

import pytest

import lw_torchrl as lw
from benchmarks.paper.comparison import MethodComparison
from benchmarks.paper.published import published, published_curves, published_plans
from benchmarks.statistics import mean_difference, probability_of_improvement, summarize_rates

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


def test_pairs_match_tasks_by_name():
    (pair,) = MethodComparison({"a": A, "b": B}).pairs
    rates = [[0.9, 0.5], [0.7, 0.3]], [[0.2, 0.4], [0.2, 0.4]]
    assert pair.difference == mean_difference(*rates)
    assert pair.difference.value == pytest.approx(0.3)
    assert pair.improvement == probability_of_improvement(*rates)


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


def test_published_plans_have_the_published_mean():
    rates = published_plans("PaLM 2")
    assert tuple(rates) == lw.MT50
    assert sum(map(sum, rates.values())) / 250 == pytest.approx(0.32952)
